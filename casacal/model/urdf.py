"""URDFs: the file read tag by tag, the arm between two of its links as origins of moving joints, and its masses."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.model.joints import Conventions, Joint
from casacal.model.kinematics import Expression, chain, rigid, rotate, rotate_x, rotate_y, rotate_z, slide
from casacal.model.unknown import Parameter, Unknown
from casacal.values import Array

MOVING = ("revolute", "continuous", "prismatic")
Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class UrdfJoint:
    """One <joint> with the line it begins in; `limits` and `mimics` are None where the file has none."""

    name: str
    kind: str
    line: int
    parent: str = ""
    child: str = ""
    xyz: Triple = ZERO
    rpy: Triple = ZERO
    axis: Triple = (1.0, 0.0, 0.0)
    limits: tuple[float, float] | None = None
    mimics: str | None = None


def check_joint(file: str, joint: UrdfJoint) -> None:
    """Raise ProblemError unless a joint of the chain can be calibrated and its numbers can be metres and radians."""
    where = f"{file}, line {joint.line}: joint '{joint.name}'"
    if joint.mimics is not None:
        fix = "Choose base and tip so that none does, or write a DH table with its coupling"
        raise ProblemError(f"{where} mimics '{joint.mimics}'", fix)
    if joint.kind not in (*MOVING, "fixed"):
        fix = "Between base and tip there may be revolute, continuous, prismatic and fixed joints"
        raise ProblemError(f"{where} is of type '{joint.kind}'", fix)
    if max(abs(v) for v in joint.xyz) > 20:
        raise ProblemError(f"{where} lies {max(map(abs, joint.xyz)):g} from its parent", "A URDF is in metres, not mm")
    if max(abs(v) for v in joint.rpy) > 2 * math.pi + 1e-6:
        raise ProblemError(f"{where} has rpy {_said(joint.rpy)}", "A URDF has radians, not degrees")
    if joint.kind != "fixed" and math.hypot(*joint.axis) < 1e-9:
        raise ProblemError(f"{where} has the axis {_said(joint.axis)}", "Give a direction, such as 0 0 1")
    if joint.kind in ("fixed", "continuous"):
        return
    if joint.limits is None:
        raise ProblemError(f"{where} is {joint.kind} and has no limits", "Add <limit lower= upper=>")
    lower, upper = joint.limits
    if not lower < upper:
        raise ProblemError(f"{where} has the limits {lower:g} to {upper:g}", "Give lower below upper")
    largest = max(abs(lower), abs(upper))
    if largest > (4 * math.pi + 1e-6 if joint.kind == "revolute" else 20):
        unit = "radians, not degrees" if joint.kind == "revolute" else "metres, not mm"
        raise ProblemError(f"{where} has the limits {lower:g} to {upper:g}", f"A URDF has {unit}")


def _said(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


def numbers_in(text: str, count: int) -> list[float]:
    """`count` finite numbers between blanks; none where the text is anything else."""
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        return []
    return values if len(values) == count and all(map(math.isfinite, values)) and "_" not in text else []


ATTRIBUTES = {
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "parent": ("link",),
    "child": ("link",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "mimic": ("joint", "multiplier", "offset"),
}
"""Parts of a joint that matter here, and what they may say."""
KNOWN: Mapping[tuple[str, ...], tuple[str, ...]] = {
    (): ("robot",),
    ("robot",): ("link", "joint"),
    ("robot", "joint"): tuple(ATTRIBUTES),
}
"""Tags that matter, by those that they stand in."""
DEEP = 4  # longer than the longest of them
EXPAND = "Expand it first: xacro ARM.urdf.xacro > ARM.urdf"
PLACING = ("origin", "axis", "parent", "child")  # those in which nothing may be overlooked


def read_urdf(path: str | Path) -> UrdfFile:
    """Read a URDF (see wiki.ros.org/urdf/XML).

    Raises ProblemError for a file that cannot be read, broken XML, xacro, names that are missing or come twice, and
    numbers that are none; what is wrong with one joint of the chain is said by `check_joint`.
    """
    file = str(path)
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise ProblemError(f"{file}: there is no such file", "Check the path of the URDF") from None
    except OSError as error:
        raise ProblemError(f"{file}: cannot be read ({error.strerror})", "Give a readable URDF") from None
    except ValueError:
        raise ProblemError(f"{file!r} is no path", "Give the path of a URDF") from None
    found = UrdfFile(file)
    try:
        found.parser.Parse(data, True)
    except expat.ExpatError as error:
        said = expat.ErrorString(error.code)
        raise ProblemError(f"{file}, line {error.lineno}: broken XML ({said})", "Mend the file") from None
    except (LookupError, ValueError) as error:  # an encoding that nobody knows, or that expat does not
        raise ProblemError(f"{file}: its encoding cannot be read ({error})", "Save it as UTF-8") from None
    found.check()
    return found


@dataclass
class UrdfFile:
    """All links and joints of a URDF, collected while expat walks through it; `path` holds the tags that are open."""

    file: str
    path: list[str] = field(default_factory=list)
    name: str = ""
    links: list[str] = field(default_factory=list)
    joints: list[UrdfJoint] = field(default_factory=list)
    parts: set[tuple[int, str]] = field(default_factory=set)  # parts of joints, by how many joints there are

    def __post_init__(self) -> None:
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = lambda _: self.path.pop()
        self.parser.EntityDeclHandler = lambda *_: self._refuse("declares an entity", "Write out its value")

    def chain(self, base: str | None, tip: str | None) -> tuple[UrdfJoint, ...]:
        """Joints from a base link (default: the root) to a tip link (default: the only one without child).

        Raises ProblemError for links that do not exist, several roots or tips, and loops.
        """
        if tip is None:
            parents = {joint.parent for joint in self.joints}
            tip = self._only([link for link in self.links if link not in parents], "tip")
        if base is None:
            children = {joint.child for joint in self.joints}
            base = self._only([link for link in self.links if link not in children], "base")
        for link in (base, tip):
            if link not in self.links:
                fix = f"Name one of {', '.join(self.links)}"
                raise ProblemError(f"{self.file}: there is no link named '{link}'", fix)
        found = self.between(base, tip)
        if found is None:
            raise ProblemError(f"{self.file}: link '{tip}' does not hang on link '{base}'", "Name a base above the tip")
        return found

    def between(self, base: str, link: str) -> tuple[UrdfJoint, ...] | None:
        """Joints from a base link to one that hangs on it; None for one that does not."""
        parents, way, links = {joint.child: joint for joint in self.joints}, list[UrdfJoint](), [link]
        while links[-1] in parents and len(way) <= len(self.joints):  # where joints form a loop, once round and one
            way.append(parents[links[-1]])
            links.append(way[-1].parent)
        return tuple(reversed(way[: links.index(base)])) if base in links else None

    def _only(self, links: list[str], what: str) -> str:
        if len(links) != 1:
            several = ", ".join(f"'{link}'" for link in links) or "none"
            name = f"Name one with {what}= (--{what} on the command line)"
            fix = name if links else "The joints form a loop; mend the file"
            raise ProblemError(f"{self.file}: there are {len(links)} links that could be the {what}: {several}", fix)
        return links[0]

    def check(self) -> None:
        """Raise ProblemError for names that come twice, and for joints that do not make a tree of links."""
        for kind, names in (("link", self.links), ("joint", [joint.name for joint in self.joints])):
            for name, count in Counter(names).items():
                if count > 1:
                    raise ProblemError(f"{self.file}: two {kind}s are named '{name}'", "Rename one of them")
        children, links = dict[str, str](), set(self.links)
        for joint in self.joints:
            where = f"{self.file}, line {joint.line}: joint '{joint.name}'"
            for what, link in (("parent", joint.parent), ("child", joint.child)):
                if not link:
                    raise ProblemError(f"{where} has no {what}", f"Add <{what} link=>")
                if link not in links:
                    fix = f"Add <link name='{link}'>"
                    raise ProblemError(f"{where} has the {what} '{link}', which is no link", fix)
            if joint.child in children:
                fix = "A URDF is a tree: give each link one joint above it"
                raise ProblemError(f"{where} and joint '{children[joint.child]}' both hold link '{joint.child}'", fix)
            children[joint.child] = joint.name

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        above, joints = tuple(self.path[:DEEP]), self.joints  # deeper is nothing that is known
        self.path.append(tag)
        if tag.startswith("xacro:"):
            self._refuse(f"is xacro (<{tag}>)", EXPAND)
        for name in KNOWN.get(above, ()):
            if tag != name and tag.lower() == name:
                self._refuse(f"has <{tag}>", f"Write <{name}>")
        if not above:
            if tag != "robot":
                self._refuse(f"begins with <{tag}>, a URDF with <robot>", "Give a URDF")
            self.name = attributes.get("name") or Path(self.file).stem
        elif tag not in KNOWN.get(above, ()):  # what other programs keep there
            return
        elif tag == "link":
            self.links.append(self._text(attributes, "name", "a link"))
        elif tag == "joint":
            name = self._text(attributes, "name", "a joint")
            kind = self._text(attributes, "type", f"joint '{name}'")
            joints.append(UrdfJoint(name, kind, self.parser.CurrentLineNumber))
        else:
            joints[-1] = replace(joints[-1], **self._part(joints[-1].name, tag, attributes))

    def _part(self, joint: str, tag: str, attributes: dict[str, str]) -> dict[str, Any]:
        """Fields of the joint last begun that one part of it says."""
        whose = f"<{tag}> of joint '{joint}'"
        for name in attributes:
            if name not in ATTRIBUTES[tag]:
                meant = [each for each in ATTRIBUTES[tag] if each == name.lower()]
                if meant or tag in PLACING:
                    fix = f"Write {meant[0]}=" if meant else f"It may have {', '.join(ATTRIBUTES[tag])}"
                    self._refuse(f"gives {whose} the attribute {name}=", fix)
        if (len(self.joints), tag) in self.parts:
            self._refuse(f"gives joint '{joint}' a second <{tag}>", "Leave one of them")
        self.parts.add((len(self.joints), tag))
        if tag == "mimic":
            return {"mimics": attributes.get("joint", "?")}
        if tag in ("parent", "child"):
            return {tag: self._text(attributes, "link", whose)}
        if tag == "limit":
            limits = (self._numbers(attributes.get(key, "0"), whose, 1)[0] for key in ("lower", "upper"))
            return {"limits": tuple(limits)}
        keys = [key for key in ("xyz", "rpy") if key in attributes and key in ATTRIBUTES[tag]]
        triples = {key: tuple(self._numbers(attributes[key], f"{key} of {whose}", 3)) for key in keys}
        return {"axis" if tag == "axis" else key: triple for key, triple in triples.items()}

    def _numbers(self, text: str, whose: str, count: int) -> list[float]:
        if "${" in text or "$(" in text:
            self._refuse(f"is xacro ({whose} is '{text}')", EXPAND)
        values = numbers_in(text, count)
        if not values:
            self._refuse(f"has {whose} '{text}'", f"Give {count} number{'s' if count > 1 else ''} in metres or radians")
        return values

    def _text(self, attributes: dict[str, str], key: str, whose: str) -> str:
        if not attributes.get(key):
            self._refuse(f"gives {whose} no {key}", f"Add {key}=")
        return attributes[key]

    def _refuse(self, what: str, fix: str) -> NoReturn:
        raise ProblemError(f"{self.file}, line {self.parser.CurrentLineNumber}: the file {what}", fix)


MM = 1000.0  # millimetres in a URDF's metre


@dataclass(frozen=True)
class UrdfChain:
    """The joints, moving and fixed, between two links of a URDF.

    `file` is the file's name, without its folder; `path`, where it was read, says nothing of the arm.
    """

    file: str
    name: str
    chain: tuple[UrdfJoint, ...]
    conventions: Conventions | None = None
    path: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not self.moving:
            raise ProblemError(f"{self.file}: no joint moves between base and tip", "Name a tip above moving joints")
        if self.conventions is not None:
            self.conventions.check_joints(len(self.moving), self.name)

    @staticmethod
    def read(path: str | Path, base: str | None, tip: str | None, conventions: Conventions | None) -> UrdfChain:
        """Read a URDF and take the chain from a base link to a tip link; raises ProblemError."""
        found = read_urdf(path)
        joints = found.chain(base, tip)
        for joint in joints:
            check_joint(found.file, joint)
        return UrdfChain(Path(path).name, found.name, joints, conventions, str(Path(path).resolve()))

    @property
    def moving(self) -> tuple[UrdfJoint, ...]:
        """The joints that move, in order."""
        return tuple(joint for joint in self.chain if joint.kind != "fixed")

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Kinds and limits, rad and mm; +-pi for a continuous joint. As the controller shows them, where that differs.

        Where a controller couples joints, each gets the widest range that the model's limits leave it.
        """
        low, high = np.array([_limits(joint) for joint in self.moving]).T
        if self.conventions is not None:
            spread = np.abs(np.linalg.inv(self.conventions.matrix)) @ ((high - low) / 2)
            middle = self.conventions.to_controller((low + high) / 2)
            low, high = middle - spread, middle + spread
        kinds = ["prismatic" if joint.kind == "prismatic" else "revolute" for joint in self.moving]
        rows = zip(kinds, low, high, strict=True)
        return tuple(Joint(kind, float(lower), float(upper)) for kind, lower, upper in rows)  # type: ignore[arg-type]

    def pose(self, p: Any, q: Expression) -> Expression:
        """Pose of the tip link in the base link (4x4, mm) at the origins of `p` and joint values q (n; rad, mm)."""
        q = q if self.conventions is None else self.conventions.to_model(q)
        links, fixed, i = [], np.eye(4), 0
        for joint in self.chain:
            if joint.kind == "fixed":
                fixed = fixed @ origin_matrix(joint)
                continue
            axis, moved = np.array(joint.axis) / math.hypot(*joint.axis), q[i]
            along = np.flatnonzero(np.abs(axis) > 1 - 1e-15)  # a turn about a coordinate axis keeps its zeros
            if joint.kind == "prismatic":
                motion = slide(axis, moved)
            elif along.size:
                motion = (rotate_x, rotate_y, rotate_z)[along[0]](moved if axis[along[0]] > 0 else -moved)
            else:
                motion = rotate(axis, moved)
            links += [*self._origin(fixed, joint, p, i), motion]
            fixed, i = np.eye(4), i + 1
        return chain(*links, *([] if np.array_equal(fixed, np.eye(4)) else [ca.DM(fixed)]))

    def _origin(self, fixed: Array, joint: UrdfJoint, p: Any, i: int) -> list[Expression]:
        """Origin of moving joint i, after the fixed ones before it: its place and turn, then its small turns."""
        shift = ca.vertcat(p.x[i], p.y[i], p.z[i])
        turn = origin_matrix(joint)[:3, :3]
        place = ca.mtimes(ca.DM(fixed[:3, :3]), shift) + ca.DM(fixed[:3, 3])
        origin = rigid(ca.DM(fixed[:3, :3] @ turn), place)
        return [origin, rotate_x(p.rx[i]), rotate_y(p.ry[i]), rotate_z(p.rz[i])]

    def parameters(self, length_std: float | None, angle_std: float | None) -> Mapping[str, Unknown]:
        """Unknowns x, y, z (mm): the origins; rx, ry, rz (rad, nominally zero): small turns of each joint's frame.

        These are not the file's roll, pitch and yaw, which lose a direction at 90 degrees, where many drawings stand.
        """
        rows, zeros = np.array([joint.xyz for joint in self.moving]).T * MM, (0.0,) * len(self.moving)
        turns = {key: Parameter(zeros, unit="rad", prior_std=angle_std) for key in ("rx", "ry", "rz")}
        return {key: Parameter(row, prior_std=length_std) for key, row in zip("xyz", rows, strict=True)} | turns

    def origins_at(self, p: Any) -> list[Array]:
        """Origins (4x4, mm) of the moving joints in their parents at numbers `p`, without the fixed joints."""
        made = (chain(*self._origin(np.eye(4), joint, p, i)) for i, joint in enumerate(self.moving))
        return [np.asarray(each.matrix, dtype=np.float64) for each in made]


def origin_matrix(joint: UrdfJoint) -> Array:
    """Nominal <origin> (4x4, mm): RotZ(yaw) RotY(pitch) RotX(roll), as the URDF's fixed-axis roll, pitch, yaw mean."""
    roll, pitch, yaw = joint.rpy
    matrix = np.array(chain(rotate_z(yaw), rotate_y(pitch), rotate_x(roll)), dtype=np.float64)
    matrix[:3, 3] = np.array(joint.xyz) * MM
    return matrix


def _limits(joint: UrdfJoint) -> tuple[float, float]:
    """Lower and upper limit, rad or mm."""
    if joint.kind == "continuous" or joint.limits is None:
        return -math.pi, math.pi
    scale = MM if joint.kind == "prismatic" else 1.0
    return joint.limits[0] * scale, joint.limits[1] * scale


def weights_of(
    path: str | Path, base: str | None, tip: str | None, payload: float
) -> tuple[tuple[float, ...], tuple[Triple, ...]]:
    """Mass (n,), kg, and centre (n, 3) of what each moving joint between two links carries up to the next joint.

    Centres are in the base link's frame at joint values of zero, mm. Links that hang beside the chain count where they
    hang, other joints at zero; a payload (kg) hangs at the origin of the tip link.

    Raises ProblemError where no link of the arm has a mass, a mass or a place is no number, or the file is none.
    """
    found = read_urdf(path)
    chain = found.chain(base, tip)
    root = chain[0].parent if chain else ""
    moving = [joint.name for joint in chain if joint.kind != "fixed"]
    if not (math.isfinite(payload) and payload >= 0):
        raise ProblemError(f"A payload of {payload!r} kg came", "Give zero or more")
    weighs = list[tuple[str, float, Array]]()
    for element in ElementTree.parse(path).getroot().findall("link"):
        inertial, name = element.find("inertial"), element.get("name", "")
        weight, origin = (inertial.find(tag) if inertial is not None else None for tag in ("mass", "origin"))
        if weight is None:
            continue
        kg = _numbers(path, f"mass of link '{name}'", weight.get("value", ""), 1)[0]
        xyz = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
        place = np.array(_numbers(path, f"centre of mass of link '{name}'", xyz, 3))
        if kg < 0:
            raise ProblemError(f"{path}: the mass of link '{name}' is {kg:g}", "Give kilograms, zero or more")
        weighs.append((name, kg, place * MM))
    if payload and not chain:
        raise ProblemError(f"{path}: base and tip are one link, which carries nothing", "Name two links")
    if payload:
        weighs.append((chain[-1].child, payload, np.zeros(3)))
    masses, moments = np.zeros(len(moving)), np.zeros((len(moving), 3))
    for link, mass, centre in weighs:
        way = found.between(root, link) or ()
        pose = np.eye(4)
        for joint in reversed(way):
            pose = origin_matrix(joint) @ pose
        # the last moving joint of the chain above the link carries it; nothing does where it does not hang on the arm
        k = max((moving.index(joint.name) for joint in way if joint.name in moving), default=-1)
        if k >= 0:
            masses[k] += mass
            moments[k] += mass * (pose @ [*centre, 1.0])[:3]
    if not masses.sum() > 0:
        raise ProblemError(f"{path}: no link of the arm has a mass", "Add <inertial>, or give masses= yourself")
    places = moments / np.where(masses > 0, masses, 1.0)[:, None]
    return tuple(map(float, masses)), tuple((float(x), float(y), float(z)) for x, y, z in places)


def _numbers(path: str | Path, what: str, text: str, count: int) -> list[float]:
    values = numbers_in(text, count)
    if not values:
        raise ProblemError(f"{path}: the {what} is '{text}'", f"Give {count} number{'s' if count > 1 else ''}")
    return values

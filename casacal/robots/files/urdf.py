"""A URDF file as plain data: the joints from a base link to a tip link, in metres and radians as the file has them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from casacal.errors import ProblemError

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


@dataclass(frozen=True)
class UrdfFile:
    """All links and joints of a URDF."""

    file: str
    name: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]

    def chain(self, base: str | None, tip: str | None) -> tuple[UrdfJoint, ...]:
        """Joints from a base link (default: the root) to a tip link (default: the only one without child).

        Raises ProblemError for links that do not exist, several roots or tips, and loops.
        """
        above = {joint.child: joint for joint in self.joints}
        if tip is None:
            tip = self._only([link for link in self.links if link not in {j.parent for j in self.joints}], "tip")
        if base is None:
            base = self._only([link for link in self.links if link not in above], "base")
        for link in (base, tip):
            if link not in self.links:
                raise ProblemError(
                    f"{self.file}: there is no link named '{link}'", f"Name one of {', '.join(self.links)}"
                )
        found: list[UrdfJoint] = []
        link = tip
        while link != base:
            if link not in above or len(found) > len(self.joints):
                raise ProblemError(
                    f"{self.file}: link '{tip}' does not hang on link '{base}'", "Name a base above the tip"
                )
            found.append(above[link])
            link = above[link].parent
        return tuple(reversed(found))

    def _only(self, links: list[str], what: str) -> str:
        if len(links) != 1:
            several = ", ".join(f"'{link}'" for link in links) or "none"
            raise ProblemError(
                f"{self.file}: there are {len(links)} links that could be the {what}: {several}",
                f"Name one with {what}= (--{what} on the command line)"
                if links
                else "The joints form a loop; mend the file",
            )
        return links[0]


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
    reader = _Reader(file)
    try:
        reader.parser.Parse(data, True)
    except expat.ExpatError as error:
        said = expat.ErrorString(error.code)
        raise ProblemError(f"{file}, line {error.lineno}: broken XML ({said})", "Mend the file") from None
    except (LookupError, ValueError) as error:  # an encoding that nobody knows, or that expat does not
        raise ProblemError(f"{file}: its encoding cannot be read ({error})", "Save it as UTF-8") from None
    return reader.finished()


def check_joint(file: str, joint: UrdfJoint) -> None:
    """Raise ProblemError unless a joint of the chain can be calibrated and its numbers can be metres and radians."""
    where = f"{file}, line {joint.line}: joint '{joint.name}'"
    if joint.mimics is not None:
        raise ProblemError(f"{where} mimics '{joint.mimics}'", "Choose base and tip so that no joint mimics another")
    if joint.kind not in (*MOVING, "fixed"):
        raise ProblemError(
            f"{where} is of type '{joint.kind}'",
            "Between base and tip there may be revolute, continuous, prismatic and fixed joints",
        )
    if max(abs(v) for v in joint.xyz) > 20:
        raise ProblemError(f"{where} lies {max(map(abs, joint.xyz)):g} from its parent", "A URDF is in metres, not mm")
    if max(abs(v) for v in joint.rpy) > 2 * math.pi + 1e-6:
        raise ProblemError(f"{where} has rpy {_said(joint.rpy)}", "A URDF has radians, not degrees")
    if joint.kind == "fixed":
        return
    if math.hypot(*joint.axis) < 1e-9:
        raise ProblemError(f"{where} has the axis {_said(joint.axis)}", "Give a direction, such as 0 0 1")
    if joint.kind == "continuous":
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


@dataclass
class _Reader:
    """Collects links and joints while expat walks through the file."""

    file: str
    path: list[str] = field(default_factory=list)
    name: str = ""
    links: list[str] = field(default_factory=list)
    joints: list[UrdfJoint] = field(default_factory=list)
    placed: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = lambda _: self.path.pop()
        self.parser.EntityDeclHandler = lambda *_: self._refuse("declares an entity", "Write out what it stands for")

    def finished(self) -> UrdfFile:
        for kind, names in (("link", self.links), ("joint", [joint.name for joint in self.joints])):
            for name in names:
                if names.count(name) > 1:
                    raise ProblemError(f"{self.file}: two {kind}s are named '{name}'", "Rename one of them")
        children: dict[str, str] = {}
        for joint in self.joints:
            where = f"{self.file}, line {joint.line}: joint '{joint.name}'"
            for what, link in (("parent", joint.parent), ("child", joint.child)):
                if not link:
                    raise ProblemError(f"{where} has no {what}", f"Add <{what} link=>")
                if link not in self.links:
                    raise ProblemError(
                        f"{where} has the {what} '{link}', which is no link", f"Add <link name='{link}'>"
                    )
            if joint.child in children:
                raise ProblemError(
                    f"{where} and joint '{children[joint.child]}' both hold link '{joint.child}'",
                    "A URDF is a tree: give each link one joint above it",
                )
            children[joint.child] = joint.name
        return UrdfFile(self.file, self.name or Path(self.file).stem, tuple(self.links), tuple(self.joints))

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self.path.append(tag)
        if tag.startswith("xacro:"):
            self._refuse(f"is xacro (<{tag}>)", "Expand it first: xacro ARM.urdf.xacro > ARM.urdf")
        if len(self.path) == 1:
            if tag != "robot":
                self._refuse(f"begins with <{tag}>, a URDF with <robot>", "Give a URDF")
            self.name = attributes.get("name", "")
        elif self.path[:-1] == ["robot"] and tag == "link":
            self.links.append(self._text(attributes, "name", "a link"))
        elif self.path[:-1] == ["robot"] and tag == "joint":
            name = self._text(attributes, "name", "a joint")
            kind = self._text(attributes, "type", f"joint '{name}'")
            self.joints.append(UrdfJoint(name, kind, self.parser.CurrentLineNumber))
        elif self.path[:-1] == ["robot", "joint"]:
            self._part(self.joints[-1], tag, attributes)

    def _part(self, joint: UrdfJoint, tag: str, attributes: dict[str, str]) -> None:
        """Take in one part of a joint, the last one begun."""
        whose = f"<{tag}> of joint '{joint.name}'"
        if tag == "origin":
            if joint.name in self.placed:
                self._refuse(f"gives joint '{joint.name}' a second <origin>", "Leave one of them")
            self.placed.add(joint.name)
            xyz, rpy = (self._triple(attributes, key, whose, ZERO) for key in ("xyz", "rpy"))
            joint = replace(joint, xyz=xyz, rpy=rpy)
        elif tag == "axis":
            joint = replace(joint, axis=self._triple(attributes, "xyz", whose, joint.axis))
        elif tag == "parent":
            joint = replace(joint, parent=self._text(attributes, "link", whose))
        elif tag == "child":
            joint = replace(joint, child=self._text(attributes, "link", whose))
        elif tag == "limit":
            lower, upper = (self._numbers(attributes.get(key, "0"), whose, 1)[0] for key in ("lower", "upper"))
            joint = replace(joint, limits=(lower, upper))
        elif tag == "mimic":
            joint = replace(joint, mimics=attributes.get("joint", "?"))
        self.joints[-1] = joint

    def _triple(self, attributes: dict[str, str], key: str, whose: str, default: Triple) -> Triple:
        if key not in attributes:
            return default
        x, y, z = self._numbers(attributes[key], f"{key} of {whose}", 3)
        return x, y, z

    def _numbers(self, text: str, whose: str, count: int) -> list[float]:
        if "${" in text or "$(" in text:
            self._refuse(f"is xacro ({whose} is '{text}')", "Expand it first: xacro ARM.urdf.xacro > ARM.urdf")
        try:
            values = [float(part) for part in text.split()]
        except ValueError:
            values = []
        if len(values) != count or not all(math.isfinite(value) for value in values) or "_" in text:
            self._refuse(f"has {whose} '{text}'", f"Give {count} number{'s' if count > 1 else ''} in metres or radians")
        return values

    def _text(self, attributes: dict[str, str], key: str, whose: str) -> str:
        if not attributes.get(key):
            self._refuse(f"gives {whose} no {key}", f"Add {key}=")
        return attributes[key]

    def _refuse(self, what: str, fix: str) -> NoReturn:
        raise ProblemError(f"{self.file}, line {self.parser.CurrentLineNumber}: the file {what}", fix)

"""`casacal export`: DH tables, URDF, zero offsets and C, each with a remark that states the expected tip error."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.parsers import expat

import casadi as ca
import numpy as np

from casacal.deployment.arm import CalibratedArm, arm_values
from casacal.deployment.functions import c_text, casadi_text
from casacal.deployment.remark import MARK, other_forms, remark
from casacal.deployment.result_file import arm_from
from casacal.errors import CasacalError, UnknownNameError, came
from casacal.files import MADE, write_text
from casacal.model.dh_file import dh_file_text, is_toml
from casacal.model.dh_table import NEARLY, DHTable, plain
from casacal.model.joints import Conventions
from casacal.model.kinematics import chain, rotate_x, rotate_y, rotate_z, translate
from casacal.model.urdf import MM, UrdfChain, origin_matrix
from casacal.uncertainty.tip_error import workspace_joints
from casacal.values import Array

LEVER = 100.0  # distance (mm) from the flange's origin of the points that stand for its orientation
STEPS = 5
JOINTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
ATTRIBUTE = re.compile(rb"""\s([\w:.-]+)\s*=\s*("[^"]*"|'[^']*')""")
FORMS = ("dh", "urdf", "zeros", "ur", "c", "casadi")
"""DH table (CSV, or TOML by the file's name), URDF, zero corrections (CSV), ur_description's kinematics, C99, and
a `casadi.Function` of q to the flange pose, which `casadi.Function.load` reads."""


@dataclass(frozen=True)
class ZeroCorrections:
    """Corrections (n,; rad, mm) in the controller's sign, and what they leave.

    values: where the controller shows q, the calibrated arm stands as the drawn one would at q + values. A target t is
    met by sending t - values, or by changing the controller's zeros so that it shows q + values. before, after:
    distance (mm RMS) between the two without and with them, over the workspace, of the flange's origin and of three
    points `LEVER` from it along its axes.
    """

    values: Array
    before: float
    after: float

    @property
    def share(self) -> float:
        """Fraction of the calibration's squared effect that zero offsets express, 0 to 1."""
        return 1.0 - (self.after / self.before) ** 2 if self.before > 0 else 1.0


def zero_corrections(result: CalibratedArm) -> ZeroCorrections:
    """Least-squares zero corrections of a calibration, whatever the robot is built from."""
    result = arm_from(result)
    robot = result.source.problem.robot
    q = ca.SX.sym("q", len(robot.axes))
    poses = (ca.SX(robot.pose(arm_values(result, nominal=nominal), q)) for nominal in (True, False))
    drawn, true = (ca.vertcat(p[:3, 3], *(p[:3, 3] + LEVER * p[:3, k] for k in range(3))) for p in poses)
    joints = workspace_joints(robot)
    count = len(joints)
    evaluate = ca.Function("points", [q], [drawn, ca.jacobian(drawn, q)]).map(count)
    target = np.asarray(ca.Function("points", [q], [true]).map(count)(joints.T)).T
    values, misses = np.zeros(len(robot.axes)), []
    for _ in range(STEPS):  # Gauss-Newton on corrections of a degree or less: quadratic at once
        points, slopes = evaluate((joints + values).T)
        error = (target - np.asarray(points).T).ravel()
        misses.append(math.sqrt(float((error**2).sum()) / (4 * count)))
        slope = np.asarray(slopes).reshape(12, count, -1).transpose(1, 0, 2).reshape(12 * count, -1)
        values = values + np.linalg.lstsq(slope, error, rcond=1e-9)[0]
    return ZeroCorrections(values, misses[0], misses[-1])


def zeros_text(result: CalibratedArm) -> str:
    """Zero corrections as CSV, degrees (mm where a joint slides), with what they can and cannot express."""
    result = arm_from(result)
    found, axes = zero_corrections(result), result.source.problem.robot.axes
    slides = any(joint.kind == "prismatic" for joint in axes)
    said = [
        "where the controller shows q, the arm is where the drawn arm would be at q + correction. Do one of these, "
        "never both:",
        "(1) subtract each correction from the joint values of every target, and leave the zeros as they are",
        "(2) change the controller's zeros so that, at rest, each joint shows its value + correction, and leave the "
        "targets as they are",
        f"the calibration moves the flange by {found.before:.3f} mm RMS over the workspace (its origin and points "
        f"{LEVER:g} mm from it)",
        f"zero offsets express {100 * found.share:.0f} % of its mean square; {found.after:.3f} mm RMS remain",
    ]
    lines = [f"# {line}" for line in (*remark(result, form="zeros"), *(MARK + line for line in said))]
    lines.append("joint,correction_deg" + (",correction_mm" if slides else ""))
    for i, (joint, value) in enumerate(zip(axes, found.values, strict=True), 1):
        cells = [str(i), f"{math.degrees(value) + 0.0:.6f}"] if joint.turns else [str(i), "", plain(round(value, 6))]
        lines.append(",".join([*cells, ""] if joint.turns and slides else cells))
    return "\n".join(lines) + "\n"


def roll_pitch_yaw(matrix: Array, near: Sequence[float] = (0.0, 0.0, 0.0)) -> tuple[float, float, float]:
    """Angles (rad) with RotZ(yaw) RotY(pitch) RotX(roll) = matrix (3, 3), of all such the nearest to `near`.

    Where the pitch is a quarter turn, only the sum or difference of roll and yaw is known: the yaw stays as it is.
    """
    upright = math.hypot(matrix[0, 0], matrix[1, 0])
    yaw = math.atan2(matrix[1, 0], matrix[0, 0]) if upright > 1e-10 else near[2]
    pitch = math.atan2(-matrix[2, 0], upright)
    c, s = math.cos(yaw), math.sin(yaw)
    roll = math.atan2(s * matrix[0, 2] - c * matrix[1, 2], c * matrix[1, 1] - s * matrix[0, 1])
    twins = np.array([(roll, pitch, yaw), (roll + math.pi, math.pi - pitch, yaw + math.pi)])
    turned = twins - math.tau * np.round((twins - near) / math.tau)  # each within half a turn of `near`
    x, y, z = turned[np.argmin(((turned - near) ** 2).sum(axis=1))].tolist()
    return x, y, z


def ur_kinematics_text(result: CalibratedArm) -> str:
    """Origins of the six joints in the frame before, m and rad, as YAML; each joint turns about its own z.

    Frames stay beside the nominal ones, as common normals of parallel axes would throw lengths metres away. A frame
    behind the last joint is said in a comment. `hash` is made from the numbers. Raises CasacalError for an arm that is
    no 6R arm with three parallel axes from the second on.
    """
    result = arm_from(result)
    robot = result.source.problem.robot
    name, arm, fix = robot.name, robot.arm, other_forms(robot)
    if not isinstance(arm, (DHTable, UrdfChain)):
        raise CasacalError(f"'{name}' was not built from a DH table or a URDF", fix)
    if len(arm.joints) != 6 or any(joint.kind != "revolute" for joint in arm.joints):
        raise CasacalError(f"'{name}' has {len(arm.joints)} joints, and a UR has six that turn", fix)
    conventions = arm.conventions or Conventions.plain(6)
    if not np.array_equal(conventions.matrix, np.eye(6)):
        raise CasacalError(f"'{name}' has joint signs or coupling, which this format does not know", fix)
    if isinstance(arm, UrdfChain):
        kinds = "".join("f" if joint.kind == "fixed" else "m" for joint in arm.chain).strip("f")
        if "f" in kinds or any(joint.axis != (0.0, 0.0, 1.0) for joint in arm.moving):
            raise CasacalError(f"'{arm.name}' has fixed joints between its joints, or axes that are not z", fix)
    drawn = _origins(arm, arm_values(result, nominal=True), conventions)[0]
    crossed = np.array([abs(origin[2, 2]) for origin in drawn[1:]])  # cosines between each axis and the next
    if (np.abs(np.arccos(np.minimum(crossed, 1.0)) - np.arccos([0, 1, 1, 0, 0])) > NEARLY).any():
        what = f"'{name}' is not built like a UR, whose axes 2, 3 and 4 are parallel and the others at right angles"
        raise CasacalError(what, fix)
    origins, rest = _origins(arm, arm_values(result), conventions)
    lines = [f"# {line}" for line in remark(result, form="ur")]
    if not np.allclose(rest, np.eye(4), rtol=0, atol=1e-12):
        shift = " ".join(_fixed(v, 6) for v in rest[:3, 3])
        turn = " ".join(_fixed(math.degrees(v), 6) for v in roll_pitch_yaw(rest[:3, :3]))
        lines += [
            f"# {MARK}the calibrated flange relative to wrist_3: x y z {shift} mm, roll pitch yaw {turn} deg:",
            f"# {MARK}this format has no place for that; put it before your tool",
        ]
    block = []
    for joint, origin in zip(JOINTS, origins, strict=True):
        values = [*(origin[:3, 3] / 1000), *roll_pitch_yaw(origin[:3, :3])]
        named = zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True)
        block += [f"  {joint}:", *(f"    {key}: {_fixed(value)}" for key, value in named)]
    digest = hashlib.sha256("\n".join(block).encode()).hexdigest()[:16]
    return "\n".join([*lines, "kinematics:", *block, f"  hash: casacal_{digest}"]) + "\n"


def _origins(arm: DHTable | UrdfChain, p: Any, conventions: Conventions) -> tuple[list[Array], Array]:
    """Origins (4x4, mm) of the joints, each in the frame before, and what stands behind the last one."""
    if isinstance(arm, UrdfChain):  # fixed joints before the first and behind the last moving one are its own
        turns = [np.array(rotate_z(offset), dtype=np.float64) for offset in conventions.offsets]
        return [origin @ turn for origin, turn in zip(arm.origins_at(p), turns, strict=True)], np.eye(4)
    table = arm.at(p)
    beta = dict(zip(table.parallel, table.beta, strict=True))
    origins, rest = [], chain()
    for i, offset in enumerate(conventions.offsets):
        spin = chain(translate(0, 0, table.d[i]), rotate_z(table.theta[i] + offset))
        lean = chain(translate(table.a[i], 0, 0), rotate_x(table.alpha[i]))
        if table.convention == "standard":
            origins.append(chain(rest, spin))
            rest = chain(lean, rotate_y(beta.get(i + 1, 0.0)))
        else:
            origins.append(chain(lean, rotate_y(beta.get(i, 0.0)), spin))
    return [np.array(origin, dtype=np.float64) for origin in origins], np.array(rest, dtype=np.float64)


def _fixed(value: float, digits: int = 12) -> str:
    """A number without exponent, which YAML readers take for a text where it has no point."""
    return f"{value:z.{digits}f}".rstrip("0").rstrip(".")


def urdf_text(result: CalibratedArm, source: str | Path | None = None) -> str:
    """The URDF with the calibrated origins; every other byte is that of the source, so it carries no remark.

    A number that is the same to twelve digits keeps its text. source: the URDF; None takes the text that the result
    holds, else the file of that name beside the problem. Raises CasacalError for robots that `Robot.from_urdf` did not
    build, and for a source that is not the one the calibration began with.
    """
    result = arm_from(result)
    arm = result.source.problem.robot.arm
    if not isinstance(arm, UrdfChain):
        fix = other_forms(result.source.problem.robot)
        raise CasacalError(f"'{result.source.problem.robot.name}' was not built from a URDF", fix)
    data = _source_text(result, arm, source)
    joints, origins = _places(data)
    edits: list[tuple[int, int, bytes]] = []
    for joint, new in zip(arm.moving, arm.origins_at(arm_values(result)), strict=True):
        old, changed = origin_matrix(joint), dict[str, tuple[float, ...]]()
        if not np.allclose(new[:3, 3], old[:3, 3], rtol=0, atol=1e-9):
            changed["xyz"] = tuple((new[:3, 3] / MM).tolist())
        if not np.allclose(new[:3, :3], old[:3, :3], rtol=0, atol=1e-12):
            changed["rpy"] = roll_pitch_yaw(new[:3, :3], joint.rpy)
        if changed:
            edits += _edits(data, joints[joint.name], origins.get(joint.name), changed)
    for start, end, text in sorted(edits, reverse=True):
        data = data[:start] + text + data[end:]
    return data.decode("utf-8")


def _source_text(result: CalibratedArm, arm: UrdfChain, source: str | Path | None) -> bytes:
    """The URDF to write into, in UTF-8."""
    kept = [file.text for file in result.source.files if Path(file.path).name == arm.file and file.text]
    if source is None and kept and "\ufffd" not in kept[0]:
        return kept[0].encode("utf-8")
    path = Path(result.source.path).parent / arm.file if source is None else Path(source)
    there = UrdfChain.read(path, arm.chain[0].parent, arm.chain[-1].child, arm.conventions)
    fix = "Give the URDF that the problem was made from"
    if [joint.name for joint in there.chain] != [joint.name for joint in arm.chain]:
        raise CasacalError(f"{path}: the joints between base and tip are not those of the calibrated arm", fix)
    for one, two in zip(there.chain, arm.chain, strict=True):
        moved = not np.allclose((one.xyz, one.rpy), (two.xyz, two.rpy), rtol=0, atol=1e-9)
        if moved or (one.kind, one.axis) != (two.kind, two.axis):
            raise CasacalError(f"{path}: joint '{one.name}' is not as it was when the calibration began", fix)
    try:
        return path.read_bytes().decode("utf-8").encode("utf-8")
    except UnicodeDecodeError:
        raise CasacalError(f"{path}: this is not UTF-8", "Save it as UTF-8; then only origins are edited") from None


def _edits(
    data: bytes, joint: int, start: int | None, changed: dict[str, tuple[float, ...]]
) -> list[tuple[int, int, bytes]]:
    """Replacements (start, end, text) that give the origin at `start` other xyz or rpy; at None it is added."""
    if start is None:
        at = _tag_end(data, joint)
        indent = data[at : len(data) - len(data[at:].lstrip())]
        said = b"".join(b' %s="%s"' % (key.encode(), _numbers(values)) for key, values in changed.items())
        return [(at, at, indent + b"<origin" + said + b"/>")]
    tag, edits = data[start : _tag_end(data, start)], []
    places = {found[1].decode(): found.span(2) for found in ATTRIBUTE.finditer(tag)}
    for key, values in changed.items():
        if key in places:
            first, last = places[key][0] + 1, places[key][1] - 1  # inside the quotes
            edits.append((start + first, start + last, _in_place(tag[first:last], values)))
        else:
            at = start + len(b"<origin")
            edits.append((at, at, b' %s="%s"' % (key.encode(), _numbers(values))))
    return edits


def _in_place(text: bytes, values: tuple[float, ...]) -> bytes:
    """Three numbers in the blanks of the old ones; a number that is the same keeps its text."""
    if b"&" in text:  # written as character references: all afresh
        return _numbers(values)
    for found, value in reversed(list(zip(re.finditer(rb"\S+", text), values, strict=True))):
        if not math.isclose(float(found[0]), value, rel_tol=1e-12, abs_tol=1e-12):
            text = text[: found.start()] + plain(value).encode() + text[found.end() :]
    return text


def _numbers(values: tuple[float, ...]) -> bytes:
    return " ".join(plain(value) for value in values).encode()


def _tag_end(data: bytes, start: int) -> int:
    """End of the start tag that begins at `start`; quotes may hold a >."""
    found = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""").match(data, start)
    return found.end() if found else len(data)


def _places(data: bytes) -> tuple[dict[str, int], dict[str, int]]:
    """Positions, in bytes, of the joints of a URDF and of their origins."""
    joints, origins, path = dict[str, int](), dict[str, int](), list[tuple[str, str]]()
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append((tag, attributes.get("name", "")))
        tags = [entry[0] for entry in path]
        if tags == ["robot", "joint"]:
            joints[path[1][1]] = parser.CurrentByteIndex
        elif tags == ["robot", "joint", "origin"]:
            origins[path[1][1]] = parser.CurrentByteIndex

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: path.pop()
    parser.Parse(data, True)
    return joints, origins


def export(
    arm: CalibratedArm,
    form: str,
    path: str | Path | None = None,
    *,
    source: str | Path | None = None,
    prefix: str | None = None,
    force: bool = False,
) -> str:
    """A calibrated arm in a form that others read, as text.

    form: one of `FORMS`. path: file to write it to; None writes nothing. source: for "urdf", the file written
    back with only its numbers changed. prefix: for "c", what the functions' names begin with; by default the problem's
    name. force: write a result whose verdict is not to use it, with that verdict as a comment.

    Raises UnknownNameError for another form, CasacalError where the arm cannot be said in it, or is not to be used.
    """
    arm = arm_from(arm)
    if not isinstance(form, str) or form not in FORMS:
        raise UnknownNameError("form", str(form), FORMS)
    for place in (path, source):
        if place is not None and not isinstance(place, (str, Path)):
            raise CasacalError(f"Got {came(place)} as a path", "Give a path, or nothing")
    if source is not None and form != "urdf":
        raise CasacalError(f"The form '{form}' writes no file back", "Leave out the source")
    if prefix is not None and form != "c":
        raise CasacalError(f"The form '{form}' has no prefix", "Leave it out")
    arm.check_usable(force=force)
    if form == "dh":
        text = dh_text(arm, toml=path is not None and is_toml(path))
    elif form == "urdf":
        text = _remarked(urdf_text(arm, source), arm)
    elif form == "c":
        text = c_text(arm, prefix=prefix)
    elif form == "casadi":
        text = f"{casadi_text(arm)}\n# {MADE}\n"  # behind what casadi.Function.load reads
    else:
        text = zeros_text(arm) if form == "zeros" else ur_kinematics_text(arm)
    if path is not None:
        write_text(path, text)
    return text


def dh_text(result: CalibratedArm, *, toml: bool = False) -> str:
    """The calibrated DH table in its own convention, with the controller's joint signs, offsets and coupling.

    result: of a robot built by `Robot.from_dh` or `from_dh_file`; where axes are parallel, Hayati's `beta` stands in
    place of `d`. toml: TOML in place of CSV. Raises CasacalError for other robots.
    """
    result = arm_from(result)
    robot = result.source.problem.robot
    if not isinstance(robot.arm, DHTable):
        raise CasacalError(f"'{robot.name}' was not built from a DH table", other_forms(robot))
    table = robot.arm.at(arm_values(result))
    table = replace(table, alpha=tuple(math.remainder(twist, math.tau) for twist in table.alpha))  # as files have it
    text = dh_file_text(table, "arm.toml" if toml else "arm.csv")
    return "".join(f"# {line}\n" for line in remark(result, form="dh")) + text


def _remarked(text: str, arm: CalibratedArm) -> str:
    """A URDF with its remark as a comment before its first element, in place of an older one."""
    text = re.sub(rf"<!-- {MARK}.*?-->\r?\n?", "", text, flags=re.DOTALL)
    words = "\n".join(remark(arm, form="urdf")).replace("--", "- -")  # a comment holds no two hyphens
    tags = re.finditer(r"<!--.*?-->|<(?=[A-Za-z_])", text, re.DOTALL)  # comments may hold what looks like one
    place = next(tag.start() for tag in tags if tag[0] == "<")
    return f"{text[:place]}<!-- {words} -->\n{text[place:]}"

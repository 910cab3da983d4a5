"""The calibrated arm as the URDF it came from, in which nothing but the origins of calibrated joints is edited."""

from __future__ import annotations

import math
import re
from pathlib import Path
from xml.parsers import expat

import numpy as np

from casacal.compensation.arm import CalibratedArm, arm_values
from casacal.compensation.result_file import arm_from
from casacal.errors import CasacalError
from casacal.export.controllers import roll_pitch_yaw
from casacal.export.remark import other_forms
from casacal.robots.files.dh_fields import plain
from casacal.robots.urdf_chain import MM, UrdfChain, origin_matrix

ATTRIBUTE = re.compile(rb"""\s([\w:.-]+)\s*=\s*("[^"]*"|'[^']*')""")


def urdf_text(result: CalibratedArm, source: str | Path | None = None) -> str:
    """The URDF with the calibrated origins; every other byte is that of the source, so it carries no remark.

    A number that is the same to twelve digits keeps its text; where a joint has no <origin> and needs one, it is put
    behind the joint's start tag.

    Args:
        result: of a robot built by `Robot.from_urdf`.
        source: the URDF; None takes the text that the result holds, else the file of that name beside the problem.

    Raises CasacalError for other robots, and for a source that is not the one the calibration began with.

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
        old = origin_matrix(joint)
        changed: dict[str, tuple[float, ...]] = {}
        if not np.allclose(new[:3, 3], old[:3, 3], rtol=0, atol=1e-9):
            changed["xyz"] = tuple(float(v) for v in new[:3, 3] / MM)
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
    _check_source(path, arm)
    data = path.read_bytes()
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        raise CasacalError(f"{path}: this is not UTF-8", "Save it as UTF-8; then only origins are edited") from None
    return data


def _check_source(path: Path, arm: UrdfChain) -> None:
    """Refuse a URDF in which the joints of the arm are not those the calibration began with."""
    there = UrdfChain.read(path, arm.chain[0].parent, arm.chain[-1].child, arm.conventions)
    fix = "Give the URDF that the problem was made from"
    if [joint.name for joint in there.chain] != [joint.name for joint in arm.chain]:
        raise CasacalError(f"{path}: the joints between base and tip are not those of the calibrated arm", fix)
    for one, two in zip(there.chain, arm.chain, strict=True):
        same = (one.kind, one.axis) == (two.kind, two.axis)
        if not same or not np.allclose((one.xyz, one.rpy), (two.xyz, two.rpy), rtol=0, atol=1e-9):
            raise CasacalError(f"{path}: joint '{one.name}' is not as it was when the calibration began", fix)


def _edits(
    data: bytes, joint: int, start: int | None, changed: dict[str, tuple[float, ...]]
) -> list[tuple[int, int, bytes]]:
    """What to replace, as (start, end, text), so that the origin that begins there, if any, has other xyz or rpy."""
    if start is None:
        at = _tag_end(data, joint)
        indent = re.match(rb"\s*", data[at:])
        said = b"".join(b' %s="%s"' % (key.encode(), _numbers(values)) for key, values in changed.items())
        return [(at, at, (indent.group(0) if indent else b"") + b"<origin" + said + b"/>")]
    tag = data[start : _tag_end(data, start)]
    edits = []
    for key, values in changed.items():
        found = [m for m in ATTRIBUTE.finditer(tag) if m.group(1) == key.encode()]
        if found:
            first, last = found[0].span(2)
            edits.append((start + first + 1, start + last - 1, _in_place(tag[first + 1 : last - 1], values)))
        else:
            at = start + len(b"<origin")
            edits.append((at, at, b' %s="%s"' % (key.encode(), _numbers(values))))
    return edits


def _in_place(text: bytes, values: tuple[float, ...]) -> bytes:
    """Three numbers in the blanks of the old ones; a number that is the same keeps its text."""
    if b"&" in text:  # written as character references: all afresh
        return _numbers(values)
    given = iter(values)

    def number(found: re.Match[bytes]) -> bytes:
        value = next(given)
        same = math.isclose(float(found.group(0)), value, rel_tol=1e-12, abs_tol=1e-12)
        return found.group(0) if same else plain(value).encode()

    return re.sub(rb"\S+", number, text)


def _numbers(values: tuple[float, ...]) -> bytes:
    return " ".join(plain(value) for value in values).encode()


def _tag_end(data: bytes, start: int) -> int:
    """Where the start tag that begins at `start` ends; quotes may hold a >."""
    found = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""").match(data, start)
    return found.end() if found else len(data)


def _places(data: bytes) -> tuple[dict[str, int], dict[str, int]]:
    """Where the joints of a URDF, and where their origins begin, in bytes."""
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

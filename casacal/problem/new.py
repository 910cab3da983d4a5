"""A problem folder for an arm that comes as a DH table or as a URDF: problem.py, README.md, and the URDF."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from casacal.errors import CasacalError, ProblemError
from casacal.problem.problem_file import load_problem
from casacal.robots.conventions import Conventions
from casacal.robots.dh_table import DHTable
from casacal.robots.files.decimals import degrees, plain
from casacal.robots.files.dh_file import read_dh_file
from casacal.robots.joints import Joint
from casacal.robots.urdf_chain import UrdfChain

WIDTH = 120
"""Longest line of a problem file."""

README = """# {name}

{origin}, with a dial indicator on flat faces.
Made by `casacal new`; edit it as you like.

- Prior: 0.7 mm and 1 mrad on each of the {count} parameters of the arm ({keys}), flat on the planes.
  Who knows the absolute accuracy that the maker states gives it to `casacal calibrate --accuracy`.
{more}- Noise: 0.01 mm along the plunger.
- Tool: the plunger's tip stands at the flange's origin and points along its z axis. Yours does not: measure where it
  is and write `DialOnPlane(noise_std=0.01, tool=tool_point(0, 0, 120, prior_std=1.0))`, with `tool_point` imported
  from casacal. A larger reading lengthens the tool unless `sign=-1` is given.
- Limits: those of the file{limits}. The simulated cell uses them.
- Cell: none is defined, so `casacal simulate` looks for three faces in reach.

What such touches could tell, before anyone moves the arm, and what they do tell:

    casacal simulate {folder} --out out/{name}.csv
    casacal check {folder} out/{name}.csv
    casacal calibrate {folder} out/{name}.csv --out out/{name}

Your own samples go into samples.csv beside this file.
"""

PARALLEL = """- Parallel axes: {axes}. There the common normal of DH would jump by metres, so Hayati's
  turn `beta` takes the place of `d`, which is held.
"""
REDUNDANT = """- Parameters are the origins of the joints that move: x, y, z and small turns rx, ry, rz of each
  joint's frame. That is more than touches can tell apart; the report names the redundant directions, and the prior
  holds them.
"""


def new_from_dh(name: str, path: str | Path, out: str | Path = ".") -> tuple[Path, DHTable]:
    """Write the folder `out`/`name` for a DH file; rows whose axes are parallel are found where the file names none.

    Returns the folder and the table. Raises CasacalError when the file cannot be read or the folder exists.
    """
    table = read_dh_file(path)
    if not table.parallel:
        table = replace(table, parallel=table.parallel_axes(), beta=())
    keys = ["alpha", "a", "d", "theta", *(["beta"] if table.parallel else [])]
    axes = ", ".join(f"{row} and {row + 1}" for row in table.parallel)
    folder = _folder(name, out)
    readme = README.format(
        name=name,
        origin=f"The {table.convention} DH table of {_word(table.name)} from {Path(path).name}",
        count=4 * len(table.alpha),  # beta takes the place of d
        keys=", ".join(keys),
        more=PARALLEL.format(axes=axes) if axes else "",
        limits=", +-180 degrees or +-1000 mm where it gives none",
        folder=folder.as_posix(),
    )
    problem = dh_problem_text(table, Path(path).name)
    return _written(folder, {"problem.py": problem.encode(), "README.md": readme.encode()}), table


def new_from_urdf(
    name: str, path: str | Path, out: str | Path = ".", *, tip: str | None = None, base: str | None = None
) -> tuple[Path, UrdfChain]:
    """Write the folder `out`/`name` for a URDF, with a copy of it.

    Returns the folder and the chain of joints. Raises CasacalError when it cannot be read or the folder exists.
    """
    arm = UrdfChain.read(path, base, tip, None)
    base, tip = arm.chain[0].parent, arm.chain[-1].child
    folder = _folder(name, out)
    readme = README.format(
        name=name,
        origin=f"The arm from link '{_word(base)}' to link '{_word(tip)}' of {arm.file}",
        count=6 * len(arm.moving),
        keys="x, y, z, rx, ry, rz",
        more=REDUNDANT,
        limits=", +-180 degrees for continuous joints",
        folder=folder.as_posix(),
    )
    problem = urdf_problem_text(arm, base, tip)
    files = {"problem.py": problem.encode(), "README.md": readme.encode(), arm.file: Path(path).read_bytes()}
    return _written(folder, files), arm


def dh_problem_text(table: DHTable, source: str) -> str:
    """Text of a problem.py with a DH table written out; `source` says where the table comes from."""
    turning = all(joint.turns for joint in table.joints)
    names = ["DialOnPlane", "Joint", "Problem", "Robot", "deg"]
    arguments = [_quoted(table.name)]
    for key, values in (("alpha", table.alpha), ("a", table.a), ("d", table.d), ("theta", table.theta)):
        arguments.append(f"{key}=" + (_angles(values) if key in ("alpha", "theta") else _lengths(values)))
    if turning:
        arguments.append('joints=[Joint("revolute", *deg(*limits)) for limits in LIMITS]')
    else:
        rows = [
            f'Joint("revolute", *deg({degrees(joint.lower)}, {degrees(joint.upper)}))'
            if joint.turns
            else f'Joint("prismatic", {plain(joint.lower)}, {plain(joint.upper)})'
            for joint in table.joints
        ]
        arguments.append("joints=" + _listed("[", rows, "]", 4, wide=True))
    if table.convention != "standard":
        arguments.append(f'convention="{table.convention}"')
    if table.parallel:
        arguments.append(f"parallel={_tuple(map(str, table.parallel))}")
    if any(table.beta):
        arguments.append(f"beta={_angles(table.beta)}")
    if table.conventions is not None:
        names.insert(0, "Conventions")
        arguments.append(f"conventions={_conventions(table.conventions, table.joints)}")
    text = f'"""{_word(table.name)} with a dial indicator on flat faces; the table is that of {_word(source)}."""\n\n'
    text += f"from casacal import {', '.join(names)}\n\n"
    if turning:
        limits = [f"({degrees(joint.lower)}, {degrees(joint.upper)})" for joint in table.joints]
        text += "# degrees, as the controller shows them\n"
        text += f"LIMITS = {_listed('[', limits, ']', 0, taken=len('LIMITS = '))}\n\n"
    text += "robot = Robot.from_dh(\n" + "".join(f"    {argument},\n" for argument in arguments) + ")\n"
    return text + "problem = Problem(robot, DialOnPlane(noise_std=0.01))\n"


def urdf_problem_text(arm: UrdfChain, base: str, tip: str) -> str:
    """Text of a problem.py that reads the URDF beside it."""
    given = [f"Path(__file__).with_name({_quoted(arm.file)})", f"base={_quoted(base)}", f"tip={_quoted(tip)}"]
    robot = _listed("(", given, ")", 0, taken=len("robot = Robot.from_urdf"))
    return (
        f'"""{_word(arm.name)} with a dial indicator on flat faces; the arm is that of {_word(arm.file)}."""\n\n'
        "from pathlib import Path\n\n"
        "from casacal import DialOnPlane, Problem, Robot\n\n"
        f"robot = Robot.from_urdf{robot}\n"
        "problem = Problem(robot, DialOnPlane(noise_std=0.01))\n"
    )


def _conventions(conventions: Conventions, joints: Sequence[Joint]) -> str:
    """The `Conventions(...)` of a table."""
    turns = [joint.turns for joint in joints]
    if all(turns):
        offsets = _angles(conventions.offsets)
    else:
        shown = (f"deg({degrees(o)})" if turn else plain(o) for o, turn in zip(conventions.offsets, turns, strict=True))
        offsets = _tuple(shown, 8)
    parts = [f"signs={_tuple(map(str, conventions.signs))}", f"offsets={offsets}"]
    if conventions.coupling:
        parts.append(f"coupling={_tuple(f'({i}, {j}, {plain(factor)})' for i, j, factor in conventions.coupling)}")
    return _listed("Conventions(", parts, ")", 4, taken=len("conventions="))


def _angles(values: Sequence[float]) -> str:
    """Angles in rad as deg(...); a tuple also where there is one alone."""
    if len(values) == 1:
        return f"(deg({degrees(values[0])}),)"
    return _listed("deg(", [degrees(value) for value in values], ")", 4, taken=8)


def _lengths(values: Sequence[float]) -> str:
    return _tuple(plain(value) for value in values)


def _tuple(items: Iterable[str], indent: int = 4) -> str:
    found = list(items)
    return f"({found[0]},)" if len(found) == 1 else _listed("(", found, ")", indent, taken=8)


def _listed(opening: str, items: list[str], closing: str, indent: int, *, taken: int = 0, wide: bool = False) -> str:
    """Items on one line where they fit behind `taken` characters, else one per line."""
    line = opening + ", ".join(items) + closing
    if not wide and indent + taken + len(line) + 1 <= WIDTH:
        return line
    inner = "".join(f"{' ' * (indent + 4)}{item},\n" for item in items)
    return f"{opening}\n{inner}{' ' * indent}{closing}"


def _quoted(text: str) -> str:
    """A Python string, between double quotes unless it holds one."""
    return repr(text) if '"' in text else json.dumps(text, ensure_ascii=False)


def _word(text: str) -> str:
    """A name for a sentence: one line, without what would end a docstring, not too long."""
    return " ".join(re.sub(r'["\\]', "", text).split())[:40] or "an arm"


def _folder(name: str, out: str | Path) -> Path:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        raise CasacalError(
            f"'{name}' cannot name a problem's folder", "Use letters, digits, _ and -; --out says where it goes"
        )
    folder = Path(out) / name
    if folder.exists():
        raise CasacalError(f"'{folder}' exists already", "Choose another name, or move it away")
    return folder


def _written(folder: Path, files: Mapping[str, bytes]) -> Path:
    """Write a folder beside its place, see that it loads, and only then put it there."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    except OSError as error:
        raise CasacalError(f"'{folder}' cannot be written ({error.strerror})", "Choose another place") from error
    try:
        for name, data in files.items():
            (draft / name).write_bytes(data)
        try:
            load_problem(draft).problem.models  # noqa: B018  (a problem that cannot be compiled is not handed over)
        except ProblemError as error:
            raise ProblemError(error.what.replace(str(draft), str(folder)), error.fix) from error
        shutil.rmtree(draft / "__pycache__", ignore_errors=True)
        draft.chmod(0o755)
        os.rename(draft, folder)
    except OSError as error:
        raise CasacalError(f"'{folder}' cannot be written ({error.strerror})", "Choose another place") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return folder

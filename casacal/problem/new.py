"""A problem folder for an arm that comes as a DH table or as a URDF: problem.py, README.md, and the URDF."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from casacal.errors import CasacalError, ProblemError
from casacal.files import writable
from casacal.problem.problem_file import load_problem
from casacal.problem.problem_text import Given, angles, conventions, imported, listed, quoted, tuple_of, word
from casacal.robots.dh_table import DHTable
from casacal.robots.files.dh_fields import degrees, plain
from casacal.robots.files.dh_file import read_dh_file
from casacal.robots.urdf_chain import UrdfChain
from casacal.values import EMPTY

README = """# {name}

{origin}, with a dial indicator on flat faces.
Made by `casacal new`; edit it as you like.

- Prior: 0.7 mm and 1 mrad on each of the {count} parameters of the arm ({keys}),
  unless problem.py states the maker's accuracy; flat on the planes.
{more}- Noise: 0.01 mm along the plunger.
- Lines of problem.py marked TO FILL IN hold assumptions: where the tool's tip is, which way the dial counts and
  how far, how accurate the maker says the arm is.
- Limits: those of the file{limits}. The simulated cell uses them.
- Cell: none is defined, so `casacal simulate` and `casacal plan` look for three faces in reach, in front of the base
  and above its plane (`--table Z` where the arm stands higher): at right angles, or, for an arm that cannot tilt its
  tool, such as a SCARA, each inclined another way. problem.py may define one of your own.

What such touches could tell, before anyone moves the arm, and what they do tell:

    casacal simulate {folder} --out out/{name}_samples.csv
    casacal check {folder} out/{name}_samples.csv
    casacal calibrate {folder} out/{name}_samples.csv --out out/{name}_fit

Your own samples go into samples.csv beside this file.
"""

PARALLEL = """- Parallel axes: {axes}. There the common normal of DH would jump by metres, so Hayati's
  turn `beta` takes the place of `d`, which is held.
"""
REDUNDANT = """- Parameters are the origins of the joints that move: x, y, z and small turns rx, ry, rz of each
  joint's frame. Touches cannot determine all of them; the report names the redundant directions, and the prior
  holds them.
"""


def new_from_dh(
    name: str, path: str | Path, out: str | Path = ".", *, given: Given | None = None
) -> tuple[Path, DHTable]:
    """Write the folder `out`/`name` for a DH file; rows whose axes are parallel are found where the file names none.

    `given` is what is known of dial and maker. Returns the folder and the table. Raises CasacalError when the file
    cannot be read or the folder exists.
    """
    table, source = read_dh_file(path), Path(path).name
    if not table.parallel:
        table = replace(table, parallel=table.parallel_axes(), beta=())
    axes = ", ".join(f"{row} and {row + 1}" for row in table.parallel)
    told = {
        "origin": f"The {table.convention} DH table of {word(table.name)} from {source}",
        "count": 4 * len(table.alpha),  # beta takes the place of d
        "keys": "alpha, a, d, theta" + (", beta" if axes else ""),
        "more": PARALLEL.format(axes=axes) if axes else "",
        "limits": ", +-180 degrees or +-1000 mm where it gives none",
    }
    return _written(name, out, told, dh_problem_text(table, source, given or Given())), table


def new_from_urdf(
    name: str,
    path: str | Path,
    out: str | Path = ".",
    *,
    tip: str | None = None,
    base: str | None = None,
    given: Given | None = None,
) -> tuple[Path, UrdfChain]:
    """Write the folder `out`/`name` for a URDF, with a copy of it.

    `given` is what is known of dial and maker. Returns the folder and the chain of joints. Raises CasacalError when it
    cannot be read or the folder exists.
    """
    arm = UrdfChain.read(path, base, tip, None)
    base, tip = arm.chain[0].parent, arm.chain[-1].child
    told = {
        "origin": f"The arm from link '{word(base)}' to link '{word(tip)}' of {arm.file}",
        "count": 6 * len(arm.moving),
        "keys": "x, y, z, rx, ry, rz",
        "more": REDUNDANT,
        "limits": ", +-180 degrees for continuous joints",
    }
    text = urdf_problem_text(arm, base, tip, given or Given())
    return _written(name, out, told, text, {arm.file: Path(path).read_bytes()}), arm


def dh_problem_text(table: DHTable, source: str, given: Given) -> str:
    """Text of a problem.py with a DH table written out; `source` says where the table comes from."""
    turning = all(joint.turns for joint in table.joints)
    names = ["Joint", "Problem", "Robot", "deg", *given.names]
    arguments = [quoted(table.name)]
    for key, values in (("alpha", table.alpha), ("a", table.a), ("d", table.d), ("theta", table.theta)):
        arguments.append(f"{key}=" + (angles(values) if key in ("alpha", "theta") else tuple_of(map(plain, values))))
    if turning:
        arguments.append('joints=[Joint("revolute", *deg(*limits)) for limits in LIMITS]')
    else:
        rows = [
            f'Joint("revolute", *deg({degrees(joint.lower)}, {degrees(joint.upper)}))'
            if joint.turns
            else f'Joint("prismatic", {plain(joint.lower)}, {plain(joint.upper)})'
            for joint in table.joints
        ]
        arguments.append("joints=" + listed("[", rows, "]", 4, wide=True))
    if table.convention != "standard":
        arguments.append(f'convention="{table.convention}"')
    if table.parallel:
        arguments.append(f"parallel={tuple_of(map(str, table.parallel))}")
    if any(table.beta):
        arguments.append(f"beta={angles(table.beta)}")
    if table.conventions is not None:
        names.append("Conventions")
        arguments.append(f"conventions={conventions(table.conventions, table.joints)}")
    text = f'"""{word(table.name)} with a dial indicator on flat faces; the table is that of {word(source)}."""\n\n'
    text += f"from casacal import {imported(names)}\n\n"
    if turning:
        limits = [f"({degrees(joint.lower)}, {degrees(joint.upper)})" for joint in table.joints]
        text += "# degrees, as the controller shows them\n"
        text += f"LIMITS = {listed('[', limits, ']', 0, taken=len('LIMITS = '))}\n\n"
    text += "robot = Robot.from_dh(\n" + "".join(f"    {argument},\n" for argument in arguments) + ")\n"
    return f"{text}\n{given.text}"


def urdf_problem_text(arm: UrdfChain, base: str, tip: str, given: Given) -> str:
    """Text of a problem.py that reads the URDF beside it."""
    read = [f"Path(__file__).with_name({quoted(arm.file)})", f"base={quoted(base)}", f"tip={quoted(tip)}"]
    robot = listed("(", read, ")", 0, taken=len("robot = Robot.from_urdf"))
    return (
        f'"""{word(arm.name)} with a dial indicator on flat faces; the arm is that of {word(arm.file)}."""\n\n'
        "from pathlib import Path\n\n"
        f"from casacal import {imported(['Problem', 'Robot', *given.names])}\n\n"
        f"robot = Robot.from_urdf{robot}\n\n{given.text}"
    )


def _written(
    name: str, out: str | Path, told: Mapping[str, Any], problem: str, files: Mapping[str, bytes] = EMPTY
) -> Path:
    """Write a folder beside its place, see that it loads, and only then put it there."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        raise CasacalError(
            f"'{name}' cannot name a problem's folder", "Use letters, digits, _ and -; --out says where it goes"
        )
    folder = Path(out) / name
    if folder.exists():
        raise CasacalError(f"'{folder}' exists already", "Choose another name, or move it away")
    readme = README.format(name=name, folder=folder.as_posix(), **told)
    with writable(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            for file, data in {"problem.py": problem.encode(), "README.md": readme.encode(), **files}.items():
                (draft / file).write_bytes(data)
            load_problem(draft).problem.models  # noqa: B018  (a problem that cannot be compiled is not handed over)
            shutil.rmtree(draft / "__pycache__", ignore_errors=True)
            draft.chmod(0o755)
            os.rename(draft, folder)
        except ProblemError as error:
            raise ProblemError(error.what.replace(str(draft), str(folder)), error.fix) from error
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    return folder

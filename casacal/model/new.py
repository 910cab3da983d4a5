"""A problem folder for an arm that comes as a DH table or as a URDF: problem.py, README.md, and the URDF."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from casacal.errors import CasacalError, ProblemError
from casacal.files import writable
from casacal.model.dh_file import read_dh_file
from casacal.model.dh_table import DHTable, degrees, plain
from casacal.model.problem_file import load_problem
from casacal.model.problem_text import Answers, angles, conventions, imported, listed, quoted, tuple_of, word
from casacal.model.urdf import UrdfChain
from casacal.pages.drawing import plain_text
from casacal.values import EMPTY


def new_from_dh(
    name: str, path: str | Path, out: str | Path = ".", *, answers: Answers | None = None
) -> tuple[Path, DHTable]:
    """Write the folder `out`/`name` for a DH file; rows whose axes are parallel are found where the file names none.

    answers: what the user knows of dial and maker. Returns folder and table. Raises CasacalError for a file that cannot
    be read, or a folder that exists.
    """
    table, source = read_dh_file(path), Path(path).name
    if table.name == Path(path).stem:  # which nobody chose
        table = replace(table, name=name)
    if not table.parallel:
        table = replace(table, parallel=table.parallel_axes(), beta=())
    context = {
        "origin": f"The {table.convention} DH table of {word(table.name)} from {source}",
        "count": 4 * len(table.alpha),  # beta takes the place of d
        "keys": "alpha, a, d, theta" + (", beta" if table.parallel else ""),
        "axes": ", ".join(f"{row} and {row + 1}" for row in table.parallel),
        "arm": word(table.name),
        "source": word(source),
    }
    answers = answers or Answers()
    return _written(name, out, {"urdf": False, **context, **_table_said(table, answers), **answers.context}), table


def new_from_urdf(
    name: str,
    path: str | Path,
    out: str | Path = ".",
    *,
    tip: str | None = None,
    base: str | None = None,
    answers: Answers | None = None,
) -> tuple[Path, UrdfChain]:
    """Write the folder `out`/`name` for a URDF, with a copy of it.

    answers: as for `new_from_dh`. Returns folder and chain of joints. Raises CasacalError as that does.
    """
    arm = UrdfChain.read(path, base, tip, None)
    base, tip = arm.chain[0].parent, arm.chain[-1].child
    answers = answers or Answers()
    read = [f"Path(__file__).with_name({quoted(arm.file)})", f"base={quoted(base)}", f"tip={quoted(tip)}"]
    context = {
        "origin": f"The arm from link '{word(base)}' to link '{word(tip)}' of {arm.file}",
        "count": 6 * len(arm.moving),
        "keys": "x, y, z, rx, ry, rz",
        "arm": word(arm.name),
        "source": word(arm.file),
        "names": imported(["Problem", "Robot", *answers.names]),
        "limits": "",
        "robot": "Robot.from_urdf" + listed("(", read, ")", 0, taken=len("robot = Robot.from_urdf")),
    }
    return _written(name, out, {"urdf": True, **context, **answers.context}, {arm.file: Path(path).read_bytes()}), arm


def _table_said(table: DHTable, answers: Answers) -> dict[str, str]:
    """Context of templates/problem.py.txt for a DH table: imports, joint limits, robot."""
    turning = all(joint.turns for joint in table.joints)
    names = ["Joint", "Problem", "Robot", "deg", *answers.names]
    arguments = [quoted(table.name)]
    for key, values in (("alpha", table.alpha), ("a", table.a), ("d", table.d), ("theta", table.theta)):
        arguments.append(f"{key}=" + (angles(values) if key in ("alpha", "theta") else tuple_of(map(plain, values))))
    if turning:
        arguments.append('joints=[Joint("revolute", *deg(*limits)) for limits in LIMITS]')
    else:
        rows = []
        for joint in table.joints:
            turn = f'Joint("revolute", *deg({degrees(joint.lower)}, {degrees(joint.upper)}))'
            rows.append(turn if joint.turns else f'Joint("prismatic", {plain(joint.lower)}, {plain(joint.upper)})')
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
    limits = [f"({degrees(joint.lower)}, {degrees(joint.upper)})" for joint in table.joints]
    return {
        "names": imported(names),
        "limits": listed("[", limits, "]", 0, taken=len("LIMITS = ")) if turning else "",
        "robot": listed("Robot.from_dh(", arguments, ")", 0, wide=True),
    }


def _written(name: str, out: str | Path, context: Mapping[str, object], files: Mapping[str, bytes] = EMPTY) -> Path:
    """Write a folder beside its place, see that it loads, and only then put it there."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        fix = "Use letters, digits, _ and -; --out says where it goes"
        raise CasacalError(f"'{name}' cannot name a problem's folder", fix)
    folder = Path(out) / name
    if folder.exists():
        raise CasacalError(f"'{folder}' exists already", "Choose another name, or move it away")
    context = {"name": name, "folder": folder.as_posix(), **context}
    made = {"problem.py": plain_text("problem.py.txt", context), "README.md": plain_text("readme.txt", context)}
    with writable(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            for file, data in ({file: text.encode() for file, text in made.items()} | dict(files)).items():
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

"""Problem files: a problem.py is run, and gives a problem and perhaps a cell."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError, came, said
from casacal.files import write_json
from casacal.model.problem import Problem
from casacal.model.robot import Robot, random_joints
from casacal.user_code import IMPORTED, line_of, run_file
from casacal.values import Array, Value

FILL_IN = "TO FILL IN"  # mark of a line that nobody has checked yet
CONVENTIONS = "conventions.json"  # beside problem.py: that the pendant's poses confirm its joint conventions
SAME_ARM = 0.05  # of its reach; corrected lengths move an arm less, other signs or offsets more
LARGEST_KEPT = 2_000_000  # bytes beyond which the text of a file is not kept with its hash


@dataclass(frozen=True)
class SourceFile:
    """A file that an arm was made from: its path, the SHA-256 of its bytes, and its text where that is not too long."""

    path: str
    sha256: str
    text: str = ""

    @staticmethod
    def read(path: str | Path) -> SourceFile:
        """The file as it is now; lets pass OSError."""
        data = Path(path).read_bytes()
        text = "" if len(data) > LARGEST_KEPT else data.decode("utf-8", errors="replace")
        return SourceFile(Path(path).as_posix(), hashlib.sha256(data).hexdigest(), text)


class Surroundings:
    """Protocol of `cell` in a problem.py: the surroundings of the arm."""


@dataclass(frozen=True, eq=False, repr=False)
class ProblemFile(Value):
    """A problem, and the problem.py it was read from; `cell` is a `Cell`, or None when the file defines none.

    A problem that was made in Python has the path "" and the SHA-256 of what it computes. `files` are all that it was
    made from: problem.py, problem files that it loads itself, modules beside it, the URDF or DH table of its arm.
    """

    name: str
    path: str
    sha256: str
    problem: Problem
    cell: Any
    files: tuple[SourceFile, ...] = ()

    @staticmethod
    def of(problem: Problem, name: str | None = None) -> ProblemFile:
        """A `ProblemFile` for a problem made in memory; its name is the robot's unless given."""
        return ProblemFile(name or problem.robot.name, "", problem.digest, problem, None, _files_of(problem, []))

    def __repr__(self) -> str:
        return f"<ProblemFile {self.name}{f' of {self.path}' if self.path else ''}: {self.problem!r}>"

    @property
    def samples(self) -> Path | None:
        """The samples file beside it, of the first of several instruments; None for a problem made in memory."""
        return self.samples_of(0)

    @property
    def assumed(self) -> str:
        """How many lines of its files nobody has checked yet, as a clause; empty where there are none."""
        marked = sum(file.text.count(FILL_IN) for file in self.files)
        lines = "1 line of the problem file is" if marked == 1 else f"{marked} lines of the problem file are"
        return f"{lines} marked {FILL_IN}: what stands there is assumed" if marked else ""

    @cached_property
    def confirmed(self) -> bool:
        """Whether poses off the pendant confirmed the joint conventions of this arm, and `keep_conventions` wrote it.

        A file of another arm counts for nothing: one whose places differ by a twentieth of its reach.
        Raises ProblemError for one that cannot be read.
        """
        file = Path(self.path).parent / CONVENTIONS
        if not self.path or not file.is_file():
            return False
        try:
            kept = json.loads(file.read_text(encoding="utf-8"))
            joints, places = (np.array(kept[key], dtype=np.float64) for key in ("joints", "flange_mm"))
            now = drawn_places(self.problem.robot, joints.reshape(-1, len(self.problem.robot.axes)))
            return bool(np.abs(places - now).max() <= SAME_ARM * np.abs(now).max())
        except (OSError, ValueError, KeyError, TypeError):
            fix = "Delete it, and run casacal doctor with --keep again"
            raise ProblemError(f"{file} is not what casacal doctor keeps", fix) from None

    def samples_of(self, instrument: int) -> Path | None:
        """The samples file of one instrument beside it: samples.csv, or samples-dial.csv where there are several."""
        if not self.path:
            return None
        several = len(self.problem.instruments) > 1
        name = f"samples-{self.problem.names[instrument]}.csv" if several else "samples.csv"
        return Path(self.path).parent / name


def drawn_places(robot: Robot, joints: Array) -> Array:
    """Origins (N, 3; mm) of the drawn arm's flange at joint values (N, n; rad, mm)."""
    q = ca.SX.sym("q", len(robot.axes))
    place = ca.Function("place", [q], [robot.traced.at_drawn(q)[:3, 3]])
    return np.array([np.array(place(row)).ravel() for row in joints])


def keep_conventions(source: ProblemFile, *, file: str, poses: int) -> Path:
    """Write beside problem.py that so many poses of a file, off the pendant, confirm its joint conventions."""
    robot = source.problem.robot
    joints = random_joints(robot, 4, np.random.default_rng(0))
    places, kept_in = drawn_places(robot, joints).tolist(), Path(source.path).parent / CONVENTIONS
    write_json(kept_in, {"poses": poses, "file": file, "joints": joints.tolist(), "flange_mm": places})
    return kept_in


def load_problem(path: str | Path) -> ProblemFile:
    """Read a problem folder (with a problem.py) or a problem file, which defines `problem` and may define `cell`.

    Raises ProblemError when there is none, when it raises, or when it defines something else.
    """
    if not isinstance(path, (str, Path)):
        raise ProblemError(f"Got {came(path)} as the path of a problem", "Give a folder with a problem.py")
    file = Path(path)
    if file.is_dir():
        file = file / "problem.py"
    if not file.is_file():
        below = [each for place in (Path(path), Path("problems")) for each in place.glob("*/problem.py")]
        near = sorted({p.parent.as_posix() for p in (*Path(path).parent.glob("problem.py"), *below)})
        known = f"; known here: {', '.join(near)}" if near else ""
        fix = f"Give a folder with a problem.py, or such a file{known}"
        raise ProblemError(f"There is no problem at '{path}'", fix)
    if file.suffix != ".py":
        fix = "Give a folder with a problem.py, or such a file; casacal new makes one from a URDF or a DH table"
        raise ProblemError(f"'{path}' is no problem file, which is a program in Python", fix)
    source = SourceFile.read(file)
    try:
        values = vars(run_file(file))
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        if isinstance(error, CasacalError):
            raise ProblemError(f"{line_of(file, error)}: {error.what}", error.fix) from error
        fix = "Mend the problem file"
        if isinstance(error, NameError):
            for home in ("casacal", "casacal.model"):
                if error.name in sys.modules[home].__all__:
                    fix = f"Add from {home} import {error.name}"
        raise ProblemError(f"{line_of(file, error)}: {said(error)}", fix) from error
    problem, cell = values.get("problem"), values.get("cell")
    if not isinstance(problem, Problem):
        what = "" if problem is None else f" as a Problem, but {came(problem)}"
        raise ProblemError(f"{file} does not define `problem`{what}", "Add problem = Problem(robot, DialOnPlane(...))")
    if cell is not None and not isinstance(cell, Surroundings):
        raise ProblemError(f"{file} defines `cell` as a {type(cell).__name__}", "Make it a Cell(...)")
    name = file.parent.name if file.name == "problem.py" and file.parent.name else file.stem
    name = "".join(letter if letter.isprintable() else "_" for letter in name)  # it stands in exports
    loaded = (each for value in values.values() if isinstance(value, ProblemFile) for each in value.files)
    files = tuple(dict.fromkeys((source, *loaded, *_files_of(problem, values.get(IMPORTED, ())))))
    return ProblemFile(name, file.as_posix(), source.sha256, problem, cell, files)


def _files_of(problem: Problem, modules: Iterable[str]) -> tuple[SourceFile, ...]:
    """Modules beside a problem file, and what its arm was read from, as they are now."""
    read = getattr(problem.robot.arm, "path", "")
    paths = dict.fromkeys(path for path in (*modules, read) if path.endswith(".py") or path == read)
    return tuple(SourceFile.read(path) for path in paths if path and Path(path).is_file())

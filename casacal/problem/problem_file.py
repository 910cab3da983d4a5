"""Problem files: a problem.py is run, and gives a problem and perhaps a cell."""

from __future__ import annotations

import hashlib
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from casacal.errors import CasacalError, ProblemError, came
from casacal.problem.cell import Cell
from casacal.problem.problem import Problem
from casacal.user_code import run_file
from casacal.values import Value


@dataclass(frozen=True, eq=False, repr=False)
class ProblemFile(Value):
    """A problem, and the problem.py it was read from; `cell` is None when the file defines none.

    A problem that was made in Python has the path "" and the SHA-256 of what it computes.
    """

    name: str
    path: str
    sha256: str
    problem: Problem
    cell: Cell | None

    @staticmethod
    def of(problem: Problem, name: str | None = None) -> ProblemFile:
        """The same for a problem made in memory; its name is the robot's unless given."""
        return ProblemFile(name or problem.robot.name, "", problem.digest, problem, None)

    def __repr__(self) -> str:
        return f"<ProblemFile {self.name}{f' of {self.path}' if self.path else ''}: {self.problem!r}>"

    @property
    def samples(self) -> Path | None:
        """The samples file beside it; None for a problem made in memory."""
        return Path(self.path).parent / "samples.csv" if self.path else None


def load_problem(path: str | Path) -> ProblemFile:
    """Read a problem folder (with a problem.py) or a problem file, which defines `problem` and may define `cell`.

    Raises ProblemError when there is none, when it raises, or when it defines something else.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "problem.py"
    if not file.is_file():
        near = sorted(p.parent.as_posix() for p in Path("problems").glob("*/problem.py"))
        known = f"; known here: {', '.join(near)}" if near else ""
        raise ProblemError(
            f"There is no problem at '{path}'", f"Give a folder with a problem.py, or such a file{known}"
        )
    source = file.read_bytes()
    values = _execute(file)
    problem, cell = values.get("problem"), values.get("cell")
    if not isinstance(problem, Problem):
        what = "" if problem is None else f" as a Problem: {came(problem).lower()} stands there"
        raise ProblemError(f"{file} does not define `problem`{what}", "Add problem = Problem(robot, DialOnPlane(...))")
    if cell is not None and not isinstance(cell, Cell):
        raise ProblemError(f"{file} defines `cell` as a {type(cell).__name__}", "Make it a Cell(...)")
    digest = hashlib.sha256(source).hexdigest()
    name = file.parent.name if file.name == "problem.py" and file.parent.name else file.stem
    return ProblemFile(name, file.as_posix(), digest, problem, cell)


def _execute(file: Path) -> dict[str, Any]:
    """What the file defines; raises ProblemError that names the line where it fails."""
    try:
        return vars(run_file(file))
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        places = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename) == file]
        line = getattr(error, "lineno", None) if isinstance(error, SyntaxError) else (places or [None])[-1]
        where = f"{file}, line {line}" if line else str(file)
        if isinstance(error, CasacalError):
            raise ProblemError(f"{where}: {error.what}", error.fix) from error
        said = " ".join(str(error).split()) or "no message"
        raise ProblemError(f"{where}: {type(error).__name__}: {said}", "Mend the problem file") from error

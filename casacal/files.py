"""Files at the edge: problem files in; results, truths, predictions and samples out. Written whole or not at all."""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import io
import json
import math
import os
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casacal.errors import CasacalError, ProblemError
from casacal.problem.cell import Cell
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples


@dataclass(frozen=True)
class ProblemFile:
    """A problem read from a problem.py, with where it came from; `cell` is None when the file defines none."""

    name: str
    path: str
    sha256: str
    problem: Problem
    cell: Cell | None

    @property
    def samples(self) -> Path:
        """The samples file beside it."""
        return Path(self.path).parent / "samples.csv"


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
        raise ProblemError(f"{file} does not define `problem`", "Add problem = Problem(robot, DialOnPlane(...))")
    if cell is not None and not isinstance(cell, Cell):
        raise ProblemError(f"{file} defines `cell` as a {type(cell).__name__}", "Make it a Cell(...)")
    digest = hashlib.sha256(source).hexdigest()
    name = file.parent.name if file.name == "problem.py" and file.parent.name else file.stem
    return ProblemFile(name, file.as_posix(), digest, problem, cell)


def _execute(file: Path) -> dict[str, Any]:
    spec = importlib.util.spec_from_file_location(f"casacal_problem_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise ProblemError(f"{file} is not a Python file", "Name it problem.py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        places = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename) == file]
        line = getattr(error, "lineno", None) if isinstance(error, SyntaxError) else (places or [None])[-1]
        where = f"{file}, line {line}" if line else str(file)
        if isinstance(error, CasacalError):
            raise ProblemError(f"{where}: {error.what}", error.fix) from error
        said = " ".join(str(error).split()) or "no message"
        raise ProblemError(f"{where}: {type(error).__name__}: {said}", "Mend the problem file") from error
    return vars(module)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file completely, then put it in place; raises CasacalError when it cannot."""
    place_whole(path, lambda place: place.write_bytes(text.encode("utf-8")))


def place_whole(path: str | Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it; raises CasacalError when it cannot."""
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=target.suffix)
    except OSError as error:
        raise CasacalError(f"'{target}' cannot be written ({error.strerror})", "Choose another place") from error
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
        os.replace(temporary, target)
    except OSError as error:
        raise CasacalError(f"'{target}' cannot be written ({error.strerror})", "Choose another place") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a document as JSON; numbers that are not finite become null, as JSON has none."""
    text = json.dumps(_plain(document), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def write_samples(path: str | Path, problem: Problem, samples: Samples, comments: Sequence[str]) -> None:
    """Write samples in the form `read_samples` reads: joints in degrees (prismatic: mm), readings in mm."""
    revolute = [joint.kind == "revolute" for joint in problem.robot.axes]
    header = [f"q{i + 1}_{'deg' if turn else 'mm'}" for i, turn in enumerate(revolute)]
    header += [f"{name}_mm" for name in samples.columns] + list(samples.labels)
    factors = np.where(revolute, 180 / math.pi, 1.0)
    text = io.StringIO()
    text.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for i in range(len(samples)):
        cells = [f"{value:.7f}" for value in samples.joints[i] * factors]
        cells += [f"{values[i]:.4f}" for values in samples.columns.values()]
        writer.writerow([*cells, *(labels[i] for labels in samples.labels.values())])
    write_text(path, text.getvalue())


def _plain(value: Any) -> Any:
    """Value made of JSON's own types."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value

"""What a calibration was asked for: problem and samples from any source, and where they came from."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from casacal.compensation.result_file import SCHEMA
from casacal.errors import CasacalError, came
from casacal.least_squares.result import Result
from casacal.problem.as_data import problem_data
from casacal.problem.problem import Problem
from casacal.problem.problem_file import ProblemFile, load_problem
from casacal.samples.measurements import Measurements
from casacal.samples.samples import Samples
from casacal.tables.read import is_frame

_LOG = logging.getLogger("casacal")


def head_of(source: ProblemFile, result: Result, seed: int, backend: str, folder: Path | None) -> dict[str, Any]:
    """The head of result.json in a folder; of a document that stays in memory where there is none."""
    files = [{**asdict(file), "path": seen_from(folder, file.path)} for file in source.files]
    try:
        arm = problem_data(source.problem)
    except CasacalError as error:
        arm = None
        _LOG.warning("casacal: the result needs its problem file, for it cannot hold the arm: %s", error)
    return {
        "schema": SCHEMA,
        "problem": {
            "name": source.name,
            "path": seen_from(folder, source.path),
            "sha256": source.sha256,
            "files": files,
        },
        "arm": arm,
        "method": result.method,
        "status": result.message,
        "converged": result.converged,
        "seed": seed,
        "backend": backend,
    }


def seen_from(folder: Path | None, file: str) -> str:
    """A path as a file in a folder names it; as it is where there is no folder, no such file, or no way between."""
    if folder is None or not file or not Path(file).exists():
        return file
    try:
        return Path(os.path.relpath(Path(file).resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return Path(file).resolve().as_posix()


def problem_from(given: Any) -> ProblemFile:
    """A problem with where it came from, from a problem, a problem file, or a path; raises CasacalError."""
    if isinstance(given, ProblemFile):
        return given
    if isinstance(given, Problem):
        return ProblemFile.of(given)
    if isinstance(given, (str, Path)):
        return load_problem(given)
    raise CasacalError(f"Got {came(given)} as the problem", "Give a Problem, what load_problem returns, or a path")


def samples_from(given: Any, source: ProblemFile) -> Samples | Measurements:
    """Samples of a problem's instrument, or of each by name; raises CasacalError."""
    problem = source.problem
    if len(problem.instruments) == 1:
        only = given.sets[0] if isinstance(given, Measurements) and len(given.sets) == 1 else given
        return samples_of(only, source, 0)
    if isinstance(given, Measurements):
        given = dict(zip(given.names, given.sets, strict=True))
    if given is None and source.samples is not None:
        given = dict.fromkeys(problem.names)
    names, wanted = ", ".join(problem.names), f'such as {{"{problem.names[0]}": ...}}'
    if not isinstance(given, Mapping):
        fix = f"Give those of each by name: {names}, {wanted}"
        raise CasacalError(f"Got {came(given)} as samples of {len(problem.names)} instruments", fix)
    for name in given:
        if name not in problem.names:
            fix = f"Give those of each by name: {names}, {wanted}"
            raise CasacalError(f"Samples came of '{name}', and no instrument is called that", fix)
    for name in problem.names:
        if name not in given:
            fix = f"Give them, or calibrate without it: problem.measured_by('{next(iter(given), name)}')"
            raise CasacalError(f"No samples came of the instrument '{name}'", fix)
    return Measurements(
        problem.names, tuple(samples_of(given[name], source, i) for i, name in enumerate(problem.names))
    )


def samples_of(given: Any, source: ProblemFile, i: int) -> Samples:
    """Samples of instrument `i` of a problem; raises CasacalError."""
    problem = source.problem
    layout = problem.layout(i)
    if isinstance(given, Samples):
        given.check(layout)
        return given
    if given is None and (beside := source.samples_of(i)) is not None:
        return problem.read(beside, i)
    if isinstance(given, (str, Path)):
        return problem.read(given, i)
    if is_frame(given):
        return Samples.from_frame(given, layout)
    if isinstance(given, Mapping):
        return Samples.from_arrays(given, layout)
    raise CasacalError(f"Got {came(given)} as samples", "Give Samples, a file, a pandas DataFrame, or arrays by column")

"""Problem and samples from any form in which people have them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from casacal.errors import CasacalError, came
from casacal.problem.problem import Problem
from casacal.problem.problem_file import ProblemFile, load_problem
from casacal.samples.measurements import Measurements
from casacal.samples.samples import Samples
from casacal.tables.read import is_frame


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

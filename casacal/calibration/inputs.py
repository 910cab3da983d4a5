"""Inputs of a calibration: problem and samples from any source, a method by name; and how that method is run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from casacal.data.samples import Measurements, Samples, is_frame
from casacal.data.text import Table
from casacal.errors import CasacalError, UnknownNameError, came
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Result, Status, as_result
from casacal.fit.methods import METHODS, method_of
from casacal.kernels.losses import Loss
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile, load_problem
from casacal.values import Array, Value

Progress: TypeAlias = Callable[[int, float], None]
Method: TypeAlias = Callable[..., Result | Array]

WORSE = 1e-9  # part of the drawing's cost by which an estimate may exceed it: rounding
AGREEMENT = 1e-8  # largest relative gap between the costs of two solvers that found the same minimum
NEGLIGIBLE = 1e-6  # a gap g in cost, however small the costs are: it is sqrt(2 g) posterior standard deviations away


def problem_from(source: Any) -> ProblemFile:
    """A problem with where it came from, from a problem, a problem file, or a path; raises CasacalError."""
    if isinstance(source, ProblemFile):
        return source
    if isinstance(source, Problem):
        return ProblemFile.of(source)
    if isinstance(source, (str, Path)):
        return load_problem(source)
    raise CasacalError(f"Got {came(source)} as the problem", "Give a Problem, what load_problem returns, or a path")


def samples_from(data: Any, source: ProblemFile) -> Samples | Measurements:
    """Samples of a problem's instrument, or of each by name; raises CasacalError."""
    problem = source.problem
    if len(problem.instruments) == 1:
        only = data.sets[0] if isinstance(data, Measurements) and len(data.sets) == 1 else data
        return samples_of(only, source, 0)
    if isinstance(data, Measurements):
        data = dict(zip(data.names, data.sets, strict=True))
    if data is None and source.samples is not None:
        data = dict.fromkeys(problem.names)
    fix = f'Give those of each by name: {", ".join(problem.names)}, such as {{"{problem.names[0]}": ...}}'
    if not isinstance(data, Mapping):
        raise CasacalError(f"Got {came(data)} as samples of {len(problem.names)} instruments", fix)
    for name in data:
        if name not in problem.names:
            raise CasacalError(f"Samples came of '{name}', and no instrument is called that", fix)
    for name in problem.names:
        if name not in data:
            fix = f"Give them, or calibrate without it: problem.measured_by('{next(iter(data), name)}')"
            raise CasacalError(f"No samples came of the instrument '{name}'", fix)
    return Measurements(problem.names, tuple(samples_of(data[name], source, i) for i, name in enumerate(problem.names)))


def samples_of(data: Any, source: ProblemFile, i: int) -> Samples:
    """Samples of instrument `i` of a problem; raises CasacalError."""
    problem, layout = source.problem, source.problem.layout(i)
    if isinstance(data, Samples):
        data.check(layout)
        return data
    if data is None and (file := source.samples_of(i)) is not None:
        return problem.read(file, i)
    if isinstance(data, (str, Path)):
        return problem.read(data, i)
    if isinstance(data, Table):
        return Samples.from_table(data, layout)
    if is_frame(data):
        return Samples.from_frame(data, layout)
    if isinstance(data, Mapping):
        return Samples.from_arrays(data, layout)
    raise CasacalError(f"Got {came(data)} as samples", "Give Samples, a file, a pandas DataFrame, or arrays by column")


def chosen(method: str | Method | None, loss: Loss | None) -> tuple[Method, str]:
    """The function that estimates, and what it is called."""
    if loss is not None and not isinstance(loss, Loss):
        raise CasacalError(f"Got {came(loss)} as the loss", "Give huber() or tukey()")
    if method is None:
        method = "sckf-lm" if loss is None else "lm"
    if not isinstance(method, str):
        if not callable(method) or hasattr(method, "options"):  # a study's Method takes a seed as well
            fix = f"Give a name ({', '.join(METHODS)}) or a function of the least-squares problem"
            raise CasacalError(f"Got {came(method)} as the method", fix)
        run, name = method, str(getattr(method, "__name__", type(method).__name__)).replace("_", "-")
    elif (own := method_of(method)) is not None:
        run, name = own, method
    else:
        raise UnknownNameError("method", method, METHODS)
    if loss is not None and method_of(name) is not run:
        fix = "Let it minimise problem.cost(x, loss) by itself, and leave the loss out here"
        raise CasacalError(f"The method '{name}' is a function of the problem alone, and takes no loss", fix)
    if loss is not None and (reason := METHODS[name].no_loss):
        known = ", ".join(each for each, own in METHODS.items() if not own.no_loss)
        raise CasacalError(f"The method '{name}' takes no loss: it {reason}", f"Use one of {known}")
    return run, name


def estimate(
    run: Method, name: str, fit: BoundProblem, seed: int, loss: Loss | None, progress: Progress | None
) -> Result:
    """Run a method: casacal's own with what they understand, others with the problem alone."""
    if method_of(name) is not run:
        return _judged(as_result(run(fit), fit, name))
    options: dict[str, Any] = {} if METHODS[name].quiet else {"progress": progress}
    if METHODS[name].random:
        options["seed"] = seed
    if loss is not None:
        options["loss"] = loss
    found = run(fit, **options)
    assert isinstance(found, Result)
    return _judged(found)


def _judged(found: Result) -> Result:
    """Fail a result whose cost is not finite or worse than the drawing's, or that is no minimum."""
    if not found.converged:
        return found
    if not math.isfinite(found.cost):
        return replace(found, status=Status.NOT_FINITE)
    drawn = found.problem.feasible(found.problem.x0)
    if found.cost > replace(found, x=drawn, information=None).cost * (1 + WORSE):
        return replace(found, status=Status.WORSE)
    if found.status is Status.ONE_PASS:
        problem, normal = found.problem, found.problem.normal(found.x)
        step_of = problem.damped_step if problem.constraints is None else problem.constrained_step
        step = step_of(found.x, normal, 0.0)
        # is the minimum farther than its spread explains, a chi-square of all unknowns?
        if step is not None and step.squared_length > problem.unknowns:
            return replace(found, status=Status.FAR)
    return found


@dataclass(frozen=True, eq=False)
class Reference(Value):
    """Result of an independent solver on the same objective."""

    solver: str
    result: Result
    cost: float  # the objective as that solver itself evaluated it
    relative_gap: float  # (cost of the method - cost of the reference) / cost of the reference

    @property
    def gap(self) -> float:
        """Cost of the method less that of the reference."""
        return self.relative_gap * max(self.cost, 1e-300)

    @property
    def limit(self) -> float:
        """Largest gap of two solvers that found the same minimum."""
        return max(AGREEMENT * self.cost, NEGLIGIBLE)

    @property
    def agrees(self) -> bool:
        """Whether both found the same minimum."""
        return self.result.converged and abs(self.gap) <= self.limit

"""The methods by name, one of them run, and what an independent solver finds on the same objective."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.errors import CasacalError, UnknownNameError, came
from casacal.estimators import annealing, ekf, evolution, ipopt, lm, plane_only, sckf, sckf_lm, swarm
from casacal.least_squares.losses import Loss
from casacal.least_squares.result import Result, Status, as_result
from casacal.values import Value

Progress: TypeAlias = Callable[[int, float], None]
Method: TypeAlias = Callable[..., Result | Array]

METHODS: Mapping[str, Method] = {
    "lm": lm,
    "sckf": sckf,
    "sckf-lm": sckf_lm,
    "ekf": ekf,
    "annealing": annealing,
    "swarm": swarm,
    "evolution": evolution,
    "ipopt": ipopt,
    "plane-only": plane_only,
}
"""The names the command line knows."""

RANDOM = ("annealing", "swarm", "evolution")
"""Methods that draw random numbers, to search a box of the geometry: that of effects beside it is too wide."""

WORSE = 1e-9  # part of the drawing's cost by which an estimate may exceed it: rounding


def chosen(method: str | Method | None, loss: Loss | None) -> tuple[Method, str]:
    """The function that estimates, and what it is called."""
    if loss is not None and not isinstance(loss, Loss):
        raise CasacalError(f"Got {came(loss)} as the loss", "Give huber() or tukey()")
    if method is None:
        method = "sckf-lm" if loss is None else "lm"
    if not isinstance(method, str):
        if not callable(method):
            fix = f"Give a name ({', '.join(METHODS)}) or a function of the least-squares problem"
            raise CasacalError(f"Got {came(method)} as the method", fix)
        name = str(getattr(method, "__name__", type(method).__name__)).replace("_", "-")
        return method, name
    if method not in METHODS:
        raise UnknownNameError("method", method, METHODS)
    if loss is not None and method != "lm":
        raise CasacalError(f"The method '{method}' knows no robust loss", "Use lm, or leave the method out")
    return METHODS[method], method


def estimate(
    run: Method, name: str, fit: BoundProblem, seed: int, loss: Loss | None, progress: Progress | None
) -> Result:
    """Run a method: casacal's own with what they understand, others with the problem alone."""
    if METHODS.get(name) is not run:
        return _judged(as_result(run(fit), fit, name))
    # controls and the reference have nothing to report on the way
    options: dict[str, Any] = {"progress": progress} if name not in ("ipopt", "plane-only") else {}
    if name in RANDOM:
        options["seed"] = seed
    if loss is not None:
        options["loss"] = loss
    found = run(fit, **options)
    assert isinstance(found, Result)
    return _judged(found)


def _judged(found: Result) -> Result:
    """A result with a status that fails where it is no estimate, which many methods cannot tell by themselves."""
    if not found.converged:
        return found
    if not math.isfinite(found.cost):
        return replace(found, status=Status.NOT_FINITE)
    if found.cost > replace(found, x=found.problem.x0, information=None).cost * (1 + WORSE):
        return replace(found, status=Status.WORSE)
    return replace(found, status=Status.FAR) if found.status is Status.ONE_PASS and _is_far(found) else found


def _is_far(found: Result) -> bool:
    """Whether the minimum beside an estimate is farther than its own spread explains, a chi-square of all unknowns."""
    step = found.problem.damped_step(found.x, found.problem.normal(found.x), 0.0)
    return step is not None and step.squared_length > found.problem.unknowns


AGREEMENT = 1e-8  # largest relative gap between the costs of two solvers that found the same minimum

NEGLIGIBLE = 1e-6
"""A gap in cost that means nothing, however small the costs are.

The cost is minus the logarithm of the posterior, so a gap g in it is a distance of sqrt(2 g) posterior standard
deviations: here little more than a thousandth of one. Costs of data that fit exactly are rounding, and so
is their ratio.
"""


@dataclass(frozen=True, eq=False)
class Reference(Value):
    """What an independent solver found on the same objective."""

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

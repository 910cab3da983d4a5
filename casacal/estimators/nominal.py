"""The control that does nothing: the arm as drawn, its planes fitted to it when the samples were bound."""

from __future__ import annotations

from dataclasses import replace

from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result, Status


def nominal(problem: LeastSquares) -> Result:
    """Return the prior's mean with the prior's covariance; evaluates nothing."""
    return Result(
        method="nominal",
        problem=problem,
        x=problem.x0.copy(),
        belief=problem.prior_covariance,
        status=Status.NOMINAL,
        trace={},
        steps=0,
        residual_rows=0,
        jacobian_rows=0,
    )


def nothing_unknown(problem: LeastSquares, method: str) -> Result:
    """What any method returns where every unknown is held: the arm as drawn, x of no entries."""
    assert not problem.unknowns
    return replace(nominal(problem), method=method)

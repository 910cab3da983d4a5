"""SciPy's trust region as a second reference: the same residuals and exact Jacobian, other steps."""

from __future__ import annotations

import numpy as np

from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result, Status, nothing_unknown

TOLERANCE = 1e-14


def scipy_least_squares(problem: LeastSquares, *, max_evaluations: int = 200) -> Result:
    """Minimise f by `scipy.optimize.least_squares` (trust region, exact Jacobian), the prior as further residuals.

    `max_evaluations` are of all residuals.
    """
    if not problem.unknowns:
        return nothing_unknown(problem, "trf")
    from scipy.optimize import least_squares  # a third of a second that other methods need not spend

    scale, pull = problem.start_std, problem.prior_rows * problem.start_std
    outcome = least_squares(
        lambda y: np.concatenate([problem.residual(problem.x0 + scale * y), pull @ y]),
        np.zeros(problem.unknowns),
        lambda y: np.vstack([problem.jacobian(problem.x0 + scale * y) * scale, pull]),
        method="trf",
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        gtol=TOLERANCE,
        max_nfev=max_evaluations,
    )
    x = problem.x0 + scale * outcome.x
    if not np.isfinite(outcome.cost):
        status = Status.NOT_FINITE
    else:
        status = Status.CONVERGED if outcome.success else Status.MAX_STEPS
    return Result(
        method="scipy",
        problem=problem,
        x=x,
        status=status,
        trace={"cost": np.array([outcome.cost])},
        steps=int(outcome.nfev),
        residual_rows=int(outcome.nfev) * problem.rows,
        jacobian_rows=int(outcome.njev) * problem.rows,
    )

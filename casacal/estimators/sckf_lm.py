"""The paper's method: Levenberg-Marquardt started at the square-root cubature Kalman filter's estimate (M7)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from casacal.estimators.lm import MAX_STEPS, lm
from casacal.estimators.nominal import nothing_unknown
from casacal.estimators.sckf import sckf
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result


def sckf_lm(
    problem: LeastSquares,
    *,
    max_steps: int = MAX_STEPS,
    tolerance: float = 1e-9,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Minimise f from the filter's estimate; the prior stays where it was, so the data count once.

    The minimum is that of `lm`: the filter gives another start, not more accuracy. Arguments as for `lm`.
    """
    if not problem.unknowns:
        return nothing_unknown(problem, "sckf-lm")
    filtered = sckf(problem, progress=progress)
    start = filtered.x if filtered.converged else None
    refined = lm(problem, start=start, max_steps=max_steps, tolerance=tolerance, progress=progress)
    return replace(
        refined,
        method="sckf-lm",
        trace={**refined.trace, "filter_x": filtered.trace["x"]},
        residual_rows=filtered.residual_rows + refined.residual_rows,
        jacobian_rows=filtered.jacobian_rows + refined.jacobian_rows,
    )

"""The paper's method: Levenberg-Marquardt started at the square-root cubature Kalman filter's estimate (M7)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from casacal.estimators.lm import MAX_STEPS, lm
from casacal.estimators.sckf import sckf
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result, nothing_unknown

UNUSUAL = 5.0  # standard deviations above its mean at which a chi-square calls for an explanation


def sckf_lm(
    problem: LeastSquares,
    *,
    max_steps: int = MAX_STEPS,
    tolerance: float = 1e-9,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Minimise f from the filter's estimate; the prior stays where it was, so the data count once.

    The minimum is that of `lm`: the filter gives another start, not more accuracy. Where that start leads to no
    minimum, or to one that is too high for the stated noise and priors, the drawing is tried as well and the lower
    minimum kept. With a loss the filter still takes every row at its full weight, `lm` not. Arguments as for `lm`.
    """
    if not problem.unknowns:
        return nothing_unknown(problem, "sckf-lm")
    part, places = problem.first_part() or (problem, np.arange(problem.unknowns))
    filtered = sckf(part, progress=progress)
    path = np.tile(problem.x0, (len(filtered.trace["x"]), 1))  # unknowns that the filter was spared stay at the nominal
    path[:, places] = filtered.trace["x"]
    start = path[-1] if filtered.converged else None
    tried = [lm(problem, start=start, max_steps=max_steps, tolerance=tolerance, loss=loss, progress=progress)]
    # at the true minimum 2 f is a chi-square with a degree for each row; above it a lower one may stand elsewhere
    likely = problem.rows + UNUSUAL * math.sqrt(2 * problem.rows)
    if start is not None and (not tried[0].converged or 2 * tried[0].cost > likely):
        tried.append(lm(problem, max_steps=max_steps, tolerance=tolerance, loss=loss, progress=progress))
    refined = min(tried, key=lambda found: (not found.converged, found.cost))
    return replace(
        refined,
        method="sckf-lm",
        trace={**refined.trace, "filter_x": path},
        residual_rows=filtered.residual_rows + sum(found.residual_rows for found in tried),
        jacobian_rows=filtered.jacobian_rows + sum(found.jacobian_rows for found in tried),
    )

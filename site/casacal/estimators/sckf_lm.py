"""The paper's method: Levenberg-Marquardt started at the square-root cubature Kalman filter's estimate (M7)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from casacal.array_types import Array
from casacal.estimators.lm import MAX_STEPS, lm
from casacal.estimators.nominal import nothing_unknown
from casacal.estimators.sckf import sckf
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result

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
    filtered, path = _filtered(problem, progress)
    start = path[-1] if filtered.converged else None
    tried = [lm(problem, start=start, max_steps=max_steps, tolerance=tolerance, loss=loss, progress=progress)]
    if start is not None and _doubtful(tried[0]):
        tried.append(lm(problem, max_steps=max_steps, tolerance=tolerance, loss=loss, progress=progress))
    refined = min(tried, key=lambda found: (not found.converged, found.cost))
    return replace(
        refined,
        method="sckf-lm",
        trace={**refined.trace, "filter_x": path},
        residual_rows=filtered.residual_rows + sum(found.residual_rows for found in tried),
        jacobian_rows=filtered.jacobian_rows + sum(found.jacobian_rows for found in tried),
    )


def _filtered(problem: LeastSquares, progress: Callable[[int, float], None] | None) -> tuple[Result, Array]:
    """The filter's result, and its means (rows + 1, n) of all unknowns, those that it was spared at the nominal."""
    part = problem.first_part()
    if part is None:
        found = sckf(problem, progress=progress)
        return found, found.trace["x"]
    first, places = part
    found = sckf(first, progress=progress)
    path = np.tile(problem.x0, (len(found.trace["x"]), 1))
    path[:, places] = found.trace["x"]
    return found, path


def _doubtful(found: Result) -> bool:
    """Whether a lower minimum may stand elsewhere: at the true one 2 f is a chi-square with a degree for each row."""
    rows = found.problem.rows
    return not found.converged or 2 * found.cost > rows + UNUSUAL * math.sqrt(2 * rows)

"""Extended Kalman filter for constant parameters and scalar measurements (M3).

The step as it is to be read; C takes the same one for all rows at once where casacal.kernels.backend says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from casacal.array_types import Array
from casacal.least_squares.objective import ExtendedPass, LeastSquares
from casacal.least_squares.result import Result, Status, nothing_unknown


def linear_update(
    mean: Array, covariance: Array, gradient: Array, innovation: float, noise_std: float
) -> tuple[Array, Array, float]:
    """Take in one scalar measurement linearised at the mean; returns mean, covariance and innovation std.

    Joseph's form, which keeps the covariance symmetric and positive.

    Args:
        mean, covariance: belief (n,), (n, n).
        gradient: of the predicted measurement at the mean (n,).
        innovation: measured minus predicted.
        noise_std: standard deviation of the measurement's error.

    """
    cross = covariance @ gradient
    variance = float(gradient @ cross) + noise_std**2
    gain = cross / variance
    half = covariance - np.outer(gain, cross)  # (I - K g') P, which as a matrix product loses a digit more
    updated = half - np.outer(half @ gradient - noise_std**2 * gain, gain)
    return mean + gain * innovation, (updated + updated.T) / 2, math.sqrt(variance)


def ekf(problem: LeastSquares, *, progress: Callable[[int, float], None] | None = None) -> Result:
    """One pass of the filter over the rows, from the prior (flat: `start_std`) to the posterior of f.

    Args:
        problem: its rows are measurements of zero with unit noise, in whitened units.
        progress: called with (rows done, size of the innovation) now and then.

    Returns the mean after the last row; the trace holds means `x` (rows + 1, n), innovations and their stds (rows,).

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "ekf")
    scale = problem.start_std
    mean, covariance = np.zeros(problem.unknowns), problem.prior_root @ problem.prior_root.T
    done = problem.extended_pass(mean, covariance)
    if done is None:
        done = _row_by_row(problem, mean, covariance, progress)
    elif progress is not None and problem.rows:
        progress(problem.rows, abs(float(done.innovations[-1])))
    finite = bool(np.isfinite(done.mean).all() and np.isfinite(done.covariance).all())
    means = np.vstack([problem.x0, problem.x0 + scale * done.means])
    return Result(
        method="ekf",
        problem=problem,
        x=problem.x0 + scale * done.mean,
        belief=scale[:, None] * done.covariance * scale,
        status=Status.ONE_PASS if finite else Status.NOT_FINITE,
        trace={"innovation": done.innovations, "innovation_std": done.stds, "x": means},
        steps=problem.rows,
        residual_rows=problem.rows,
        jacobian_rows=problem.rows,
    )


def _row_by_row(
    problem: LeastSquares, mean: Array, covariance: Array, progress: Callable[[int, float], None] | None
) -> ExtendedPass:
    """The pass where no fused kernel does it."""
    scale, means = problem.start_std, np.empty((problem.rows, mean.size))
    innovations, stds = np.empty(problem.rows), np.empty(problem.rows)
    for k in range(problem.rows):
        predicted, gradient = problem.row_jacobian(k, problem.x0 + scale * mean)
        innovations[k] = -predicted
        mean, covariance, stds[k] = linear_update(mean, covariance, scale * gradient, -predicted, 1.0)
        means[k] = mean
        if progress is not None:
            progress(k + 1, abs(predicted))
    return ExtendedPass(mean, covariance, means, innovations, stds)

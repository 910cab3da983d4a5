"""Extended Kalman filter for constant parameters and scalar measurements (M3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.least_squares import LeastSquares
from casacal.result import Result, Status

Array: TypeAlias = NDArray[np.float64]


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
    reduced = np.eye(mean.size) - np.outer(gain, gradient)
    updated = reduced @ covariance @ reduced.T + noise_std**2 * np.outer(gain, gain)
    return mean + gain * innovation, (updated + updated.T) / 2, math.sqrt(variance)


def ekf(problem: LeastSquares, *, progress: Callable[[int, float], None] | None = None) -> Result:
    """One pass of the filter over the rows, from the prior (flat: `start_std`) to the posterior of f.

    Args:
        problem: its rows are measurements of zero with unit noise, in whitened units.
        progress: called with (rows done, size of the innovation) after each row.

    """
    scale = problem.start_std
    mean, covariance = np.zeros(problem.unknowns), np.eye(problem.unknowns)
    trace: list[tuple[float, float]] = []
    means = [problem.x0]
    for k in range(problem.rows):
        predicted, gradient = problem.row_jacobian(k, problem.x0 + scale * mean)
        mean, covariance, innovation_std = linear_update(mean, covariance, scale * gradient, -predicted, 1.0)
        trace.append((-predicted, innovation_std))
        means.append(problem.x0 + scale * mean)
        if progress is not None:
            progress(k + 1, abs(predicted))
    innovation, innovation_stds = np.array(trace).reshape(-1, 2).T
    finite = bool(np.isfinite(mean).all() and np.isfinite(covariance).all())
    return Result(
        method="ekf",
        problem=problem,
        x=problem.x0 + scale * mean,
        belief=scale[:, None] * covariance * scale,
        status=Status.ONE_PASS if finite else Status.NOT_FINITE,
        trace={"innovation": innovation, "innovation_std": innovation_stds, "x": np.array(means)},
        steps=problem.rows,
        residual_rows=problem.rows,
        jacobian_rows=problem.rows,
    )

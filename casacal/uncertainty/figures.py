"""Figures of a fit: residuals on planes, found over stated noise, consistency."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.least_squares.objective import LeastSquares


def residual_figures(residuals: Array) -> dict[str, float]:
    """RMSE, MAE, STD (about the mean) and MAX of residuals (N,) in mm.

    Each by its right definition; the paper's eqs (30), (31) are not (errata E17, E18).
    """
    size = np.abs(residuals)
    return {
        "rmse_mm": math.sqrt(float((residuals**2).mean())),
        "mae_mm": float(size.mean()),
        "std_mm": float(residuals.std()),
        "max_mm": float(size.max()),
    }


def noise_interval(
    problem: LeastSquares, x: Array, covariance: Array, kept: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Found over stated noise: the estimate and its 95 % interval, from the whitened residuals at x.

    The residuals' sum of squares over its degrees of freedom, rows less the unknowns that the data determined.

    Args:
        problem: whose noise is judged.
        x: estimate (n,).
        covariance: of x (n, n).
        kept: rows (rows,) that count; a robust fit leaves out those that it down-weighted.

    """
    from scipy.special import gammaincinv

    if kept.all():
        information = problem.normal(x).information
    else:
        jacobian = problem.jacobian(x)[kept]
        information = jacobian.T @ jacobian
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    free = max(int(kept.sum()) - float((information * held).sum()), 1.0)
    total = float((problem.residual(x)[kept] ** 2).sum())
    # quantiles of chi-square with `free` degrees of freedom, without the half second that importing scipy.stats takes
    low, high = (total / (2 * float(gammaincinv(free / 2, p))) for p in (0.975, 0.025))
    return math.sqrt(total / free), math.sqrt(low), math.sqrt(high)


def nees(error: Array, covariance: Array) -> float:
    """Normalised estimation error squared: error' covariance^-1 error, chi-square with n degrees of freedom."""
    return float(error @ np.linalg.solve(covariance, error))

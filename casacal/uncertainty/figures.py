"""Figures of a fit: residuals on planes, found over stated noise, consistency."""

from __future__ import annotations

import math

import numpy as np

from casacal.array_types import Array
from casacal.least_squares.losses import Loss
from casacal.least_squares.result import Result
from casacal.uncertainty.leverage import effective_unknowns

HALF_WEIGHT = 0.5
"""Weight under a robust loss below which a row counts as ignored."""


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


def noise_interval(result: Result) -> tuple[float, float, float]:
    """Found over stated noise: the estimate and its 95 % interval, from the whitened residuals of a result.

    The residuals' sum of squares over its degrees of freedom, rows less the unknowns that the data determined. Rows of
    which a robust loss left less than half do not count.
    """
    problem, r = result.problem, result.problem.residual(result.x)
    kept = result.weights >= HALF_WEIGHT
    counting = None if kept.all() else _counting(result.loss)
    free = max(int(kept.sum()) - effective_unknowns(problem, result.x, counting), 1.0)
    return ratio_interval(float((r[kept] ** 2).sum()), free)


def ratio_interval(total: float, free: float) -> tuple[float, float, float]:
    """Root of a sum of squares over its degrees of freedom, and its 95 % interval by chi-square."""
    from scipy.special import gammaincinv  # scipy.stats takes half a second to import

    low, high = (total / (2 * float(gammaincinv(free / 2, p))) for p in (0.975, 0.025))
    return math.sqrt(total / free), math.sqrt(low), math.sqrt(high)


def _counting(loss: Loss | None) -> Loss:
    """A loss that counts rows of which another leaves half or more, and no others."""
    assert loss is not None

    def weight(r: Array) -> Array:
        return np.asarray((loss.weight(r) >= HALF_WEIGHT).astype(np.float64))

    return Loss("counting", lambda r: weight(r) * r**2 / 2, weight)


def chance_beyond(square: float, freedom: float) -> float:
    """Chance that chi-square of `freedom` degrees of freedom exceeds `square`."""
    from scipy.special import gammaincc  # scipy.stats takes half a second to import

    return float(gammaincc(freedom / 2, square / 2))


def nees(error: Array, covariance: Array) -> float:
    """Normalised estimation error squared: error' covariance^-1 error, chi-square with n degrees of freedom."""
    return float(error @ np.linalg.solve(covariance, error))

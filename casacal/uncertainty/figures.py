"""Figures of a fit: residuals on planes, found over stated noise, how much each row pulls its own fitted value."""

from __future__ import annotations

import math

import numpy as np

from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import LeastSquares, Result
from casacal.kernels.losses import Loss
from casacal.linalg import determined, svd
from casacal.values import Array

TOGETHER = 16_384  # rows whose Jacobian is held at a time
LARGE = 50_000  # rows among which it is no matter whether an unknown more or less was determined
HALF_WEIGHT = 0.5  # weight under a robust loss below which a row counts as ignored


def effective_unknowns(problem: LeastSquares, x: Array, loss: Loss | None = None) -> float:
    """Number of unknowns that the data determined at x (n,): the trace of the hat matrix, under any mix of priors.

    What constraints settle counts as none.
    """
    along, prior = problem.tangent(x), problem.prior_rows
    if problem.rows > LARGE:
        information = problem.normal(x, loss).information
        return determined(information if along is None else along.T @ information @ along, _along(prior, along))
    rows = _along(problem.weighted_rows(x, loss), along)
    if not np.isfinite(rows).all():
        return 0.0
    return float(((rows @ _inverse_root(rows, _along(prior, along))) ** 2).sum())


def _along(rows: Array, along: Array | None) -> Array:
    """Rows (k, n) by the unknowns that constraints leave; themselves where they leave all."""
    return rows if along is None else rows @ along


def leverages(bound: BoundProblem, result: Result) -> Array:
    """Leverage (rows,) of each row, w J (J'WJ + Lambda)^-1 J', W a loss's weights; right under flat priors too."""
    along = bound.tangent(result.x)
    held = _inverse_root(_along(bound.weighted_rows(result.x, result.loss), along), _along(bound.prior_rows, along))
    held = held if along is None else along @ held
    count, found = len(bound.measured), []
    for rows in np.array_split(np.arange(count), 1 + count // TOGETHER):
        part = bound if rows.size == count else bound.take(rows)
        found.append(((part.jacobian(result.x) @ held) ** 2).sum(axis=1))
    return np.asarray(np.clip(np.concatenate(found) * result.weights, 0.0, 1.0))


def _inverse_root(rows: Array, prior: Array) -> Array:
    """A matrix T (n, r) with T T' = (A'A + W'W)^+, by singular values of the rows A (k, n) and W of the prior."""
    stacked = np.vstack([rows, prior])
    sizes = np.linalg.norm(stacked, axis=0)
    scale = 1.0 / np.where(sizes > 0, sizes, 1.0)
    _, values, right = svd(stacked * scale)
    held = values > len(scale) * np.finfo(float).eps * values.max(initial=0.0)
    return np.asarray(scale[:, None] * right[held].T / values[held])


def rms(values: Array) -> float:
    """Root mean square of numbers."""
    return math.sqrt(float((values**2).mean()))


def residual_figures(residuals: Array) -> dict[str, float]:
    """RMSE, MAE, STD (about the mean) and MAX of residuals (N,) in mm.

    Each by its right definition; the paper's eqs (30), (31) are not (errata E17, E18).
    """
    size = np.abs(residuals)
    mean, spread, most = float(size.mean()), float(residuals.std()), float(size.max())
    return {"rmse_mm": rms(residuals), "mae_mm": mean, "std_mm": spread, "max_mm": most}


def noise_interval(result: Result) -> tuple[float, float, float]:
    """Found over stated noise: the estimate and its 95 % interval, from the whitened residuals of a result.

    The residuals' sum of squares over its degrees of freedom, rows less the unknowns that the data determined. Rows of
    which a robust loss left less than half do not count.
    """
    problem, loss, counting = result.problem, result.loss, None
    r, kept = problem.residual(result.x), result.weights >= HALF_WEIGHT
    if not kept.all():
        assert loss is not None

        def weight(r: Array) -> Array:
            return np.asarray((loss.weight(r) >= HALF_WEIGHT).astype(np.float64))

        counting = Loss("counting", lambda r: weight(r) * r**2 / 2, weight)
    free = max(int(kept.sum()) - effective_unknowns(problem, result.x, counting), 1.0)
    return ratio_interval(float((r[kept] ** 2).sum()), free)


def ratio_interval(total: float, free: float) -> tuple[float, float, float]:
    """Root of a sum of squares over its degrees of freedom, and its 95 % interval by chi-square."""
    from scipy.special import gammaincinv  # scipy.stats takes half a second to import

    low, high = (total / (2 * float(gammaincinv(free / 2, p))) for p in (0.975, 0.025))
    return math.sqrt(total / free), math.sqrt(low), math.sqrt(high)


def chance_beyond(square: float, freedom: float) -> float:
    """Chance that chi-square of `freedom` degrees of freedom exceeds `square`."""
    from scipy.special import gammaincc  # scipy.stats takes half a second to import

    return float(gammaincc(freedom / 2, square / 2))


def nees(error: Array, covariance: Array) -> float:
    """Normalised estimation error squared: error' covariance^-1 error, chi-square with n degrees of freedom."""
    return float(error @ np.linalg.solve(covariance, error))

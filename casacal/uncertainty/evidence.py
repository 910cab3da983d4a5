"""Sizes of non-geometric effects from the rows, by restricted marginal likelihood."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
from scipy.optimize import minimize

from casacal.fit.least_squares import LeastSquares
from casacal.values import Array, FrozenMapping, Index

MORE = 1.3  # noise as found over stated beyond which something errs that is larger than expected
LARGE = 50.0  # times its size of an effect of no physical size, from which the search then starts once more
HELD = (1.0, 1.0)  # doubt and most of a term whose size stays as it was declared
SMALLER = math.log(6.0)  # how much smaller than usual any effect may well be: some arms hardly have it
NOISE_DOUBT = 3.0  # times by which noise may well exceed what was stated
STOP = {"ftol": 1e-7}  # relative change of -2 log L below which sizes are found: a thousandth of any evidence
AT_BOUND = 2.0  # twice the logarithm of a likelihood that an effect at the largest size must gain over another top


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of linear rows, whitened: J'J (n, n), J'y (n,) and y'y."""

    information: Array
    toward: Array
    square: float

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """Normal equations of both sets of rows."""
        information, toward = self.information + other.information, self.toward + other.toward
        return NormalEquations(information, toward, self.square + other.square)

    def with_noise(self, times: float) -> NormalEquations:
        """Normal equations of rows with noise scaled by a factor."""
        return NormalEquations(self.information / times**2, self.toward / times**2, self.square / times**2)

    @staticmethod
    def of(slopes: Array, heights: Array) -> NormalEquations:
        """Normal equations of rows J (m, n) and y (m,)."""
        return NormalEquations(slopes.T @ slopes, slopes.T @ heights, float(heights @ heights))


def normal_equations(problem: LeastSquares, x: Array) -> NormalEquations:
    """Normal equations of all rows of a problem, linearised at x (n,): y = J (x - x0) - r."""
    normal, away = problem.normal(x), x - problem.x0
    information = normal.information
    square = 2 * (normal.cost - float(away @ normal.gradient)) + float(away @ information @ away)
    return NormalEquations(information, information @ away - normal.gradient, square)


def evidence(rows: NormalEquations, prior: Array) -> float:
    """Logarithm of the marginal likelihood of rows under means x0 and a prior's information (n, n), up to a constant.

    The constant depends on the rows alone. Unknowns without prior are projected out. -inf where rounding spoils it.
    """
    posterior = rows.information + prior
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(posterior), 1e-300))
    root, failed = dpotrf(scale[:, None] * posterior * scale, lower=1)
    if failed:
        return -np.inf
    at = scale * dpotrs(root, scale * rows.toward, lower=1)[0]
    firm = np.diagonal(prior) > 0
    beforehand = float(np.linalg.slogdet(prior[np.ix_(firm, firm)])[1])
    determinant = 2 * float(np.log(np.diagonal(root)).sum() - np.log(scale).sum()) - beforehand
    return -(rows.square - float(rows.toward @ at) + determinant) / 2


@dataclass(frozen=True)
class Sizes:
    """Size of each effect over its expected size, by key, and noise over the noise in use."""

    times: Mapping[str, float]
    noise: float
    evidence: float  # logarithm of the marginal likelihood, hyper-priors included


def effect_sizes(
    problem: LeastSquares,
    x: Array,
    effect_of: Sequence[str],
    known: Mapping[str, tuple[float, float]],
    *,
    stated: float = 1.0,
    least: float | None = 1.0,
    normal: NormalEquations | None = None,
    start: Mapping[str, float] | None = None,
    search: bool = True,
) -> Sizes:
    """Sizes of effects and of the noise at which the rows are likeliest.

    Args:
        problem: with unknowns of effects, at the sizes that are expected of them.
        x: where it is fitted (n,).
        effect_of: key of the effect that each unknown (n,) belongs to, empty for the geometry.
        known: for each effect the times by which its size may well be larger (one holds it; smaller by the square of
            them, up to six), and those that it never is.
        stated: stated noise over that with which the problem weighs its rows. These weights are the most: what geometry
            alone leaves in the rows is explained by effects in part, never made more.
        least: part of the stated noise that there is at least; None leaves the noise as it is.
        normal: normal equations of the rows at x; by default they are formed here.
        start: times by which effects are about as large, where that is known: nothing else is then tried.
        search: False stays at the start and only says how likely the rows are there.

    """
    keys = [key for key in dict.fromkeys(effect_of) if key]
    groups = [np.flatnonzero(np.array(effect_of) == key) for key in keys]
    sizes = [known.get(key, HELD) for key in keys]
    spread = np.array([math.log(doubt) for doubt, _ in sizes] + [math.log(NOISE_DOUBT)])
    most = np.array([math.log(times) for _, times in sizes])
    bounds = [(-m, m) if s > 0 else (0.0, 0.0) for s, m in zip(spread[:-1], most, strict=True)]
    bounds.append((math.log(stated * least), 0.0) if least else (0.0, 0.0))
    expected = np.append(np.zeros(len(keys)), math.log(stated))
    starts = [np.append([math.log((start or {}).get(key, 1.0)) for key in keys], 0.0)]
    # the likelihood has several tops where something large errs
    if start is None and stated * (least or 1.0) < 1 / MORE:
        starts.append(np.append(np.where(most > math.log(LARGE), math.log(LARGE), 0.0), 0.0))
    normal, prior = normal or normal_equations(problem, x), np.diagonal(problem.prior_information)
    joint = None if problem.known is None else problem.prior_information - np.diag(prior)
    args = (normal, problem.rows, prior, joint, groups, expected, spread)
    if search:
        found = [minimize(_objective, at, args, "L-BFGS-B", jac=True, bounds=bounds, options=STOP) for at in starts]
        tops = [(float(top.fun), top.x) for top in found]
        # of tops that are about as likely, the one at which fewer effects are larger than they may be
        cost, logs = min(tops, key=lambda top: top[0] + AT_BOUND * int((top[1][:-1] >= most)[most > 0].sum()))
    else:
        cost, logs = _objective(starts[0], *args)[0], starts[0]
    times = FrozenMapping({key: float(np.exp(t)) for key, t in zip(keys, logs[:-1], strict=True)})
    return Sizes(times, float(np.exp(logs[-1])), -cost / 2)


def _objective(
    logs: Array,
    normal: NormalEquations,
    rows: int,
    beforehand: Array,
    joint: Array | None,
    groups: Sequence[Index],
    expected: Array,
    spread: Array,
) -> tuple[float, Array]:
    """-2 log of the marginal likelihood and of the hyper-priors, and its gradient, by logarithms of sizes and noise.

    beforehand: diagonal (n,) of the prior's information. joint: what stands beside it (n, n), of geometry alone.
    """
    variance, prior = math.exp(2 * logs[-1]), beforehand.copy()
    for log, group in zip(logs[:-1], groups, strict=True):
        prior[group] *= math.exp(-2 * log)
    posterior = normal.information / variance
    posterior.flat[:: len(prior) + 1] += prior
    posterior = posterior if joint is None else posterior + joint
    scale = 1.0 / np.sqrt(np.diagonal(posterior))
    root, failed = dpotrf(scale[:, None] * posterior * scale, lower=1)
    if failed:
        return math.inf, np.zeros_like(logs)
    inverse = dpotri(root, lower=1)[0]
    spreads = np.diagonal(inverse) * scale**2
    x = scale * dpotrs(root, scale * normal.toward / variance, lower=1)[0]
    left = normal.square - 2 * float(normal.toward @ x) + float(x @ normal.information @ x)
    held = prior > 0
    determinant = 2 * float(np.log(np.diagonal(root)).sum() - np.log(scale).sum()) - float(np.log(prior[held]).sum())
    value = rows * 2 * logs[-1] + determinant + left / variance + float((prior * x**2).sum())
    moved = prior * (spreads + x**2)
    gradient = [2 * (group.size - float(moved[group].sum())) for group in groups]
    learnt = len(prior) - float((prior * spreads).sum())
    if joint is not None:
        value += float(x @ joint @ x)
        learnt -= 2 * float((np.tril(inverse, -1) * joint * np.outer(scale, scale)).sum())
    gradient.append(2 * (rows - learnt - left / variance))
    free = spread > 0
    off = logs - expected
    # no gear has six times the usual error and still turns, but many have a sixth of it; there is always some noise
    smaller = np.append(np.maximum(spread[:-1], np.minimum(2 * spread[:-1], SMALLER)), spread[-1])
    wide = np.where(free, np.where(off < 0, smaller, spread), 1.0)
    hyper = np.where(free, off / wide, 0.0)
    slope = hyper / wide
    return value + float(hyper @ hyper), np.array(gradient) + 2 * slope

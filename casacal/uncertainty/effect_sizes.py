"""How large effects beside the geometry are, as the rows show them: restricted marginal likelihood.

With J the Jacobian where the fit stands, y = J x - r and what is known of x beforehand, N(0, L^-1), a row's noise f:

    -2 log L = N log f^2 + log |L + A / f^2| - log |L| + min_x (|y - J x|^2 / f^2 + x' L x),    A = J'J,

flat unknowns projected out (Patterson and Thompson 1971). Of L only the part of the effects is found: each effect has
one size, log-normal about what one expects of it; priors of the geometry stay as they are, for evidence over these
prefers arms that nobody has built. All that is needed is in J'J, J'r and r'r, so that a million rows cost no more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
from scipy.optimize import minimize

from casacal.array_types import Array
from casacal.least_squares.objective import LeastSquares
from casacal.uncertainty.marginal_likelihood import Told, told
from casacal.values import FrozenMapping

MORE = 1.3
"""Noise as found over stated beyond which something errs that is larger than expected."""

LARGE = 50.0
"""Times its size of an effect of no physical size, from which the search then starts once more."""

NOISE_DOUBT = 3.0
"""Times by which noise may well exceed what was stated."""


STOP = {"ftol": 1e-7}
"""Change of -2 log L, relative, below which sizes are found: a thousandth of what would be any evidence."""


@dataclass(frozen=True)
class Sizes:
    """Times by which effects are larger than was expected of them, by key, and noise over what was used."""

    times: Mapping[str, float]
    noise: float
    evidence: float
    """Logarithm of the marginal likelihood, hyper-priors included."""


def effect_sizes(
    problem: LeastSquares,
    x: Array,
    beside: Sequence[str],
    known: Mapping[str, tuple[float, float]],
    *,
    stated: float = 1.0,
    least: float | None = 1.0,
    seen: Told | None = None,
    start: Mapping[str, float] | None = None,
    search: bool = True,
) -> Sizes:
    """Sizes of effects and of the noise at which the rows are likeliest.

    Args:
        problem: with unknowns of effects, at the sizes that are expected of them.
        x: where it is fitted (n,).
        beside: for each of its unknowns (n,) the effect that it belongs to, empty for those of the geometry.
        known: for each effect the times by which its size may well be off (one holds it), and those that it never is.
        stated: stated noise over that with which the problem weighs its rows. These weights are the most: what geometry
            alone leaves in the rows is explained by effects in part, never made more.
        least: part of the stated noise that there is at least; None leaves the noise as it is.
        seen: what the rows say at x, where that is known.
        start: times by which effects are about as large, where that is known: nothing else is then tried.
        search: False stays at the start and only says how likely the rows are there.

    """
    keys = [key for key in dict.fromkeys(beside) if key]
    groups = [np.flatnonzero(np.array(beside) == key) for key in keys]
    spread = np.array([math.log(known[key][0]) for key in keys] + [math.log(NOISE_DOUBT)])
    most = np.array([math.log(known[key][1]) for key in keys])
    bounds = [(-m, m) if s > 0 else (0.0, 0.0) for s, m in zip(spread[:-1], most, strict=True)]
    bounds.append((math.log(stated * least), 0.0) if least else (0.0, 0.0))
    expected = np.append(np.zeros(len(keys)), math.log(stated))
    starts = [np.append([math.log((start or {}).get(key, 1.0)) for key in keys], 0.0)]
    # the likelihood has several tops where something large errs
    if start is None and stated * (least or 1.0) < 1 / MORE:
        starts.append(np.append(np.where(most > math.log(LARGE), math.log(LARGE), 0.0), 0.0))
    given = (seen or told(problem, x), problem.rows, problem.prior_information, groups, expected, spread)
    if search:
        found = [minimize(_objective, at, given, "L-BFGS-B", jac=True, bounds=bounds, options=STOP) for at in starts]
        cost, logs = min(((float(top.fun), top.x) for top in found), key=lambda top: top[0])
    else:
        cost, logs = _objective(starts[0], *given)[0], starts[0]
    times = FrozenMapping({key: float(np.exp(t)) for key, t in zip(keys, logs[:-1], strict=True)})
    return Sizes(times, float(np.exp(logs[-1])), -cost / 2)


def _objective(
    logs: Array,
    seen: Told,
    rows: int,
    beforehand: Array,
    groups: Sequence[NDArray[np.intp]],
    expected: Array,
    spread: Array,
) -> tuple[float, Array]:
    """-2 log of the marginal likelihood and of the hyper-priors, and its gradient, by logarithms of sizes and noise."""
    variance, prior = math.exp(2 * logs[-1]), beforehand.copy()
    for log, group in zip(logs[:-1], groups, strict=True):
        prior[group] *= math.exp(-2 * log)
    posterior = seen.information / variance
    posterior.flat[:: len(prior) + 1] += prior
    scale = 1.0 / np.sqrt(np.diagonal(posterior))
    root, failed = dpotrf(scale[:, None] * posterior * scale, lower=1)
    if failed:
        return math.inf, np.zeros_like(logs)
    spreads = np.diagonal(dpotri(root, lower=1)[0]) * scale**2
    x = scale * dpotrs(root, scale * seen.toward / variance, lower=1)[0]
    left = seen.square - 2 * float(seen.toward @ x) + float(x @ seen.information @ x)
    held = prior > 0
    determinant = 2 * float(np.log(np.diagonal(root)).sum() - np.log(scale).sum()) - float(np.log(prior[held]).sum())
    value = rows * 2 * logs[-1] + determinant + left / variance + float((prior * x**2).sum())
    moved = prior * (spreads + x**2)
    gradient = [2 * (group.size - float(moved[group].sum())) for group in groups]
    learnt = len(prior) - float((prior * spreads).sum())
    gradient.append(2 * (rows - learnt - left / variance))
    free = spread > 0
    hyper = np.where(free, (logs - expected) / np.where(free, spread, 1.0), 0.0)
    slope = np.where(free, hyper / np.where(free, spread, 1.0), 0.0)
    return value + float(hyper @ hyper), np.array(gradient) + 2 * slope

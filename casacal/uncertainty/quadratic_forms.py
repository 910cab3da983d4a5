"""Chances of quadratic forms in normal variables: weighted sums of chi-squares, and their ratios to a plain one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import fdtrc, gammainc, gammaincc, ndtr

from casacal.array_types import Array

BEYOND = 36.0  # largest weight times this lies beyond what any such sum reaches: exp(-BEYOND / 2) of the chance
MOST_TERMS = 1 << 14

EQUAL = 1e-12  # part of the largest weight by which weights differ that are the same but for rounding
VANISHED = 1e-14  # size of a characteristic function from which on it adds nothing
SMALLEST = 1e-300

LARGEST = 0.99  # chance above which one test of several does not speak against the others any more
TAIL = 1e-8  # chance below which the sum of a series is mostly rounding, and a saddle point is nearer


def chance_beyond(weights: Array, squares: Array, rest: float, freedom: float) -> float:
    """Chance that sum w z^2 / (sum z^2 + rest) is so large, z (m,) of unit size, rest chi-square of some freedom.

    The size of all of them together does not matter: where noise is not known, it is the rest that tells it. Of one
    column this is Student's t. That the ratio exceeds c is that the sum of (w - c) z^2 less c times the rest is
    positive: by its characteristic function (Imhof, Biometrika 48, 1961; Davies, Biometrika 60, 1973), far out by a
    saddle point (Lugannani and Rice 1980).

    Args:
        weights: w (m,), positive.
        squares: z^2 (m,) as observed.
        rest: as observed.
        freedom: its degrees of freedom, one or more.

    """
    total = float(squares.sum()) + rest
    if not total > 0:
        return 1.0
    c = float(weights @ squares) / total
    sizes, counts = np.append(weights - c, -c), np.append(np.ones(len(weights)), freedom)
    if not (sizes > 0).any():
        return 0.0
    if np.ptp(weights) <= EQUAL * weights.max():
        return float(fdtrc(len(weights), freedom, float(squares.mean()) / (rest / freedom))) if rest > 0 else 0.0
    p = _inverted(sizes, counts)
    return p if p > TAIL else _saddle_point(sizes, counts)


def chance_below(sizes: Array, counts: Array, at: float) -> float:
    """Chance that a sum of chi-squares, each of a size and a freedom, (m,) and (m,), is no larger than `at`."""
    return 1.0 - _inverted(sizes, counts, at)


def chance_of_ratio(traces: Sequence[float], observed: float, freedom: float) -> float:
    """Chance that y'Ay / y'y is so large, y normal of some freedom, by the first three moments of the ratio.

    The ratio does not depend on the size of y, so its moments are those of the form over those of chi-square; between
    them lies a gamma distribution (Pearson's third).

    Args:
        traces: of A, A^2 and A^3 over the space of y.
        observed: the ratio.
        freedom: dimension of that space.

    """
    one, two, three = traces[0], 2 * traces[1], 8 * traces[2]
    first = one / freedom
    second = (two + one**2) / (freedom * (freedom + 2))
    third = (three + 3 * two * one + one**3) / (freedom * (freedom + 2) * (freedom + 4))
    variance = second - first**2
    if not variance > 0:
        return 1.0
    away = (observed - first) / math.sqrt(variance)
    skew = (third - 3 * first * second + 2 * first**3) / variance**1.5
    if abs(skew) < 1e-6:
        return float(ndtr(-away))
    shape = 4 / skew**2
    at = shape + away * math.copysign(math.sqrt(shape), skew)
    return float((gammaincc if skew > 0 else gammainc)(shape, max(at, 0.0)))


def together(chances: Sequence[float]) -> float:
    """One chance of several tests, however they depend on one another (Liu and Xie, JASA 115, 2020: by Cauchy's)."""
    least = min(chances)
    if least < TAIL:  # where a tangent is its own inverse
        return min(1 / sum(1 / max(p, SMALLEST) for p in chances) * len(chances), 1.0)
    mean = sum(math.tan((0.5 - min(p, LARGEST)) * math.pi) for p in chances) / len(chances)
    return 0.5 - math.atan(mean) / math.pi


def holm(chances: Sequence[float]) -> tuple[float, ...]:
    """Chances adjusted so that the least of many is no surprise (Holm, Scandinavian Journal of Statistics 6, 1979)."""
    found, largest = [0.0] * len(chances), 0.0
    for rank, k in enumerate(sorted(range(len(chances)), key=chances.__getitem__)):
        largest = max(largest, min((len(chances) - rank) * chances[k], 1.0))
        found[k] = largest
    return tuple(found)


def _inverted(sizes: Array, counts: Array, beyond: float = 0.0) -> float:
    """Chance that sum of size chi^2_count is beyond a number, from its characteristic function at odd steps."""
    largest = np.abs(sizes).max()
    sizes, beyond = sizes / largest, beyond / largest
    mean, spread = abs(float(sizes @ counts)), math.sqrt(2 * float(sizes**2 @ counts))
    step = 2 * math.pi / (mean + abs(beyond) + 2 * BEYOND + 8 * spread)
    total, first = 0.0, 0
    while first < MOST_TERMS:
        u = step * (np.arange(first, first + 512) + 0.5)
        angles = -beyond * u
        logs = np.zeros(len(u))
        for size, count in zip(sizes, counts, strict=True):
            angles += count / 2 * np.arctan(2 * size * u)
            logs += count / 4 * np.log1p((2 * size * u) ** 2)
        total += float((np.sin(angles) * np.exp(-logs) / u).sum()) * step
        if math.exp(-float(logs[-1])) / u[-1] < VANISHED:
            break
        first += 512
    return min(max(0.5 + total / math.pi, 0.0), 1.0)


def _saddle_point(sizes: Array, counts: Array) -> float:
    """The same far out in the upper tail, to a few hundredths of itself."""
    sizes = sizes / sizes.max()
    low, high = 0.0, 0.5
    for _ in range(200):
        t = (low + high) / 2
        slope = float((counts * sizes / (1 - 2 * t * sizes)).sum())
        low, high = (t, high) if slope < 0 else (low, t)
    t = (low + high) / 2
    cumulant = -float((counts * np.log1p(-2 * t * sizes)).sum()) / 2
    curvature = 2 * float((counts * (sizes / (1 - 2 * t * sizes)) ** 2).sum())
    w, v = math.sqrt(max(-2 * cumulant, 0.0)), t * math.sqrt(curvature)
    density = math.exp(cumulant) / math.sqrt(2 * math.pi)
    return max(float(ndtr(-w)) + density * (1 / v - 1 / w), 0.0)

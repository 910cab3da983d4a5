"""Paired statistics of methods that saw the same trials, each with its interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest, wilcoxon

from casacal.values import Array

RESAMPLES, AT_ONCE = 4000, 500
NO_DIFFERENCE = 1e-6  # relative; below it figures count as equal: where iterations stop is no property of a method


@dataclass(frozen=True)
class Interval:
    """A figure with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


@dataclass(frozen=True)
class Paired:
    """Comparison of two methods over trials that both finished: ratio of their figures, and Wilcoxon's p."""

    ratio: Interval  # geometric mean of the ratios; below one, the first method's figure is smaller
    p: float
    pairs: int
    wins: int  # pairs in which the first method's figure is smaller by more than iterations' tolerance
    losses: int


def mean_interval(values: Array) -> Interval:
    """Mean of values (N,) with its bootstrap percentile interval; not a number without values."""
    values = np.asarray(values, dtype=np.float64)
    if not values.size:
        return Interval(math.nan, math.nan, math.nan)
    rng = np.random.default_rng(0)
    draws = (values[rng.integers(values.size, size=(AT_ONCE, values.size))] for _ in range(RESAMPLES // AT_ONCE))
    means = np.concatenate([draw.mean(axis=1) for draw in draws])
    low, high = np.quantile(means, (0.025, 0.975))
    return Interval(float(values.mean()), float(low), float(high))


def paired(one: Array, other: Array) -> Paired:
    """Compare positive figures (N,), (M,) of two methods trial by trial, over the trials that both took part in.

    Pairs with a value that is not finite, such as failures, are left out and not counted.
    The ratio is the mean of log ratios with its bootstrap 95 % interval; p is of Wilcoxon's signed-rank test of
    those logarithms, ties left out, and one when nothing differs.
    """
    count = min(len(one), len(other))
    a, b = (np.asarray(values, dtype=np.float64)[:count] for values in (one, other))
    both = np.isfinite(a) & np.isfinite(b) & (a > 0) & (b > 0)
    logs = np.log(a[both] / b[both])
    differing = logs[np.abs(logs) > NO_DIFFERENCE]
    p = float(wilcoxon(differing).pvalue) if differing.size else 1.0
    mean = mean_interval(logs)
    ratio = Interval(math.exp(mean.value), math.exp(mean.low), math.exp(mean.high))
    return Paired(ratio, p, int(both.sum()), int((differing < 0).sum()), int((differing > 0).sum()))


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """p values adjusted for their number: S. Holm, A simple sequentially rejective multiple test procedure, 1979."""
    found, largest = dict(p_values), 0.0
    for rank, name in enumerate(sorted(p_values, key=lambda name: p_values[name])):
        largest = max(largest, min((len(p_values) - rank) * p_values[name], 1.0))
        found[name] = largest
    return found


def success_rate(successes: int, trials: int) -> Interval:
    """Fraction of trials that succeeded, with the exact 95 % interval of Clopper and Pearson (1934)."""
    if not trials:
        return Interval(math.nan, math.nan, math.nan)
    exact = binomtest(successes, trials).proportion_ci(method="exact")
    return Interval(successes / trials, float(exact.low), float(exact.high))


def quantiles(values: Sequence[float] | Array) -> tuple[float, float, float]:
    """Median, 95th percentile and maximum of the finite values; not a number without any."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return math.nan, math.nan, math.nan
    return float(np.median(finite)), float(np.quantile(finite, 0.95)), float(finite.max())

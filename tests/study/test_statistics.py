"""Paired statistics against closed forms and by their coverage."""

import math

import numpy as np
import pytest
from scipy.stats import beta, wilcoxon

from casacal.study.statistics import holm, mean_interval, paired, quantiles, success_rate


@pytest.mark.parametrize(("successes", "trials"), [(0, 20), (7, 20), (20, 20), (199, 200)])
def test_success_rates_are_those_of_clopper_and_pearson(successes, trials):
    rate = success_rate(successes, trials)
    low = beta.ppf(0.025, successes, trials - successes + 1) if successes else 0.0
    high = beta.ppf(0.975, successes + 1, trials - successes) if successes < trials else 1.0
    assert (rate.value, rate.low, rate.high) == pytest.approx((successes / trials, low, high))


def test_holm_steps_down():
    adjusted = holm({"a": 0.01, "b": 0.04, "c": 0.03, "d": 0.005})
    assert adjusted == pytest.approx({"d": 0.02, "a": 0.03, "c": 0.06, "b": 0.06})
    assert list(adjusted) == ["a", "b", "c", "d"]
    assert holm({"a": 0.9, "b": 0.8}) == {"a": 1.0, "b": 1.0}


def test_a_ratio_is_found_with_its_interval():
    rng = np.random.default_rng(0)
    other = rng.lognormal(size=400)
    one = other * 1.3 * rng.lognormal(sigma=0.2, size=400)
    found = paired(one, other)
    assert found.ratio.low < 1.3 < found.ratio.high
    assert found.ratio.value == pytest.approx(math.exp(np.log(one / other).mean()))
    assert found.ratio.high - found.ratio.low == pytest.approx(1.3 * 2 * 1.96 * 0.2 / 20, rel=0.15)
    assert found.p == pytest.approx(wilcoxon(np.log(one / other)).pvalue)
    assert found.wins + found.losses == found.pairs == 400


def test_rounding_is_no_difference_and_failures_are_no_pairs():
    one = np.array([1.0, 2.0, np.nan, 4.0, 5.0])
    found = paired(one * (1 + 1e-9), np.array([1.0, 2.0, 3.0, np.inf, 5.0, 6.0]))
    assert (found.pairs, found.wins, found.losses, found.p) == (3, 0, 0, 1.0)
    assert math.isnan(paired(np.array([np.nan]), np.array([1.0])).ratio.value)


def test_intervals_of_means_cover_as_they_say():
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        interval = mean_interval(rng.normal(size=100))
        hits += interval.low <= 0 <= interval.high
    assert success_rate(hits, 200).low <= 0.95 <= success_rate(hits, 200).high + 0.03


def test_quantiles_skip_what_is_not_finite():
    assert quantiles([1.0, np.nan, 3.0, 2.0]) == (2.0, pytest.approx(2.9), 3.0)
    assert all(math.isnan(value) for value in quantiles([]))

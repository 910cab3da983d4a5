"""A certificate that is not of this arm, against what rows and priors say without it."""

import dataclasses
import math

import numpy as np
import pytest

from casacal import Problem, bind, calibrate, lm
from casacal.calibration.verdict import CERTIFIED, certificates
from casacal.model import certified

STD = 0.05


@pytest.fixture(scope="module")
def without(hsr, corner_simulation):
    """Sum of two link lengths as fitted without a certificate, its standard deviation, and the true sum."""
    result = lm(bind(hsr.problem, corner_simulation.samples))
    h = np.array([name in ("a1", "a2") for name in result.problem.names], dtype=float)
    drawn = sum(float(v) for v in hsr.problem.robot.parameters["a"].nominal[:2])
    return drawn, drawn + h @ result.x, math.sqrt(h @ result.covariance @ h)


def told(hsr, samples, value):
    constraint = certified("both", lambda p: p.a[0] + p.a[1], value, std=STD)
    problem = Problem(hsr.problem.robot, *hsr.problem.instruments, constraints=(constraint,))
    return calibrate(problem, samples, method="lm", reference=False, discrepancy="none")


def test_it_is_compared_with_what_the_rows_say_without_it(hsr, corner_simulation, without):
    drawn, by_rows, std = without
    (found,) = certificates(told(hsr, corner_simulation.samples, drawn + 0.4).unjudged)
    assert found.otherwise == pytest.approx(by_rows, abs=0.02 * std)  # noise as found moves it by that
    assert found.off == pytest.approx((drawn + 0.4 - by_rows) / math.hypot(std, STD), rel=0.05)


def test_one_that_the_rows_contradict_is_refused_and_named(hsr, corner_simulation, without):
    _drawn, by_rows, std = without
    far = told(hsr, corner_simulation.samples, by_rows + 1.5 * CERTIFIED * math.hypot(std, STD))
    assert far.verdict.level == "do not use"
    assert "'both', certified as" in far.verdict.reasons[0]
    right = told(hsr, corner_simulation.samples, by_rows + 1.0 * math.hypot(std, STD))
    assert "certified" not in right.verdict.words + "".join(right.verdict.reasons)


def test_rows_that_see_nothing_leave_it_to_the_priors(hsr, corner_simulation, without):
    drawn, _, _ = without
    stds = hsr.problem.robot.parameters["a"].prior_stds[:2]
    blind = dataclasses.replace(hsr, problem=hsr.problem.with_settings({"noise_std": 500.0}))
    (one,) = certificates(told(blind, corner_simulation.samples, drawn + 0.3).unjudged)
    assert one.off == pytest.approx(0.3 / math.hypot(*stds, STD), rel=0.01)
    assert one.otherwise == pytest.approx(drawn, abs=0.01)

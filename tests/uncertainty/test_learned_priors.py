"""By what to scale priors: arms drawn with a known spread say so, and one arm says how little it knows."""

import math

import numpy as np
import pytest
from instruments_on_ur5 import ROBOT, TOOL

from casacal import CasacalError, Problem, TrackedPoint, calibrate, load_problem, simulate, tool_point
from casacal.simulation import Disturbances
from casacal.uncertainty import LearnedPriors, learned_priors

TRACKER = Problem(ROBOT, TrackedPoint(noise_std=0.05, tool=tool_point(*TOOL, prior_std=1.0)))


def arms(scale, count, problem=TRACKER, rows=60, first=0):
    """Calibrations, with the default prior, of arms that are so many times as far from their drawing."""
    cell = Disturbances(resolution=0.0, repeatability=0.0)
    drawn = LearnedPriors({"mm": scale, "rad": scale}, {}, 1).of(problem)
    made = (simulate(drawn, cell, samples=rows, seed=first + k).samples for k in range(count))
    return [calibrate(problem, rows, reference=False, discrepancy="none") for rows in made]


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_the_spread_of_arms_is_found(scale):
    found = learned_priors(arms(scale, 8))
    assert found.arms == 8
    for unit in ("mm", "rad"):
        low, high = found.intervals[unit]
        assert low < found.times[unit] < high
        assert found.times[unit] == pytest.approx(scale, rel=0.25)
        assert 1.2 < high / low < 2


def test_arms_far_from_their_drawing_are_not_judged_by_a_fit_that_is_bent():
    """At twenty times the prior; where the fits stood under it, angles seemed a hundred times as large."""
    found = learned_priors(arms(20.0, 6))
    assert dict(found.times) == pytest.approx({"mm": 20.0, "rad": 20.0}, rel=0.3)


def test_one_arm_s_intervals_hold():
    """Of 24 arms of two sizes 95 % of the intervals hold: 43 of 48 or fewer has a chance of 3 in 100."""
    held = 0
    for k in range(24):
        scale = 1.0 if k % 2 else 2.5
        found = learned_priors(arms(scale, 1, first=100 + k))
        held += sum(low < scale < high for low, high in found.intervals.values())
    assert held >= 43


@pytest.mark.long
def test_lengths_and_angles_have_factors_of_their_own():
    wide = TRACKER.with_prior({"a": 2.8, "d": 2.8})  # four times the default
    cell = Disturbances(resolution=0.0, repeatability=0.0)
    made = [simulate(wide, cell, samples=60, seed=k).samples for k in range(8)]
    found = learned_priors(calibrate(TRACKER, rows, reference=False, discrepancy="none") for rows in made)
    assert found.times["mm"] == pytest.approx(4, rel=0.25)
    assert found.times["rad"] == pytest.approx(1, rel=0.25)
    better = found.of(TRACKER)
    stds = {
        name: std
        for key, unknown in better.robot.parameters.items()
        for name, std in zip(unknown.names(key), unknown.prior_stds, strict=True)
    }
    assert stds["a2"] == pytest.approx(0.7 * found.times["mm"])
    assert stds["theta3"] == pytest.approx(1e-3 * found.times["rad"])
    known = [calibrate(problem, made[0].take(range(14)), reference=False) for problem in (better, TRACKER)]
    assert known[0].tip_std[0] > 2 * known[1].tip_std[0], "the prior's own error of the tip"


def test_a_dial_says_so_too():
    source = load_problem("problems/ur5")
    cell = source.cell
    made = [simulate(source.problem, cell, samples=100, seed=k).samples for k in range(6)]
    found = learned_priors(calibrate(source.problem, rows, reference=False) for rows in made)
    assert dict(found.times) == pytest.approx({"mm": 1.0, "rad": 1.0}, rel=0.25)
    assert "6 arms show them: mm times" in repr(found)


def test_what_cannot_be_learned_from_is_said():
    one = arms(1.0, 1)[0]
    with pytest.raises(CasacalError, match="No calibrations came"):
        learned_priors([])
    with pytest.raises(CasacalError, match="Got a str as a calibration"):
        learned_priors(["result.json"])
    with pytest.raises(CasacalError, match="of the same rows"):
        learned_priors([one, one])
    with pytest.raises(CasacalError, match="as a calibration"):
        learned_priors(None)
    assert learned_priors(one).arms == 1
    other = calibrate(TRACKER.with_prior({"a": 0.1}), one.samples, reference=False, discrepancy="none")
    with pytest.raises(CasacalError, match="different priors"):
        learned_priors([one, other])
    held = TRACKER.fix(*(key for key, unknown in ROBOT.parameters.items() if unknown.size))
    bare = calibrate(held, one.samples, reference=False, discrepancy="none")
    with pytest.raises(CasacalError, match="no parameter with a finite prior"):
        learned_priors([bare])


def test_it_is_a_value():
    one = LearnedPriors({"mm": 2.0}, {"mm": (1.0, 4.0)}, 1)
    assert one == LearnedPriors({"mm": 2.0}, {"mm": (1.0, 4.0)}, 1)
    assert "1 arm shows them: mm times 2 (1 to 4)" in repr(one)
    flat = LearnedPriors({"mm": 2.0}, {"mm": (0.0, math.inf)}, 1).of(TRACKER.with_prior({"theta": math.inf}))
    assert np.isinf(flat.robot.parameters["theta"].prior_stds).all()

"""Optimal control with a calibrated arm: the plan is the quickest there is, and misses what its arm errs by."""

import numpy as np
import pytest

from casacal import lm, nominal
from studies import quickest_move
from studies.quickest_move import PUSH, SPEED, STEPS, frame_of, quickest


@pytest.fixture(scope="module")
def move():
    return quickest_move.study.settings["ur5"].trial(4)


def test_the_plan_keeps_the_limits_and_is_as_quick_as_they_allow(move):
    start = move.heldout.block.samples.joints[0]
    target = move.problem.tips(move.truth, move.heldout.block.samples.joints[3:4])[0]
    plan = quickest(move.tip_function(move.truth), start, target)
    np.testing.assert_allclose(plan.joints[0], start, atol=1e-8)
    np.testing.assert_allclose(move.problem.tips(move.truth, plan.joints[-1:])[0], target, atol=1e-4)
    h = plan.seconds / STEPS
    speeds = np.diff(plan.joints, axis=0) / h  # the mean of each step
    assert np.abs(speeds).max() < SPEED * (1 + 1e-6)
    assert np.abs(np.diff(speeds, axis=0) / h).max() < PUSH * (1 + 1e-6)
    # the joint with the farthest way decides: it speeds up, coasts where that is the limit, and brakes
    way = np.abs(plan.joints[-1] - plan.joints[0]).max()
    least = 2 * np.sqrt(way / PUSH) if way < SPEED**2 / PUSH else way / SPEED + SPEED / PUSH
    assert least * (1 - 1e-6) < plan.seconds < 1.05 * least


def test_the_drawn_arm_misses_by_its_error_and_the_calibrated_one_hardly(move):
    drawn, calibrated = move.judge(nominal(move.problem)), move.judge(lm(move.problem))
    for found in (drawn, calibrated):
        assert found["planned_um"] < 0.1
    assert drawn["miss_mm"] > 1.0 > 10 * calibrated["miss_mm"]
    assert drawn["miss_mm"] < 5 * drawn["tip_rms_mm"]
    assert calibrated["miss_mm"] < 5 * calibrated["tip_rms_mm"]


def test_the_frame_of_three_marks():
    frame = frame_of(np.array([[1.0, 2, 3], [1, 5, 3], [0, 2, 3]]))
    np.testing.assert_allclose(frame, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)

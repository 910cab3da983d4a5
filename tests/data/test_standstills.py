"""Lines as a recorder writes them, many a standstill, count once and raise nothing."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT

from casacal import Samples, calibrate, check, load_problem
from casacal.data.repeats import copies_of, once_each, standstills, without_copies

LINES = 20


def measured(name):
    source = load_problem(ROOT / "problems" / name)
    return source.problem, source.problem.read(source.samples)


def recorded(samples, noise, *, lines=LINES, seed=0):
    """Every row so many times, with noise of encoders and, of another size, of readings."""
    rng, rows = np.random.default_rng(seed), samples.take(np.repeat(np.arange(len(samples)), lines))
    columns = {name: values + noise * rng.normal(size=len(values)) for name, values in rows.columns.items()}
    joints = rows.joints + 2e-5 * rng.normal(size=rows.joints.shape)
    return replace(rows, joints=joints, columns=columns, lines=tuple(range(2, len(rows) + 2)))


def means(values):
    return values.reshape(-1, LINES, *values.shape[1:]).mean(axis=1)


@pytest.mark.parametrize("name", ["instruments/tracker", "instruments/camera"])
def test_a_recording_raises_what_its_rows_raise(name):
    problem, samples = measured(name)
    many = recorded(samples, 1e-5)
    assert [(each.severity, each.about) for each in check(problem, many)] == [("remark", "recorded standstills")]
    result, once = calibrate(problem, many, reference=False), calibrate(problem, samples, reference=False)
    assert result.verdict.level == once.verdict.level == "calibrated"
    assert result.tip_std[1] == pytest.approx(once.tip_std[1], rel=0.05)
    assert result.copies == (LINES - 1) * len(samples)


def test_each_row_is_the_mean_of_its_lines():
    _, samples = measured("instruments/tracker")
    many = recorded(samples, 0.01)
    found = once_each(many)
    np.testing.assert_allclose(found.joints, means(many.joints), atol=1e-12)
    np.testing.assert_allclose(found.columns["x"], means(many.columns["x"]), atol=1e-9)
    assert tuple(found.labels["session"]) == tuple(samples.labels["session"])
    assert found.lines == many.lines[LINES // 2 :: LINES]


def test_quaternions_that_change_sign_and_angles_that_wrap_are_not_averaged():
    _, samples = measured("instruments/tracker")
    many = recorded(samples, 0.0)
    sign = np.where(np.arange(len(many)) % 2, -1.0, 1.0)
    found = once_each(replace(many, columns={**many.columns, "w": 0.9 * sign, "x": 0.05 * sign}))
    np.testing.assert_allclose(np.abs(found.columns["w"]), 0.9)
    np.testing.assert_allclose(found.columns["x"] / found.columns["w"], 0.05 / 0.9)


def test_touches_that_a_hand_repeats_stay():
    _, samples = measured("instruments/tracker")
    thrice = recorded(samples, 0.01, lines=3)
    assert once_each(thrice) is thrice
    assert len(without_copies(thrice)) == len(thrice)
    one = samples.take([*range(40), *[40] * 9])  # one posture nine times among others
    assert once_each(one) is one
    again = replace(recorded(samples, 0.01), extra={"purpose": ("again",) * (LINES * len(samples))})
    assert once_each(again) is again
    planned = replace(again, extra={"purpose": ("fit",) * (20 * LINES) + ("again",) * (LINES * (len(samples) - 20))})
    assert len(once_each(planned)) == len(samples), "a plan's purposes do not keep a recorder from being one"


def test_another_label_is_another_standstill():
    _, samples = measured("instruments/tracker")
    rows = samples.take([0] * 30)
    rows = replace(rows, labels={"session": ["a"] * 10 + ["b"] * 20})
    assert standstills(rows).tolist() == [0] * 10 + [1] * 20


def test_a_joint_that_turns_on_and_on_has_no_limits(hsr):
    samples = hsr.problem.read(hsr.samples)
    joints = samples.joints + np.array([0, 0, 0, 0, 0, 4 * np.pi])
    for upper, said in ((np.pi, set()), (3.0, {"joint 6 outside its limits"})):
        axes = [replace(joint, lower=-upper, upper=upper) if k == 5 else joint
                for k, joint in enumerate(hsr.problem.robot.axes)]  # fmt: skip
        robot = replace(hsr.problem.robot, joints=axes)
        problem = hsr.problem.with_parts(robot, hsr.problem.instruments)
        assert {
            each.about for each in check(problem, replace(samples, joints=joints)) if "limits" in each.about
        } == said


def test_a_load_that_is_changed_while_the_arm_stands_begins_a_standstill():
    _, samples = measured("instruments/tracker")
    many = recorded(samples, 0.01)
    load = np.tile(np.repeat([0.0, 5.0], LINES // 2), len(samples))
    found = once_each(replace(many, extra={"payload_kg": load}))
    assert found.extra["payload_kg"].tolist() == [0.0, 5.0] * len(samples)
    half = many.columns["x"].reshape(-1, LINES // 2).mean(axis=1)
    np.testing.assert_allclose(found.columns["x"], half, atol=1e-9)


def test_what_was_measured_beside_the_readings_is_averaged_like_them():
    _, samples = measured("instruments/tracker")
    many = recorded(samples, 0.01)
    torque = np.random.default_rng(3).normal(size=len(many))
    found = once_each(replace(many, extra={"torque": torque}))
    np.testing.assert_allclose(found.extra["torque"], means(torque), atol=1e-12)


def test_rows_under_different_loads_are_no_copies():
    _, samples = measured("instruments/tracker")
    twice = samples.take([0, 0, 0])
    assert copies_of(replace(twice, extra={"payload_kg": np.array([0.0, 5.0, 5.0])})).tolist() == [False, False, True]


def test_a_frame_keeps_what_its_rows_were_made_for():
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    frame = pd.read_csv(source.samples, comment="#").iloc[[0, 0]]
    frame = frame.assign(purpose=["fit", "again"])
    found = Samples.from_frame(frame, source.problem.layout())
    assert found.extra["purpose"] == ("fit", "again")
    assert copies_of(found).tolist() == [False, False]

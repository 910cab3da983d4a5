"""Figures in corners: a dial that errs alike in every session, play of rows that were taken out, noise of repeats."""

import dataclasses

import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation

from casacal import (
    CasacalError,
    Cell,
    DialOnPlane,
    Frame,
    Joint,
    Problem,
    Robot,
    bind,
    calibrate,
    changed,
    corner,
    deg,
    load_problem,
    scaled_to_accuracy,
    simulate,
    tool_point,
    verify,
)
from casacal.calibration.inputs import samples_from
from casacal.calibration.numbers import tool_elsewhere_at
from casacal.calibration.verdict import joint_error
from casacal.data.samples import Samples
from casacal.fit.lm import lm
from casacal.model.dial import dial_gain

CORNER = Cell(faces=corner((900.0, 0.0, 400.0), size=500.0))


def together(parts):
    """Rows of several sessions as of one file."""
    first = parts[0]
    joints = np.vstack([part.joints for part in parts])
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in first.columns}
    labels = {name: tuple(label for part in parts for label in part.labels[name]) for name in first.labels}
    return Samples(joints, columns, labels, tuple(range(1, len(joints) + 1)), {}, "all", "0")


@pytest.mark.parametrize("declared", [False, True])
def test_one_dial_errs_alike_in_every_session(hsr, declared):
    """Three sessions one after the other promise what all their rows at once promise: the gain is learned no better."""
    dial = dataclasses.replace(hsr.problem.instrument, noise_std=0.003)
    if declared:
        dial = dataclasses.replace(dial, gain=dial_gain(0.15))
    problem = Problem(hsr.problem.robot, dial)
    parts = [simulate(problem, CORNER, samples=60, seed=1, session=k).samples for k in range(3)]
    found = calibrate(problem, parts[0], method="lm", reference=False)
    for part in parts[1:]:
        found = calibrate(problem, part, method="lm", prior=found, reference=False)
    whole = calibrate(problem, together(parts), method="lm", reference=False)
    assert found.unjudged.tip_std[1] == pytest.approx(whole.unjudged.tip_std[1], rel=0.02)


def test_how_joints_came_to_a_row_is_known_of_the_file(hsr):
    """By the row before in the file, whichever rows are taken; a joint that stays lies where it lay."""
    joints = np.radians([[0, 5], [10, 5], [10, 3], [7, 3], [7, 3], [9, 3]])
    rows = Samples(joints, {}, {}, (4, 2, 3, 8, 6, 9), {}, "rows", "0")  # lines 2, 3, 4, 6, 8, 9
    by_line = np.array([[0, 0], [0, -1], [-1, 1], [1, -1], [1, -1], [1, -1]])
    expected = by_line[np.argsort(np.argsort([4, 2, 3, 8, 6, 9]))]
    np.testing.assert_array_equal(rows.ways, expected)
    np.testing.assert_array_equal(rows.take([5, 0, 3]).ways, expected[[5, 0, 3]])
    np.testing.assert_array_equal(rows.take([5, 0, 3]).take([2, 1]).ways, expected[[3, 0]])


def test_backlash_is_told_from_noise_where_rows_are_held_out_or_repeated(hsr):
    cell = dataclasses.replace(CORNER, backlash=200e-6)
    rows = simulate(hsr.problem, cell, samples=160, seed=4).samples
    held = calibrate(hsr, rows, method="lm", reference=False, holdout=0.3)
    assert held.noise.ratio < 1.3, "6.2 where the row before was one of those that were left"
    again = simulate(hsr.problem, dataclasses.replace(cell, repeats=2), samples=120, seed=4).samples
    assert calibrate(hsr, again, method="lm", reference=False).noise.ratio < 1.3, "6.9 where a repeat had no play"


def test_fresh_touches_have_the_noise_of_one_touch(hsr):
    """Of 40 places touched three times, each with an error of its own; fresh rows are touched once."""
    rng = np.random.default_rng(3)
    dial = dataclasses.replace(hsr.problem.instrument, noise_std=0.01)
    problem, still = Problem(hsr.problem.robot, dial), dataclasses.replace(CORNER, repeatability=0.0, resolution=0.0)
    places = simulate(problem, still, samples=50, seed=2).samples
    shared = places.columns["reading"] + rng.normal(size=50) * 0.03
    index = np.repeat(np.arange(40), 3)
    read = shared[index] + rng.normal(size=120) * 0.01
    labels = {"plane": tuple(places.labels["plane"][k] for k in index)}
    made = Samples(places.joints[index], {"reading": read}, labels, tuple(range(1, 121)), {}, "repeats", "1")
    late = places.take(np.arange(40, 50))
    late = dataclasses.replace(late, columns={"reading": (shared + rng.normal(size=50) * 0.01)[40:]}, came=None)
    found = calibrate(problem, made, method="lm", reference=False, discrepancy="none")
    each = [face.used_mm / face.stated_mm for face in found.arm.found.noise.by_face.values()]
    assert np.mean(each) == pytest.approx(found.noise.ratio, rel=0.05)
    assert found.arm.found.noise.shared == pytest.approx(0.9, abs=0.1)
    assert verify(found, late, standing=("plane",)).kept


@pytest.mark.parametrize("noise", [0.01, 0.0025])
def test_a_tool_or_a_length_is_warned_of_whatever_noise_was_stated(noise):
    """Touches of a tool 4.5 mm longer than stated, d6 freed by hand; the noise is 0.01 mm."""

    def touching(length, stated):
        robot = Robot.from_dh(
            "UR10e",
            alpha=deg(90, 0, 0, 90, -90, 0),
            a=[0, -612.7, -571.55, 0, 0, 0],
            d=[180.7, 0, 0, 174.15, 119.85, 116.55],
            theta=deg(*[0] * 6),
            parallel=(2, 3),
            joints=[Joint("revolute", *deg(-360, 360))] * 6,
        )
        tool = tool_point(0, 0, length, prior_std=(1.0, 1.0, 20.0))
        dial = DialOnPlane(noise_std=stated, sign=-1, travel=10.0, tool=tool)
        return scaled_to_accuracy(Problem(robot, dial), 0.5)

    cell = Cell(faces=corner((800.0, 0.0, 400.0), size=400.0))
    rows = simulate(touching(119.5, 0.01), cell, samples=90, seed=6).samples
    bound = bind(touching(115.0, noise).with_prior({"d6": 20.0}), rows)
    bound = bound.with_noise({"": 0.01 / noise})
    found = lm(bound)
    (warning,) = tool_elsewhere_at(bound, found.x, found.covariance)
    assert warning.about in ("tool or d6", "tool elsewhere")


def test_a_sliding_joint_errs_in_millimetres():
    robot = load_problem(ROOT / "problems" / "instruments" / "rail").problem.robot
    slide = next(k for k, axis in enumerate(robot.axes, 1) if not axis.turns)
    turn = next(k for k, axis in enumerate(robot.axes, 1) if axis.turns)
    assert joint_error(robot, turn, 1.4e-3) == "1.4 mrad"
    assert joint_error(robot, slide, 1.4e-3) == "140 um"


def test_a_body_that_moved_is_loosened_by_its_own_name():
    source = load_problem(ROOT / "problems" / "instruments" / "camera")
    rows = samples_from(None, source)
    (slot,) = (slot for slot in bind(source.problem, rows, backend="blocks").slots if slot.key == "body")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(slot.nominal[:9], (3, 3)).T, slot.nominal[9:]
    body = Frame(matrix=matrix.tolist(), prior_std=(0.01, 2.0))
    problem = Problem(source.problem.robot, dataclasses.replace(source.problem.instrument, body=body))
    first, late = rows.take(range(0, len(rows), 2)), rows.take(range(1, len(rows), 2))
    turns = Rotation.from_rotvec(np.column_stack([late.columns[name] for name in ("turn_x", "turn_y", "turn_z")]))
    off = turns.apply([3.0, 0, 0])
    columns = {**late.columns, **{name: late.columns[name] + off[:, k] for k, name in enumerate("xyz")}}
    made = calibrate(problem, first, method="lm", reference=False, discrepancy="none")
    said = changed(made, dataclasses.replace(late, columns=columns)).summary()
    assert "--loosen body" in said
    assert "tool " not in said[said.index("casacal calibrate") :]


def test_lists_that_are_none_are_refused_in_a_sentence(corner_calibration, hsr):
    rows = simulate(hsr.problem, hsr.cell, samples=30, seed=9).samples
    for wrong in ({"drift": ("theta",)}, {"standing": None}):
        with pytest.raises(CasacalError, match="Got "):
            changed(corner_calibration, rows, **wrong)
    for loosen in (3, [3]):
        with pytest.raises(CasacalError, match="as the list to loosen"):
            calibrate(corner_calibration.source, rows, prior=corner_calibration, loosen=loosen)


def test_noise_that_was_as_stated_is_not_said_to_be_found(hsr):
    made = simulate(hsr.problem, hsr.cell, samples=130, seed=3).samples
    first = calibrate(hsr, made.take(np.arange(90)), method="lm", reference=False, noise="stated")
    late = calibrate(hsr, made.take(np.arange(90, 130)), method="lm", reference=False, prior=first)
    assert "stated noise" in late.verdict.words
    assert "noise as found" not in late.verdict.words

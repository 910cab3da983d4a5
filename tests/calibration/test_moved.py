"""One thing that stood elsewhere from some row on is named with its row; smooth errors of arm and cell are not."""

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain

from casacal import Samples, bind, calibrate, check, dial_zero, huber, load_problem, simulate
from casacal.calibration.before_fit import outside
from casacal.calibration.cause import MisfitCause
from casacal.calibration.faults import SLIPPED
from casacal.calibration.finding import Finding, Undone
from casacal.calibration.moved import moved_midway
from casacal.data.columns import Labels
from casacal.data.samples import joined
from casacal.effects.trusted import with_constants
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints

NORMALS = {"floor": (0, 0, 1), "wall": (-1, 0, 0), "side": (0, -1, 0), "block": (0, 0, 1)}
COUNT, LATER = 100, 55


@pytest.fixture(scope="module")
def ur5():
    source = load_problem(ROOT / "problems" / "ur5")
    return source, simulate(source.problem, source.cell, samples=COUNT, seed=5).samples


def turns(problem, samples):
    """Rotations (N, 3, 3) of the drawn flange, by the chain written out."""
    parts = [np.asarray(problem.robot.parameters[key].nominal) for key in ("alpha", "a", "d", "theta")]
    return np.array([dh_chain(*parts[:3], parts[3] + q)[:3, :3] for q in samples.joints])


def read_with(problem, samples, shifts):
    """Rows whose tips stand elsewhere by some vectors (N, 3; mm, base frame): the plunger reaches as much farther."""
    normals = np.array([NORMALS[label] for label in samples.labels["plane"]], dtype=float)
    along = np.einsum("ni,ni->n", normals, turns(problem, samples)[:, :, 2])
    off = np.einsum("ni,ni->n", normals, shifts) / (problem.instrument.sign * along)
    return replace(samples, columns={"reading": samples.columns["reading"] - off})


def moved_in(problem, samples):
    return moved_midway(bind(with_constants(problem), samples, backend="blocks"))


@pytest.mark.parametrize("label", ["floor", "side", "block"])
def test_a_face_that_was_bumped_is_named_with_its_first_row(ur5, label):
    source, samples = ur5
    own = np.array(samples.labels["plane"].names)[samples.labels["plane"].codes] == label
    later = own & (np.arange(COUNT) >= LATER)
    shifts = np.where(later[:, None], -0.15 * np.array(NORMALS[label]), 0.0)
    found = moved_in(source.problem, read_with(source.problem, samples, shifts))
    assert found.about == f"'{label}' moved"
    assert re.search(rf"from line {samples.lines[int(np.argmax(later))]} on, by 0.1[456] mm", found.cause)
    assert f"'{label} later'" in found.fix


def test_a_plate_and_the_block_on_it_move_together(ur5):
    source, samples = ur5
    labels = np.array(samples.labels["plane"].names)[samples.labels["plane"].codes]
    later = np.isin(labels, ["floor", "block"]) & (np.arange(COUNT) >= LATER)
    shifts = np.where(later[:, None], [0.0, 0.0, 0.2], 0.0)
    found = moved_in(source.problem, read_with(source.problem, samples, shifts))
    assert found.about == "'floor' and 'block' moved"
    assert "'floor' and 'block' stand elsewhere" in found.cause
    # half of it is no more than a drift of the readings, which leaves nearly as little, and a calibration allows for
    assert moved_in(source.problem, read_with(source.problem, samples, shifts / 2)) is None


def test_a_tool_that_was_clamped_anew_is_no_slipped_joint(ur5):
    """Such a slip by many degrees explains it nearly as well: whoever masters that joint spoils a good zero."""
    source, samples = ur5
    later = (np.arange(COUNT) >= LATER)[:, None]
    shifts = np.where(later, turns(source.problem, samples) @ [0.4, -0.3, 0.0], 0.0)
    rows = read_with(source.problem, samples, shifts)
    errors = [each for each in check(source.problem, rows) if each.severity == "error"]
    assert [each.about for each in errors] == ["the tool moved"]
    assert f"from line {samples.lines[LATER]} on" in errors[0].cause


def test_what_a_large_slip_explains_a_tool_explains_better_but_no_joint_does(ur5, monkeypatch):
    """Of some arms a slip by fifteen degrees leaves little as well; a slip that is one stays with its own words."""
    source, samples = ur5

    def slipped(problem, rows, *_, **__):
        return MisfitCause(Finding("error", SLIPPED, "joint 6", "Master that joint"), Undone(problem, rows))

    monkeypatch.setattr("casacal.calibration.check.explained", slipped)
    later = (np.arange(COUNT) >= LATER)[:, None]
    tool = read_with(source.problem, samples, np.where(later, turns(source.problem, samples) @ [0.4, -0.3, 0.0], 0.0))
    joint = replace(samples, joints=samples.joints + np.where(later, [0, 0, 2e-3, 0, 0, 0], 0.0))
    assert [each.about for each in errors_of(source, tool)] == ["the tool moved"]
    assert [each.about for each in errors_of(source, joint)] == [SLIPPED]


def test_a_cause_explains_all_or_is_none(ur5):
    """Touches four times as rough as stated are no reason to name a plate, however far it was bumped."""
    source = ur5[0]
    rough = simulate(source.problem, replace(source.cell, repeatability=0.04), samples=COUNT, seed=5).samples
    labels = np.array(rough.labels["plane"].names)[rough.labels["plane"].codes]
    shifts = np.where(((labels == "side") & (np.arange(COUNT) >= LATER))[:, None], [0.0, 0.5, 0.0], 0.0)
    assert moved_in(source.problem, read_with(source.problem, rough, shifts)) is None


def test_a_joint_that_slipped_by_little_is_that(ur5):
    source, samples = ur5
    joints = samples.joints.copy()
    joints[LATER:, 2] += 4e-4
    found = moved_in(source.problem, replace(samples, joints=joints))
    assert found.about == "joint 3 moved"
    assert f"from line {samples.lines[LATER]} on" in found.cause


def test_a_calibration_from_a_bumped_plate_promises_nothing(ur5):
    """It bent the arm to a wrong size: six times the promised error, and nothing but noise to be seen."""
    source, samples = ur5
    labels = np.array(samples.labels["plane"].names)[samples.labels["plane"].codes]
    shifts = np.where(((labels == "floor") & (np.arange(COUNT) >= LATER))[:, None], [0.0, 0.0, -0.15], 0.0)
    found = calibrate(source, read_with(source.problem, samples, shifts), reference=False)
    assert found.verdict.level == "do not use"
    assert "'floor' moved" in found.verdict.words


def tip_error(found, made):
    """Of a calibrated arm over the workspace against the true one, mm RMS, apart from the pose of the base."""
    joints = workspace_joints(made.problem.robot)
    true = made.true_tips(joints)
    return tip_rms(without_rigid((found.predict(joints, frame="tip").positions - true).ravel(), true))


SMOOTH = {
    "nothing": {},
    "form": {"flatness": 0.05, "flatness_reach": 0.7},
    "sag": {"compliance": 1.0},
    "waves": {"gear_waves": {1: 2e-4, 2: 1e-4}},
    "drive": {"gear_waves": {100: 1e-4}},
    "backlash": {"backlash": 2e-4},
    "loose": {"joint_std": 1e-4},
    "drift": {"drift": 0.05},
    "warmth": {"thermal": 5e-5},
    "gain": {"dial_gain": 0.003},
    "gross": {"outliers": 0.03, "outlier_size": 0.3},
    "rough": {"repeatability": 0.03},
}


@pytest.mark.parametrize("cause", SMOOTH)
def test_smooth_errors_have_moved_nothing(ur5, cause):
    """In the order of a simulation, and face by face along joint 1, as a route goes."""
    source = ur5[0]
    for seed in (1, 2):
        rows = simulate(source.problem, replace(source.cell, **SMOOTH[cause]), samples=COUNT, seed=seed).samples
        order = np.lexsort((rows.joints[:, 0], rows.labels["plane"].codes))
        for some in (rows, replace(rows.take(order), lines=tuple(range(1, COUNT + 1)))):
            assert moved_in(source.problem, some) is None


def test_few_rows_and_clean_ones_are_left_alone(ur5):
    source, samples = ur5
    assert moved_in(source.problem, samples) is None
    assert moved_in(source.problem, samples.take(range(34))) is None


# ------------------------------------------------------------------------------------------ single columns and numbers


def errors_of(source, samples: Samples):
    return [each for each in check(source.problem, samples) if each.severity == "error"]


@pytest.mark.parametrize("joint", [1, 5])
def test_one_joint_in_another_unit_or_a_row_late_is_named(ur5, joint):
    source, samples = ur5
    radians, late = samples.joints.copy(), samples.joints.copy()
    radians[:, joint - 1] *= np.pi / 180
    late[1:, joint - 1] = late[:-1, joint - 1]
    (found,) = errors_of(source, replace(samples, joints=radians))
    assert (found.about, found.fix) == (f"unit of joint {joint}", f"Correct the unit of column q{joint}")
    (found,) = errors_of(source, replace(samples, joints=late))
    assert found.about == f"joint {joint} one row off"
    assert "previous row" in found.cause


def test_a_block_of_four_inches_is_not_a_wrong_dial(ur5):
    """Its advice, to declare a gain, changed nothing and asked for more of the same."""
    source, samples = ur5
    on_block = np.array(samples.labels["plane"].names)[samples.labels["plane"].codes] == "block"
    shifts = np.where(on_block[:, None], [0.0, 0.0, -1.6], 0.0)
    found, *others = errors_of(source, read_with(source.problem, samples, shifts))
    assert found.about == "height of 'block'"
    assert re.search(r"101\.[56]\d mm, not 100:", found.cause)
    assert {each.about for each in others} <= {"readings outside travel"}


def test_readings_at_the_end_of_the_travel_are_named(ur5):
    source, samples = ur5
    reading = np.minimum(samples.columns["reading"], np.sort(samples.columns["reading"])[-20])
    (found,) = errors_of(source, replace(samples, columns={"reading": reading}))
    assert found.about == "end of the travel"
    clipped = [samples.lines[k] for k in np.flatnonzero(reading == reading.max())]
    assert f"lines {clipped[0]}, {clipped[1]}, " in found.cause


def test_a_dial_read_from_its_other_end_is_corrected_as_it_is_said(ur5):
    source, samples = ur5
    wall = np.array(samples.labels["plane"].names)[samples.labels["plane"].codes] == "wall"
    reading = np.where(wall, 10 - samples.columns["reading"], samples.columns["reading"])
    (found,) = errors_of(source, replace(samples, columns={"reading": reading}))
    assert found.fix == "Write 10 - r in place of each r on 'wall'"


@pytest.mark.parametrize(("one", "two"), [("wall", "side"), ("floor", "wall")])
def test_two_faces_under_one_label_are_parted(ur5, one, two):
    """The rows that are listed are those of the face that lost its label, also where a step stands on the other."""
    source, samples = ur5
    names = np.array(samples.labels["plane"].names)[samples.labels["plane"].codes]
    merged = Labels.of(np.where(names == two, one, names))
    (found,) = errors_of(source, replace(samples, labels={"plane": merged}))
    assert found.about == "two under one label"
    first = {one: samples.lines[int(np.argmax(names == one))], two: samples.lines[int(np.argmax(names == two))]}
    listed = int(re.search(r"own: lines (\d+)", found.fix)[1])
    assert listed == first[two] if one == "floor" else listed in first.values()


def test_postures_that_come_again_with_other_readings_are_named(ur5):
    source, samples = ur5
    labels = samples.labels["plane"].take(np.arange(10, 20))
    pasted = replace(
        samples.take(range(10, 20)), columns={"reading": samples.columns["reading"][30:40]}, labels={"plane": labels}
    )
    rows = replace(joined(samples, pasted), lines=tuple(range(1, COUNT + 11)))
    (told,) = [each for each in outside(source.problem, rows) if each.about == "one posture, two readings"]
    assert set(told.lines) <= {*range(11, 21), *range(COUNT + 1, COUNT + 11)}
    assert len(told.lines) >= 12
    named = {line for each in errors_of(source, rows) for line in each.lines}
    assert named
    assert named <= {*range(COUNT + 1, COUNT + 11)}, "where others name the wrong ones, these alone"
    again = replace(pasted, columns={"reading": samples.columns["reading"][10:20] + 0.02})
    rows = replace(joined(samples, again), lines=tuple(range(1, COUNT + 11)))
    assert [each.about for each in outside(source.problem, rows)] == []
    zeros = replace(source.problem.instrument, zero_shift=dial_zero())
    sessions = {**rows.labels, "session": Labels.of(["a"] * COUNT + ["b"] * 10)}
    shifted = replace(rows, labels=sessions, columns={"reading": rows.columns["reading"] + 2.0 * (np.arange(110) > 99)})
    anew = source.problem.with_parts(source.problem.robot, (zeros,))
    assert "one posture, two readings" not in [each.about for each in outside(anew, shifted)]
    assert "one posture, two readings" in [each.about for each in outside(source.problem, shifted)]


def test_a_wrong_touch_among_repeated_ones_accuses_no_right_one(ur5):
    source = ur5[0]
    made = simulate(source.problem, replace(source.cell, repeats=3), samples=120, seed=3).samples
    reading = made.columns["reading"].copy()
    reading[40] += 1.5 if reading[40] < 5 else -1.5
    reading[77] += 1.0 if reading[77] < 5 else -1.0
    errors = errors_of(source, replace(made, columns={"reading": reading}))
    assert {line for each in errors for line in each.lines} == {made.lines[40], made.lines[77]}


def test_a_plunger_that_leans_more_than_stated_is_named_and_no_error(ur5):
    """`calibrate` allows for it, and promises what it keeps: what both say agrees."""
    source, samples = ur5
    turned = turns(source.problem, samples)
    reading = samples.columns["reading"] * source.problem.instrument.sign
    lean = np.array([np.sin(0.052), 0.0, np.cos(0.052) - 1.0])
    rows = read_with(source.problem, samples, reading[:, None] * (turned @ lean))
    found = check(source.problem, rows)
    assert not [each for each in found if each.severity == "error"]
    (said,) = [each for each in found if each.about == "the direction of the plunger"]
    assert re.search(r"plunger (4[5-9]|5\d) mrad off, and 10 mrad is stated", said.cause)


def test_readings_that_were_sorted_by_themselves_are_named(ur5):
    source, samples = ur5
    (found,) = errors_of(source, replace(samples, columns={"reading": np.sort(samples.columns["reading"])}))
    assert found.about == "sorted column"


def test_labels_of_known_points_that_are_exchanged_or_a_row_late_are_named():
    source = load_problem(ROOT / "problems" / "instruments" / "plate")
    samples = simulate(source.problem, source.cell, samples=90, seed=4).samples
    (column,) = samples.labels
    labels = samples.labels[column]
    names = list(labels.names)
    names[0], names[3] = names[3], names[0]
    (found,) = errors_of(source, replace(samples, labels={column: Labels(names, labels.codes)}))
    assert found.about == "labels exchanged"
    assert f"'{labels.names[0]}'" in found.cause
    assert f"'{labels.names[3]}'" in found.cause
    codes = labels.codes.copy()
    codes[45:] = codes[44:-1]
    (found,) = errors_of(source, replace(samples, labels={column: Labels(labels.names, codes)}))
    assert found.about == "labels one row off"
    assert re.search(r"previous row, from line 4[4567] on", found.cause)


def test_beside_a_robust_loss_the_plunger_is_doubted_as_well():
    """A loss takes the geometry alone, and yet no plunger stands along the flange: 1.4 times the promise without it."""
    source, ratios = load_problem(ROOT / "problems" / "ur5"), []
    for seed in range(6):
        made = simulate(source.problem, source.cell, samples=COUNT, seed=40 + seed)
        turned = turns(source.problem, made.samples)
        lean = np.array([*np.random.default_rng(seed).normal(0, 0.01, 2), 0.0])
        reading = made.samples.columns["reading"] * source.problem.instrument.sign
        rows = read_with(source.problem, made.samples, reading[:, None] * (turned @ lean))
        found = calibrate(source, rows, loss=huber(), reference=False)
        assert {each.name for each in found.leverages} >= {"plunger"}
        ratios.append(tip_error(found, made) / found.unjudged.tip_std[1])
    assert np.sqrt(np.mean(np.square(ratios))) < 1.25

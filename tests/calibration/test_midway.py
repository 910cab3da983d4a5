"""Something that changed while the rows were taken: the data check names the line, and what was changed."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from casacal import check, load_problem, simulate
from casacal.calibration.cause import changed_midway
from casacal.data.columns import Labels

PROBLEMS = Path(__file__).parent.parent.parent / "problems"
ROWS, PLACE = 80, 44


@pytest.fixture(scope="module", params=["adept_cobra600", "ur5"])
def touched(request):
    source = load_problem(PROBLEMS / request.param)
    return source.problem, simulate(source.problem, source.cell, samples=ROWS, seed=11).samples


def with_joints(samples, change):
    joints = samples.joints.copy()
    change(joints)
    return dataclasses.replace(samples, joints=joints)


def slipped(joints):
    joints[PLACE:, 1] += np.radians(0.5)


def swapped(joints):
    joints[PLACE:, [0, 1]] = joints[PLACE:, [1, 0]]


def swapped_at_first(joints):
    joints[:PLACE, [0, 1]] = joints[:PLACE, [1, 0]]


@pytest.mark.long_unless("adept_cobra600-swapped_at_first-joints 1 and 2 swapped up to line -43")
@pytest.mark.parametrize(
    ("touched", "change", "about", "near"),
    [
        ("ur5", swapped, "joints 1 and 2 swapped from line ", PLACE),
        ("adept_cobra600", swapped_at_first, "joints 1 and 2 swapped up to line ", PLACE - 1),
    ],
    indirect=["touched"],
)
def test_what_happened_to_joints_is_named_with_its_line(touched, change, about, near):
    problem, samples = touched
    wrong = with_joints(samples, change)
    found = changed_midway(problem, wrong)
    assert found.about.startswith(about)
    line = int(found.about.removeprefix(about).removesuffix(" on"))
    assert abs(wrong.lines.index(line) - near) <= 1  # the first row may fit by chance


@pytest.mark.long_unless("adept_cobra600")
def test_an_encoder_that_slipped_is_named_with_its_joint_its_line_and_its_size(touched):
    problem, samples = touched
    (error,) = (each for each in check(problem, with_joints(samples, slipped)) if each.severity == "error")
    assert error.about == "joint slipped"
    joint, line, size = re.search(r": joint (\d), near line (\d+), by ([+-][\d.]+) degrees", error.cause).groups()
    assert joint == "2"
    assert abs(samples.lines.index(int(line)) - PLACE) <= 1
    assert float(size) == pytest.approx(0.5, abs=0.03)


@pytest.mark.long_unless("ur5-rows1")
@pytest.mark.parametrize(
    ("touched", "rows"), [("adept_cobra600", slice(PLACE, None)), ("ur5", slice(20, 41))], indirect=["touched"]
)
def test_a_joint_that_hangs_is_named_with_its_rows(touched, rows):
    problem, samples = touched

    def stuck(joints):
        joints[rows, 1] = joints[rows, 1][0]

    (error, *_) = check(problem, with_joints(samples, stuck))
    assert error.about == "joint 2 stuck"
    first = samples.lines[rows.start + 1]  # the first may be right
    assert f"shows in lines {first}, " in error.cause


@pytest.mark.long
@pytest.mark.parametrize("touched", ["adept_cobra600"], indirect=True)
def test_exchanged_labels_and_a_turned_dial_are_named_by_check(touched):
    problem, samples = touched
    column, reading = problem.instrument.groups, problem.instrument.probe.column
    labels, later = samples.labels[column], np.arange(ROWS) >= PLACE
    order = np.arange(len(labels.names))
    order[[0, 1]] = 1, 0
    codes = np.where(later, order[labels.codes], labels.codes)
    exchanged = dataclasses.replace(samples, labels={**samples.labels, column: Labels(labels.names, codes)})
    errors = [each for each in check(problem, exchanged) if each.severity == "error"]
    assert any("labels exchanged" in each.about for each in errors), "by line, or row by row where these are few"
    values = samples.columns[reading]
    turned = dataclasses.replace(samples, columns={**samples.columns, reading: np.where(later, -values, values)})
    errors = [each for each in check(problem, turned) if each.severity == "error"]
    assert any(each.about.startswith("wrong dial sign from line ") for each in errors)


def test_rows_that_fit_have_no_such_line(touched):
    problem, samples = touched
    assert changed_midway(problem, samples) is None
    shuffled = dataclasses.replace(
        samples, joints=np.random.default_rng(0).permuted(samples.joints, axis=0)
    )  # nor have rows none of which fit
    assert changed_midway(problem, shuffled) is None


@pytest.mark.long
def test_a_joint_that_never_moves_is_said_where_nothing_fits():
    source = load_problem(PROBLEMS / "ur5")
    samples = simulate(source.problem, source.cell, samples=ROWS, seed=11).samples

    def never(joints):
        joints[:, 4] = joints[0, 4]

    (error, *_) = check(source.problem, with_joints(samples, never))
    assert error.cause.startswith("joint 5 shows one and the same value in all rows; ")


def test_a_noise_that_is_understated_everywhere_changes_at_no_line(touched):
    """The first rows fit to any noise, if they are few."""
    problem, samples = touched
    few = dataclasses.replace(problem.instrument, noise_std=1e-5)
    assert changed_midway(type(problem)(problem.robot, few), samples) is None

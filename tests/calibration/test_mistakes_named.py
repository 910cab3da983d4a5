"""Mistakes of the cell that were once called by another name: each is named as what it is, and nothing beside it."""

import dataclasses
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT

from casacal import DialOnPlane, Problem, Step, calibrate, check, load_problem, plan, simulate
from casacal.calibration.before_fit import odd_labels, outside, tells_a_wrong_sign
from casacal.calibration.cause import _Attempt, _to_the_end
from casacal.calibration.finding import Fault, Undone, misfit
from casacal.calibration.verdict import verdict_of
from casacal.data.columns import Labels
from casacal.errors import CasacalError, SimulationError
from studies.cell_mistakes import PROBLEMS

REPLACE = dataclasses.replace


@pytest.fixture(scope="module")
def ur5():
    """An arm with a block that stands on the floor, and 80 touches."""
    source = load_problem(PROBLEMS / "ur5")
    return source.problem, simulate(source.problem, source.cell, samples=80, seed=3).samples


@pytest.fixture(scope="module")
def scara():
    source = load_problem(PROBLEMS / "adept_cobra600")
    problem = Problem(source.problem.robot, DialOnPlane(noise_std=0.01, tool=source.problem.instrument.tool))
    return problem, simulate(source.problem, source.cell, samples=60, seed=3).samples


def errors(problem, samples):
    return [finding for finding in check(problem, samples) if finding.severity == "error"]


def labelled(samples, names):
    return REPLACE(samples, labels={"plane": Labels.of(names)})


def renamed(samples, names):
    return labelled(samples, [names.get(label, label) for label in samples.labels["plane"]])


def read(samples, change):
    return REPLACE(samples, columns={"reading": change(samples.columns["reading"])})


@pytest.mark.long
@pytest.mark.parametrize(("pair", "rows"), [(("floor", "wall"), 80), (("block", "floor"), 120)])
def test_labels_of_two_faces_that_are_exchanged_throughout(pair, rows):
    """A step in another's place does not fit; one in the place of its own floor may, with the normal turned round."""
    source = load_problem(PROBLEMS / "ur5")
    problem, samples = source.problem, simulate(source.problem, source.cell, samples=rows, seed=3).samples
    wrong = renamed(samples, dict(zip(pair, pair[::-1], strict=True)))
    (found,) = errors(problem, wrong)
    assert found.about == "labels exchanged"
    assert all(f"'{label}'" in found.cause for label in pair)
    said = verdict_of(calibrate(problem, wrong, reference=False))
    assert said.level == "do not use"
    assert [reason.partition(":")[0] for reason in said.reasons] == ["Labels exchanged"]


def test_a_step_down_is_no_mistake(ur5):
    problem, samples = ur5
    dial = REPLACE(problem.instrument, steps={"floor": Step(on="block", height=-100.0)})
    assert not errors(Problem(problem.robot, dial), samples)


@pytest.mark.parametrize(
    ("steps", "refused", "severity", "says"),
    [
        ({"block": Step(on="base", height=100.0)}, "Step 'block' is on 'base', which is no", "error", "'base'"),
        ({"top": Step(on="floor", height=100.0)}, "Step 'top' is no face of the cell", "warning", "'top'"),
    ],
)
def test_a_step_on_no_face_is_refused_in_a_cell_and_named_in_rows(ur5, steps, refused, severity, says):
    problem, samples = ur5
    dial, cell = REPLACE(problem.instrument, steps=steps), load_problem(PROBLEMS / "ur5").cell
    other = Problem(problem.robot, dial)
    for made in (lambda: simulate(other, cell, samples=20), lambda: plan(other, cell, touches=20, pool=60)):
        with pytest.raises(SimulationError, match=rf"{refused}.* Name one of its faces: floor, wall, side, block"):
            made()
    found = next(each for each in check(other, samples) if each.about == "step without a face")
    assert (found.severity, says in found.cause) == (severity, True)
    assert "The labels there are: floor, wall, side, block" in found.fix
    assert not any(each.about == "step without a face" for each in check(problem, samples))


@pytest.mark.long
def test_a_zero_a_quarter_turn_off(ur5):
    problem, samples = ur5
    wrong = REPLACE(samples, joints=samples.joints + math.pi / 2 * np.eye(6)[1])
    (found,) = errors(problem, wrong)
    assert found.about == "zero of joint 2"
    assert "Add -90 degrees to column q2" in found.fix


@pytest.mark.long
def test_the_other_convention_of_a_table(ur5):
    problem, samples = ur5
    (found,) = errors(Problem(problem.robot.in_other_convention(), problem.instrument), samples)
    assert found.about == "DH convention"


@pytest.mark.long
@pytest.mark.parametrize(
    ("flipped", "about", "says"),
    [
        ([3], "joint 3 flipped and wrong dial sign", "with both undone"),
        ([2, 3, 5], "misfit", "Try the dial's sign first (--set sign=-1)"),
    ],
)
def test_rows_are_not_blamed_for_what_is_wrong_with_all(ur5, flipped, about, says):
    """One of two mistakes undone takes most of the misfit away, and leaves far too much; of four, nothing is found."""
    problem, samples = ur5
    assert problem.instrument.sign == -1
    turned = np.where(np.isin(np.arange(1, 7), flipped), -1.0, 1.0)
    (found,) = errors(problem.with_settings({"sign": 1}), REPLACE(samples, joints=samples.joints * turned))
    assert found.about == about
    assert says in str(found)
    assert "remove them" not in str(found)


def test_a_column_of_labels_that_is_missing(scara):
    problem, samples = scara
    wrong = labelled(samples, ["plane"] * len(samples))
    (found,) = errors(problem, wrong)
    assert "there is no column 'plane'" in found.cause


@pytest.mark.long
def test_a_column_of_labels_that_is_missing_comes_first_in_the_verdict(scara):
    problem, samples = scara
    wrong = labelled(samples, ["plane"] * len(samples))
    said = verdict_of(calibrate(problem, wrong, reference=False))
    assert said.reasons[0].startswith("Labels absent")


def test_one_face_that_needs_no_labels_is_not_accused_of_having_none(scara):
    """Measured sets of one anchor miss by some times their noise: an arm that errs, not a column that is missing."""
    problem, samples = scara
    rows = samples.take(samples.labels["plane"].rows()["near"])
    noisy = rows.columns["reading"] + np.random.default_rng(1).normal(0, 0.1, len(rows))
    (found,) = errors(problem, labelled(REPLACE(rows, columns={"reading": noisy}), ["plane"] * len(rows)))
    assert found.about == "misfit"


def test_half_of_the_rows_in_inches(scara):
    problem, samples = scara
    half = np.arange(len(samples)) % 2 == 0
    (found,) = errors(problem, read(samples, lambda reading: np.where(half, reading / 25.4, reading)))
    assert "readings up to 0.394 mm seem to be inches" in found.cause


def test_readings_with_a_minus_have_one_cure(scara):
    problem, samples = scara
    (found,) = errors(problem, read(samples, np.negative))
    assert found.about == "wrong dial sign"
    assert found.fix == "Write the readings without the minus"
    (found,) = errors(problem.with_settings({"sign": -problem.instrument.sign}), samples)
    assert "--set sign=" in found.fix


def test_a_unit_that_is_wrong_is_no_travel_to_declare(scara):
    problem, samples = scara
    (found,) = errors(problem, read(samples, lambda reading: 1000 * reading))
    assert found.about == "unit of the readings"
    assert "travel" not in str(found)


@pytest.mark.long
def test_what_was_split_in_two_is_not_called_small(ur5):
    """Where something moved, later rows count under other labels, which no reader has ever seen."""
    problem, samples = ur5
    later, faces = np.arange(len(samples)) >= 40, samples.labels["plane"]
    shift = np.array([0.8, -1.4, 1.0, 0.6])[faces.codes] * later
    found = check(problem, REPLACE(samples, columns={"reading": samples.columns["reading"] + shift}))
    assert found[0].about == "something moved"
    assert not [finding for finding in found if ", later" in str(finding)]


def test_what_fits_any_joints_explains_nothing(scara):
    """All rows at nearly one posture with one reading lie on any plane: little is left, and nothing was found."""
    problem, samples = scara
    first, fault = samples.joints[:1], Fault("none", "", "", lambda *_: None)
    still = REPLACE(samples, joints=first + 1e-6 * (samples.joints - first), columns={"reading": np.ones(60)})
    assert misfit(problem, still) < 2
    assert _to_the_end(_Attempt((fault,), Undone(problem, still), 0.0)).size == math.inf
    assert _to_the_end(_Attempt((fault,), Undone(problem, samples), 0.0)).size < 2


@pytest.mark.parametrize(("one", "other", "alike"), [("1", "1.0", True), ("2,0", "2", True), ("1", "10", False)])
def test_numbers_as_labels_are_compared_as_numbers(scara, one, other, alike):
    problem, samples = scara
    names, rows = list(samples.labels["plane"]), samples.labels["plane"].rows()["near"]
    for k, row in enumerate(rows):
        names[row] = one if k > 8 else other
    named = [finding for finding in odd_labels(problem, labelled(samples, names)) if "hardly differs" in finding.cause]
    assert [finding.cause.startswith(f"'{other}' (9 rows) hardly differs from '{one}'") for finding in named] == [
        True
    ] * alike


@pytest.mark.parametrize("slip", ["Near", "ne ar"])
def test_calibrate_names_a_label_that_is_a_slip(scara, slip):
    problem, samples = scara
    names, rows = list(samples.labels["plane"]), samples.labels["plane"].rows()["near"]
    for row in rows[:6]:
        names[row] = slip
    said = verdict_of(calibrate(problem, labelled(samples, names), reference=False))
    assert said.level == "use with care"
    assert any(f"'{slip}' (6 rows) hardly differs from 'near'" in reason for reason in said.reasons)
    for row in rows[2:6]:
        names[row] = "near"
    with pytest.raises(CasacalError, match=f"2 rows for 3 unknowns.*'{slip}'.*hardly differs.*Write 'near' there"):
        calibrate(problem, labelled(samples, names), reference=False)


def test_a_slope_far_beyond_two_is_no_wrong_sign():
    assert not tells_a_wrong_sign(53.6, 9.7)
    assert tells_a_wrong_sign(2.2, 0.1)


@pytest.mark.parametrize(
    ("low", "high", "travel", "says"),
    [
        (-6.0, 2.0, (-5.0, 5.0), "--set travel=-6:5)"),
        (0.0, 12.3, 10.0, "otherwise check these rows"),
        (-4.0, 7.2, (-5.0, 5.0), "otherwise check these rows"),
    ],
)
def test_advice_on_the_travel_keeps_the_other_end_and_leaves_room_for_a_slip(scara, low, high, travel, says):
    problem, samples = scara
    (found,) = outside(
        problem.with_settings({"travel": travel}), read(samples, lambda r: np.linspace(low, high, len(r)))
    )
    assert says in found.fix


def _tracked(change):
    """Findings on a tracker's rows of three sessions, changed by a function of places (N, 3) and sessions (N,)."""
    source = load_problem(ROOT / "problems" / "instruments" / "tracker")
    rows = source.problem.read(source.samples)
    names = np.array(rows.labels["session"].names)[rows.labels["session"].codes]
    places = np.column_stack([rows.columns[name] for name in "xyz"])
    changed = dict(zip("xyz", change(places.copy(), names).T, strict=True))
    return rows, check(source.problem, replace(rows, columns={**rows.columns, **changed}), confirmed=True)


@pytest.mark.parametrize("shown", [(0.0, 0.0, 0.0), (9999.0, 9999.0, 9999.0)])
def test_places_of_a_lost_target_are_named_with_their_lines(shown):
    def lost(places, _):
        places[4::9] = shown
        return places

    rows, (found,) = _tracked(lost)
    assert (found.severity, found.about) == ("error", "lost target")
    lines = [rows.lines[k] for k in range(4, len(rows), 9)]
    assert found.lines == tuple(lines) or f"lines {', '.join(map(str, lines))} hold the same place" in found.cause
    assert "Remove these lines" in found.fix


@pytest.mark.long_unless("0.03937007874015748-inches, written as mm")
@pytest.mark.parametrize(("factor", "words"), [(1 / 25.4, "inches, written as mm"), (1e-3, "metres, written as mm")])
def test_units_that_differ_by_session_are_named(factor, words):
    rows, (found,) = _tracked(lambda places, session: np.where(session[:, None] == "1", 1.0, factor) * places)
    assert (found.severity, found.about) == ("error", "unit by session")
    several = len(rows.labels["session"].names) > 2
    assert f"where session is {'not ' if several else ''}'{'1' if several else '2'}' seem to be {words}" in found.cause


@pytest.mark.long
def test_a_device_that_did_not_follow_is_named_by_the_rows_that_repeat_another():
    """Of two rows with one place the first was measured."""

    def stale(places, _):
        places[2::3] = places[1::3]
        return places

    rows, (found,) = _tracked(stale)
    assert found.about == "lost target"
    kept = re.search(r"lines ([\d, ]+?)(?:,? and \d+ more)? hold", found.cause)[1]
    named = {int(line) for line in kept.split(",")}
    assert named <= {rows.lines[k] for k in range(2, len(rows), 3)}


def test_a_place_that_comes_twice_by_chance_accuses_nobody():
    def twice(places, _):
        places[7] = places[3]
        return places

    assert not _tracked(lambda places, _: places)[1]
    assert [found.about for found in _tracked(twice)[1]] == ["outliers"]  # one row, which may be anything

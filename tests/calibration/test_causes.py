"""The data check finds what people do wrong, by its name and its size, and does not name it twice."""

import dataclasses
import math

import numpy as np
import pytest
from measured_world import World, at_one_reading

from casacal import DialOnPlane, Problem, bind, calibrate, check, deg, load_problem, plan, simulate, tool_point
from casacal.calibration import cause as causes
from casacal.calibration.cause import _Attempt, _looked_at_closely, _simplest, explained, residuals_as_drawn
from casacal.calibration.faults import tool_elsewhere
from casacal.calibration.finding import Fault, Undone, misfit
from casacal.calibration.verdict import verdict_of
from casacal.simulation.cell import Cell, Face
from studies.cell_mistakes import PROBLEMS, planted, simulated

ROWS = 60
REPLACE = dataclasses.replace


@pytest.fixture(scope="module")
def scara():
    """The quickest arm: four joints, on certified facets."""
    source = load_problem(PROBLEMS / "adept_cobra600")
    return source.problem, source.cell


def errors(findings):
    return [finding for finding in findings if finding.severity == "error"]


def only(problem, samples):
    (found,) = errors(check(problem, samples))
    return found


def touched(scara, seed=3):
    problem, cell = scara
    return problem, simulate(problem, cell, samples=ROWS, seed=seed).samples


@pytest.mark.long_unless("inches as mm-unit of the readings")
@pytest.mark.parametrize(
    ("mistake", "about"),
    [
        ("sign on one face", "dial sign of 'near'"),
        ("radians as degrees", "unit of the joints"),
        ("inches as mm", "unit of the readings"),
        ("drift", "drift"),
        ("coupling missing", "joint 3 coupled to joint 4"),
    ],
)
def test_one_mistake_gives_one_error(scara, mistake, about):
    problem, cell = scara
    _, wrong, samples = simulated(problem, cell, mistake, ROWS, 2)
    found = only(wrong, samples)
    assert found.about.startswith(about)
    if mistake == "coupling missing":
        lead = found.cause.split("by ")[1].split(" mm per turn")[0]
        assert float(lead) == pytest.approx(20.0, abs=0.1)


def test_smaller_readings_do_not_explain_a_larger_noise(hsr):
    """Driven to as planned, at mid-travel everywhere, any fraction of the readings is those of a better arm and dial.

    Readings that are divided by 25.4 leave a 25th of the misfit, as noise of four times what was stated does.
    """
    route = plan(hsr.problem, hsr.cell, touches=60, pool=400, starts=1, check=0.0, seed=3)
    route = REPLACE(route, samples=at_one_reading(hsr.problem, route.samples, 5.0))
    right = World(hsr.problem, route, seed=2, noise=4.0, faces=(1e-3, 1e-6)).samples
    assert misfit(hsr.problem, right) > 2
    in_inches, too_large = (
        REPLACE(right, columns={"reading": right.columns["reading"] * factor}) for factor in (1 / 25.4, 25.4)
    )
    assert misfit(hsr.problem, in_inches) < 1
    assert only(hsr.problem, right).about == "misfit"
    assert only(hsr.problem, too_large).about == "unit of the readings"


@pytest.mark.long
def test_a_held_tool_that_is_elsewhere_is_found_with_its_place(hsr):
    held = REPLACE(hsr.problem.instrument, tool=tool_point(6.0, -5.0, 0.5, free=False))
    samples = simulate(Problem(hsr.problem.robot, held), hsr.cell, samples=ROWS, seed=1).samples
    found = tool_elsewhere(hsr.problem, samples)
    assert misfit(found.problem, found.samples) < 2 < misfit(hsr.problem, samples)
    shown = dict(part.split(" by ") for part in found.found.removeprefix(": ").removesuffix(" mm").split(" mm, "))
    moved = np.array([float(shown[name]) for name in ("tool_x", "tool_y")])
    np.testing.assert_allclose(moved, [6.0, -5.0], atol=1.5)  # the last link's own errors are in it
    cause = explained(hsr.problem, samples, misfit(hsr.problem, samples))
    assert cause.finding.about == "tool elsewhere"
    assert "Measure the tool from the flange again" in cause.finding.fix
    assert "--prior" not in cause.finding.fix


def test_a_joint_driven_along_by_another_is_found(hsr):
    samples = simulate(hsr.problem, hsr.cell, samples=ROWS, seed=2).samples
    mixed = np.eye(6)
    mixed[2, 1] = -1.0
    found = only(hsr.problem, REPLACE(samples, joints=samples.joints @ mixed.T))
    assert found.about == "joint 3 coupled to joint 2"
    assert "turn with joint 2" in found.cause
    assert "casacal doctor" in found.fix


def test_the_size_of_drift_is_found(scara):
    problem, samples = touched(scara)
    reading = samples.columns["reading"] + 0.2 * np.arange(ROWS) / (ROWS - 1)
    drift = only(problem, REPLACE(samples, columns={"reading": reading}))
    assert float(drift.cause.split("by ")[1].split(" mm")[0]) == pytest.approx(0.2, abs=0.02)


def test_something_that_moved_is_found_near_its_line(scara):
    problem, cell = scara
    samples = simulate(problem, cell, samples=90, seed=4).samples
    later = np.arange(90) >= 50
    faces = samples.faces(problem.instrument.groups)
    shift = np.array([0.4, -0.7, 0.5])[faces.codes]
    moved = REPLACE(samples, columns={"reading": samples.columns["reading"] + np.where(later, shift, 0.0)})
    plain = Problem(problem.robot, DialOnPlane(noise_std=0.01, tool=problem.instrument.tool))
    found = only(plain, moved)
    assert found.about == "something moved"
    assert abs(int(found.cause.split("near line ")[1].split(":")[0]) - samples.lines[50]) <= 4


@pytest.mark.long
def test_two_mistakes_at_once_are_both_named(scara):
    problem, samples = touched(scara)
    wrong = problem.with_settings({"sign": -1})
    _, both = planted("radians as degrees", wrong, samples, np.random.default_rng(0))
    found = only(wrong, both)
    assert set(found.about.split(" and ")) == {"unit of the joints", "wrong dial sign"}
    assert "both undone" in found.cause


def test_a_flip_beside_a_swap_or_a_tool_elsewhere_is_named_with_it(scara):
    """Neither alone brings the rows near the drawn arm, so that only fits tell which pairs are worth one."""
    problem, samples = touched(scara, seed=1)
    joints = samples.joints[:, [1, 0, 2, 3]] * (1, 1, 1, -1)
    found = only(problem, REPLACE(samples, joints=joints))
    assert found.about == "joints 1 and 2 swapped and joint 4 flipped"
    tool = REPLACE(problem.instrument.tool, values=(160.0, 0.0, 80.0))
    longer = problem.with_parts(problem.robot, [REPLACE(problem.instrument, tool=tool)])
    found = only(longer, REPLACE(samples, joints=samples.joints * (-1, 1, 1, 1)))
    assert found.about == "joint 1 flipped and tool elsewhere"
    assert "tool_x by -100" in found.cause or "tool_x by -99" in found.cause


def test_a_simple_mistake_is_found_where_the_misfit_is_moderate(scara):
    problem, samples = touched(scara, seed=1)
    found = only(problem.with_settings({"sign": -1, "noise_std": 0.5}), samples)
    assert found.about == "wrong dial sign"


def test_clean_samples_of_another_arm_have_no_cause(scara):
    assert not errors(check(*touched(scara)))


def test_rows_that_scatter_have_no_cause(scara):
    problem, samples = touched(scara)
    noisy = samples.columns["reading"] + np.random.default_rng(1).normal(0, 0.1, ROWS)
    found = only(problem, REPLACE(samples, columns={"reading": noisy}))
    assert found.about == "misfit"


def test_a_free_tool_far_beyond_its_prior_is_a_warning():
    source = load_problem(PROBLEMS / "ur5")
    problem = source.problem
    away = REPLACE(problem.instrument, tool=tool_point(0, 8.0, 120, prior_std=1.0))
    samples = simulate(Problem(problem.robot, away), source.cell, seed=1).samples
    (found,) = (finding for finding in check(problem, samples) if finding.about == "tool elsewhere")
    assert found.severity == "warning"
    assert "tool_y by +" in found.cause


@pytest.mark.long
def test_touches_without_a_dial_are_searched_too(hsr):
    """A contact has neither sign nor drift; joints that are swapped are found all the same."""
    contact = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.02, reading=False))
    faces = (Face("plate", (1350.0, 0.0, 700.0), (0, 0, 1), (600.0, 600.0)),)
    samples = simulate(contact, Cell(faces=faces, tilt=float(deg(30))), samples=ROWS, seed=1).samples
    swapped = REPLACE(samples, joints=samples.joints[:, [0, 1, 2, 4, 3, 5]])
    assert only(contact, swapped).about == "joints 4 and 5 swapped"
    assert math.isfinite(misfit(contact, samples))


def test_of_two_that_explain_alike_the_simpler_is_believed(scara):
    problem, samples = touched(scara)
    undone = Undone(problem, samples)
    found = [
        _Attempt((Fault("free", "", "", None, freedom),), undone, size)
        for freedom, size in ((3, 1.0), (0, 1.3), (1, 1.1), (0, 9.0))
    ]
    assert _simplest(found).size == 1.3
    assert _simplest(found[:1] + found[2:]).size == 1.1
    assert _simplest([]) is None


def test_what_was_not_looked_at_closely_explains_nothing(scara, monkeypatch):
    """Joints that are shrunk bring all tips to one place, and any rows near any faces; a closer look sees that."""
    problem, samples = touched(scara)
    trials = [
        _Attempt((Fault(str(size), "", "", None),), Undone(problem, samples), size)
        for size in range(30, 30 + 2 * causes.PROMISING)
    ]
    monkeypatch.setattr(causes, "_to_the_end", lambda trial: REPLACE(trial, size=math.inf))
    assert _simplest(_looked_at_closely(trials)) is None


@pytest.mark.long
@pytest.mark.parametrize(("by", "said", "kept"), [(-1, "next row", slice(1, None)), (1, "previous row", slice(-1))])
def test_a_column_that_slipped_by_a_row_is_put_back(scara, by, said, kept):
    problem, samples = touched(scara)
    slipped = REPLACE(samples, columns={"reading": np.roll(samples.columns["reading"], by)})
    assert said in only(problem, slipped).cause
    cause = explained(problem, slipped, misfit(problem, slipped))
    assert cause.undone.samples.columns["reading"] == pytest.approx(samples.columns["reading"][kept])
    assert cause.undone.samples.joints == pytest.approx(samples.joints[kept])


def test_a_lost_turn_is_mended_in_the_right_sense(hsr):
    samples = simulate(hsr.problem, hsr.cell, seed=3).samples
    for row, by in ((7, 1.0), (7, -2.0), (50, 0.5)):
        reading = samples.columns["reading"].copy()
        reading[row] += by
        (found,) = (f for f in check(hsr.problem, REPLACE(samples, columns={"reading": reading})) if "lost" in f.about)
        assert found.lines == (samples.lines[row],)
        assert f"with {-by:+.3g} mm added to the reading" in found.cause
        assert f"{round(abs(by) / (1.0 if abs(by) >= 1 else 0.5))} turn" in found.cause


@pytest.mark.long
def test_beside_a_tool_elsewhere_the_flange_is_promised_nothing():
    """The samples see the tip; how much of a difference is the tool's and how much the arm's, they cannot say."""
    source = load_problem(PROBLEMS / "ur5")
    away = REPLACE(source.problem.instrument, tool=tool_point(0, 8.0, 120, prior_std=1.0))
    samples = simulate(Problem(source.problem.robot, away), source.cell, seed=1).samples
    right = calibrate(Problem(source.problem.robot, away), samples, reference=False)
    wrong = calibrate(source.problem, samples, reference=False)
    assert not right.tool_findings
    assert np.isfinite(right.unjudged.flange_std[1])
    assert "at the flange" in verdict_of(right).words
    assert wrong.tool_findings
    assert np.isnan(wrong.unjudged.flange_std[1])
    verdict = verdict_of(wrong)
    assert verdict.level == "use with care"
    assert "at the flange" not in verdict.words
    assert any("--frame tip" in reason for reason in verdict.reasons)


@pytest.mark.parametrize("name", ["ur5", "instruments/camera", "delta"])
def test_rows_about_the_drawn_arm_are_those_of_a_problem_that_is_bound_anew(name):
    source = load_problem(PROBLEMS / name)
    rows = simulate(source.problem, source.cell, samples=40, seed=3).samples
    joints = rows.joints.copy()
    joints[:, 1] += 0.02
    moved, bound = dataclasses.replace(rows, joints=joints), bind(source.problem, rows)
    anew = bind(source.problem, moved)
    expected = anew.plain_residual(anew.x0)
    np.testing.assert_allclose(residuals_as_drawn(bound, moved).ravel(), expected, atol=1e-9)
    assert np.abs(expected - bound.plain_residual(bound.x0)).max() > 0.1

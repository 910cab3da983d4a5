"""What to do next: each figure is the tip error to expect once it is done, and they stand in the right order."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from conftest import ROOT
from robots_of_others import UR5_CSV

from casacal import (
    Cell,
    DialOnPlane,
    Joint,
    Parameter,
    Plane,
    Problem,
    Robot,
    bind,
    calibrate,
    corner,
    deg,
    lm,
    load_problem,
    plate,
    simulate,
)
from casacal.calibration.brief import best_cure, brief, fall, nothing_helps
from casacal.calibration.result_json import calibration_document
from casacal.calibration.summary import summary
from casacal.calibration.verdict import verdict_of
from casacal.data.columns import Labels
from casacal.data.samples import joined
from casacal.planning.cures import NO_CURE, cures, extra_samples, outcomes
from casacal.planning.offers import CalibratedCell, offers
from casacal.simulation import Disturbances
from casacal.uncertainty.tip_error import expected_accuracy, planned_accuracy

FLAT = Cell(faces=plate((1350.0, 0.0, 500.0)), tilt=0.0)
KINDS = {
    "many": "60 planned",
    "same": "of the same kind",
    "noise": "half the noise",
    "tilt": "tilted by up to 30",
    "face": "another at right angles",
    "inclined": "inclined by 15",
    "step": "100 mm step",
    "tool": "by other means",
}


def by_kind(found):
    """Expected tip errors by kind, in the order of the list."""
    return {next(k for k, words in KINDS.items() if words in cure.words): cure.expected_rms_mm for cure in found}


def found_on(problem, cell, seed=1):
    bound = bind(problem, simulate(problem, cell, seed=seed).samples, backend="blocks")
    x = lm(bound).x
    return expected_accuracy(bound, x)[1], cures(bound, x)


@pytest.fixture(scope="module")
def ur5(tmp_path_factory):
    file = tmp_path_factory.mktemp("ur5") / "ur5.csv"
    file.write_text(UR5_CSV)
    return Problem(Robot.from_dh_file(file), DialOnPlane(noise_std=0.01))


@pytest.fixture(scope="module")
def scara():
    turns, slides = Joint("revolute", *deg(-150, 150)), Joint("prismatic", 0.0, 300.0)
    robot = Robot.from_dh(
        "scara",
        alpha=deg(0, 180, 0, 0),
        a=(350, 300, 0, 0),
        d=(400, 0, 0, 0),
        theta=(0,) * 4,
        joints=[turns, turns, slides, turns],
    )
    return Problem(robot, DialOnPlane(noise_std=0.01))


@pytest.fixture(scope="module")
def one_face(hsr):
    return calibrate(hsr.problem, simulate(hsr.problem, FLAT, seed=1).samples, reference=False, discrepancy="none")


@pytest.fixture(scope="module")
def three_faces(hsr, corner_simulation):
    return calibrate(hsr.problem, corner_simulation.samples, reference=False, discrepancy="none")


def test_a_known_length_is_what_three_faces_lack(ur5):
    """The arm's size is better known than its prior, so no weak direction, and nearly all of what remains."""
    cell = Cell(faces=corner((450.0, 0.0, 250.0), size=300.0))
    now, found = found_on(ur5, cell)
    kinds = by_kind(found)
    assert now == pytest.approx(0.236, rel=0.15)
    assert kinds["step"] == pytest.approx(0.0293, rel=0.15)
    assert kinds["same"] == pytest.approx(0.175, rel=0.15)  # 24 that nobody planned leave 0.215
    assert kinds["many"] == pytest.approx(0.147, rel=0.15)
    assert kinds["face"] == pytest.approx(0.175, rel=0.15)
    assert next(iter(kinds)) == "step"
    assert found[0].recommended
    assert not any(cure.recommended for cure in found if "another at right angles" in cure.words)


def test_one_face_and_a_tool_normal_to_it_need_another_face(one_face):
    kinds = by_kind(one_face.cures)
    assert one_face.tip_std[1] == pytest.approx(2.37, rel=0.15)
    for kind, expected in {"face": 0.63, "tilt": 1.65, "step": 2.18}.items():
        assert kinds[kind] == pytest.approx(expected, rel=0.15)
    assert next(iter(kinds)) == "face"
    assert kinds["inclined"] < kinds["tilt"] < kinds["step"] < one_face.tip_std[1]


def test_cures_are_recommended_that_gain_more_than_a_few_per_cent(one_face, three_faces):
    """More of the same against none; any other against as many touches of the same kind."""
    for found, worth in (
        (three_faces, {"step", "noise", "same", "many"}),
        (one_face, {"face", "inclined", "tilt", "same"}),
    ):
        kinds = by_kind(found.cures)
        chosen = {kind for kind, cure in zip(kinds, found.cures, strict=True) if cure.recommended}
        assert chosen - {"face"} == worth - {"face"}  # on three faces another one is at the limit
        for kind, error in kinds.items():
            assert (error < 0.95 * (found.tip_std[1] if kind == "same" else kinds["same"])) == (kind in chosen)
    kinds = by_kind(one_face.cures)  # the figures lie on both sides, near enough to tell a wrong limit
    assert 0.955 < kinds["noise"] / kinds["same"] < 0.98
    assert 0.92 < kinds["same"] / one_face.tip_std[1] < 0.945


def test_a_level_plate_under_a_scara_is_inclined_and_what_it_cannot_reach_is_left_out(scara):
    now, found = found_on(scara, Cell(faces=plate((450.0, 0.0, 250.0), size=300.0), tilt=math.radians(1)))
    kinds = by_kind(found)
    assert now == pytest.approx(1.42, rel=0.15)
    assert kinds["inclined"] == pytest.approx(0.88, rel=0.15)
    assert [cure.words for cure in found if cure.recommended] == [found[0].words]
    assert next(iter(kinds)) == "inclined"
    assert "face" not in kinds  # its plunger points down
    assert kinds["step"] > 0.9 * now


@pytest.mark.long_unless("by label")
@pytest.mark.parametrize("labels", [True, False], ids=["by label", "one plane"])
def test_figures_are_those_of_all_rows_bound_together(hsr, labels):
    """The touches appended to the samples and the whole bound anew: on the drawn arm both must say the same."""
    dial = hsr.problem.instrument if labels else dataclasses.replace(hsr.problem.instrument, plane=Plane())
    problem = Problem(hsr.problem.robot, dial)
    cell = Cell(faces=hsr.cell.faces if labels else FLAT.faces, error_scale=0.0, repeatability=0.0, resolution=0.0)
    bound = bind(problem, simulate(problem, cell, seed=1).samples, backend="blocks")
    kinds = by_kind(cures(bound, bound.x0))
    here = bound.samples[0]
    if not labels:
        here = dataclasses.replace(here, labels={"plane": here.faces(None)})
    best = {}
    for outcome in outcomes(bound, bound.x0):
        if outcome.kind != "noise":
            together = planned_accuracy(bind(outcome.problem, joined(here, outcome.rows), backend="blocks"))[1]
            best[outcome.kind] = min(best.get(outcome.kind, math.inf), together)
    assert best.keys() == kinds.keys() - {"noise"}
    for kind, together in best.items():
        assert kinds[kind] == pytest.approx(together, rel=0.01)


def test_planned_touches_are_the_best_of_what_could_be_made(hsr, three_faces):
    """No random choice of as many is as good; all rows bound together."""
    bound = three_faces.fit
    touches = CalibratedCell.of(bound, bound.x0)
    pools = {offer.kind: touches.on(offer.cell) for offer in offers(bound, touches) if offer.kind in ("same", "step")}
    rng = np.random.default_rng(3)
    for outcome in outcomes(bound, bound.x0):
        if outcome.kind not in pools:
            continue
        pool = pools[outcome.kind]
        choices = [outcome.rows, *(pool.take(rng.choice(len(pool), 24, replace=False)) for _ in range(6))]
        both = [bind(outcome.problem, joined(three_faces.samples, rows), backend="blocks") for rows in choices]
        planned, *at_random = (planned_accuracy(each)[1] for each in both)
        assert planned < 0.97 * min(at_random)
        assert len(outcome.rows) == outcome.touches == 24
        chosen = {tuple(row) for row in outcome.rows.joints}
        assert len(chosen) == 24
        assert chosen <= {tuple(row) for row in pool.joints}


def test_extra_touches_lie_on_their_faces_at_the_estimate(hsr, three_faces):
    touches = CalibratedCell.of(three_faces.fit, three_faces.x)
    truth = hsr.cell.faces
    for face in touches.faces:
        (true,) = (each for each in truth if each.label == face.label)
        assert face.axes[0] @ true.axes[0] > math.cos(0.005)
        assert abs((np.asarray(face.centre) - np.asarray(true.centre)) @ true.axes[0]) < 5
    assert math.radians(27) < touches.tilt < math.radians(31)
    step = next(offer for offer in offers(three_faces.fit, touches) if offer.kind == "step")
    rows = touches.on(step.cell)
    tips, plungers = touches.touch.place(touches.touch.local, rows.joints, rows.columns["reading"][:, None])
    base = touches.faces[0]
    heights = (tips - np.asarray(base.centre)) @ base.axes[0]
    on_block = np.array([label != base.label for label in rows.labels["plane"]])
    np.testing.assert_allclose(heights, np.where(on_block, 100.0, 0.0), atol=1e-6)
    assert abs(on_block.mean() - 0.5) < 0.1
    assert (-(plungers @ base.axes[0]) > math.cos(math.radians(31))).all()


def test_the_noise_in_use_counts(hsr, corner_simulation):
    bound = bind(hsr.problem, corner_simulation.samples)
    dial = dataclasses.replace(hsr.problem.instrument, noise_std=0.03)
    stated = by_kind(
        cures(bind(Problem(hsr.problem.robot, dial), corner_simulation.samples, backend="blocks"), bound.x0)
    )
    for scale in ({"": 3.0}, {"floor": 3.0, "wall": 3.0, "side": 3.0}):  # a new face takes the noise of the others
        found = cures(bound.with_noise(scale), bound.x0)
        assert by_kind(found) == pytest.approx(stated, rel=1e-6)
        assert "indicator" not in next(cure.words for cure in found if "half the noise" in cure.words)


@pytest.mark.long
def test_planes_that_are_declared_or_face_away_change_nothing(hsr):
    """New faces stand where they are touched, not where a plane was declared; a step rises towards the tool."""
    samples = simulate(hsr.problem, FLAT, seed=1).samples
    declared = Plane(normal=(0, 0, -1), point=(1350.0, 0.0, 500.0))
    found = []
    for plane in (Plane(), declared):
        problem = Problem(hsr.problem.robot, dataclasses.replace(hsr.problem.instrument, plane=plane))
        bound = bind(problem, dataclasses.replace(samples, labels={}), backend="blocks")
        found.append(by_kind(cures(bound, lm(bound).x)))
    (step,) = (each for each in offers(bound, CalibratedCell.of(bound, bound.x0)) if each.kind == "step")
    assert step.problem.instrument.steps["known step"].height == -100.0
    assert found[1] == pytest.approx(found[0], rel=0.15)  # sides are counted the other way round, and touched elsewhere
    held = Problem(hsr.problem.robot, dataclasses.replace(hsr.problem.instrument, plane=Plane(per="plane"))).fix(
        "plane"
    )
    bound = bind(held, samples, backend="blocks")
    assert not {"face", "inclined"} & by_kind(cures(bound, lm(bound).x)).keys()


@pytest.mark.long_unless("instruments/spheres")
@pytest.mark.parametrize(
    "name", ["adept_cobra600", *(f"instruments/{each}" for each in ("spheres", "ball_bar", "plate", "camera"))]
)
def test_samples_without_labelled_faces_are_planned(name):
    """The arm can take them where things were found, and no random choice is as good; all rows bound together."""
    found = load_problem(ROOT / "problems" / name)
    still = {"error_scale": 0.0, "repeatability": 0.0, "resolution": 0.0}
    cell = Disturbances(**still) if found.cell is None else dataclasses.replace(found.cell, **still)
    samples = simulate(found.problem, cell, samples=48, seed=1).samples
    bound = bind(found.problem, samples, backend="blocks")
    kinds = by_kind(cures(bound, bound.x0))
    assert {"same", "many", "noise"} <= kinds.keys() <= {"same", "many", "noise", "tilt", "tool"}
    lower, upper = found.problem.robot.limits
    for outcome in outcomes(bound, bound.x0):
        if outcome.kind not in ("same", "many"):
            continue
        rows = outcome.rows
        assert len({tuple(row) for row in rows.joints}) == outcome.touches
        assert ((rows.joints >= lower - 1e-9) & (rows.joints <= upper + 1e-9)).all()
        assert np.abs(bound.on(rows).plain_residual(bound.x0)).max() < 1e-5
        together = planned_accuracy(bind(found.problem, joined(samples, rows), backend="blocks"))[1]
        assert kinds[outcome.kind] == pytest.approx(together, rel=0.01)
        assert all(len(set(each)) > 1 and set(each) <= set(samples.labels[key]) for key, each in rows.labels.items())
    assert kinds["noise"] < 0.96 * kinds["same"]
    further = simulate(found.problem, cell, samples=24 * 6, seed=2).samples
    at_random = (joined(samples, further.take(range(k, 24 * 6, 6))) for k in range(6))
    assert kinds["same"] < 0.99 * min(
        planned_accuracy(bind(found.problem, rows, backend="blocks"))[1] for rows in at_random
    )


def test_extra_samples_are_taken_where_things_were_found():
    """Spheres stand where the calibrated arm says, not where the drawn one thought."""
    found = load_problem(ROOT / "problems" / "instruments" / "spheres")
    bound = bind(found.problem, simulate(found.problem, samples=60, seed=3).samples)
    x = lm(bound).x
    rows = extra_samples(bound, x)
    assert np.abs(bound.on(rows).plain_residual(x)).max() < 1e-5
    assert np.abs(bound.on(rows).plain_residual(bound.x0)).max() > 0.1


def test_a_camera_of_few_rows_has_cures():
    """Some postures are not found then, and have no orientation to be told."""
    camera = load_problem(ROOT / "problems" / "instruments" / "camera").problem
    for seed in (3, 4):
        bound = bind(camera, simulate(camera, samples=12, seed=seed).samples)
        assert cures(bound, lm(bound).x)


def test_what_no_posture_reaches_has_more_of_the_same_as_it_is():
    """A spike out of reach: nothing can be planned, and the samples that there are stand for more."""
    found = load_problem(ROOT / "problems" / "instruments" / "spike")
    samples = simulate(found.problem, samples=48, seed=1).samples
    bound = bind(found.problem, samples)
    away = bound.x0.copy()
    for slot in bound.slots:
        if slot.key == "point":
            away[slot.columns] = 1e5
    found = cures(bound, away)
    assert any(cure.words == "24 more samples of the same kind" for cure in found)


def test_directions_name_cures_of_the_list(one_face):
    words = {cure.words for cure in one_face.cures}
    said = [each.removesuffix(" (in part)") for each in one_face.advice]
    assert set(said) <= words | {NO_CURE, "none needed"}
    assert one_face.cures[0].words in said
    directions = (*one_face.identifiability.null, *one_face.identifiability.weak)
    prior, arm = one_face.fit.prior_std, ~one_face.fit.datum
    for direction, each in zip(directions, one_face.advice, strict=True):
        if each != NO_CURE:
            continue
        along = direction.direction[arm] / prior[arm]
        spread = [
            along @ c[np.ix_(arm, arm)] @ along for c in (one_face.covariance, *(c.covariance for c in one_face.cures))
        ]
        assert min(spread[1:]) > 0.9 * spread[0]


def test_nothing_is_worked_out_before_it_is_asked_for(hsr, corner_simulation):
    found = calibrate(hsr.problem, corner_simulation.samples, reference=False, discrepancy="none")
    assert "cures" not in vars(found)
    assert found.cures is found.cures


def test_every_report_says_the_best_and_its_figure(three_faces):
    best, now = three_faces.cures[0], three_faces.tip_std[1]
    figures = f"{now:.2f} -> {best.expected_rms_mm:.2f} mm"
    assert best_cure(three_faces) == f"{best.words}; expected tip error {figures}."
    verdict = verdict_of(three_faces)
    assert verdict.level == "calibrated"
    flat = " ".join(brief(three_faces, verdict).split())
    assert f"Next: {best_cure(three_faces)} Then: add --out DIR" in flat
    document = calibration_document(three_faces)
    assert [entry["expected_rms_mm"] for entry in document["cures"]] == sorted(by_kind(three_faces.cures).values())
    assert document["cures"][0]["recommended"]
    assert {entry["words"].split()[0]: entry["touches"] for entry in document["cures"]} == {"24": 24, "60": 60}
    text = summary(three_faces, "hsr")
    for cure in three_faces.cures:
        (line,) = (line for line in text.splitlines() if line.startswith(f"{cure.words}  "))
        assert line.split()[-3:] == [f"{cure.expected_rms_mm:.3f}", "mm", "yes" if cure.recommended else "no"]


def test_a_doubt_is_settled_before_the_cure(one_face):
    verdict = dataclasses.replace(verdict_of(one_face), level="use with care")
    flat = " ".join(brief(one_face, verdict).split())
    assert flat.index("Next: ") < flat.index("Then: ")
    assert f"Then: {best_cure(one_face)}" in flat


@pytest.mark.long
def test_a_verdict_that_denies_the_result_denies_the_figures(hsr, corner_simulation, three_faces):
    samples = corner_simulation.samples
    wrong = dataclasses.replace(samples, columns={"reading": -samples.columns["reading"]})
    found = calibrate(hsr.problem, wrong, reference=False, discrepancy="none")
    verdict = verdict_of(found)
    assert verdict.level == "do not use"
    document = json.loads(json.dumps(calibration_document(found)["cures"]))
    assert document == []
    denied = dataclasses.replace(verdict_of(three_faces), level="do not use")
    for said in (brief(three_faces, denied, room=60), brief(found, verdict, room=60), summary(found, "hsr")):
        assert "expected tip error" not in said
        assert not re.search(r"-> [\d.]+ mm", said)


def test_it_is_said_when_nothing_helps(three_faces):
    idle = tuple(dataclasses.replace(cure, recommended=False) for cure in three_faces.cures)
    found = dataclasses.replace(three_faces)
    vars(found.unjudged)["cures"] = idle
    assert best_cure(found) == ""
    assert nothing_helps(found).startswith("More touches help little: expected tip error ")
    assert nothing_helps(found) in summary(found, "hsr")
    assert nothing_helps(found) in " ".join(brief(found, verdict_of(found)).split())
    assert nothing_helps(three_faces) == ""


@pytest.mark.parametrize(
    ("now", "after", "said"),
    [
        (0.288, 0.038, "0.29 -> 0.04 mm"),
        (0.036, 0.028, "0.036 -> 0.028 mm"),
        (0.564, 0.561, "0.564 -> 0.561 mm"),
        (0.3, 0.012, "0.300 -> 0.012 mm"),
    ],
)
def test_two_figures_can_be_told_apart(now, after, said):
    assert fall(now, after) == said


@pytest.mark.long
def test_labels_of_other_things_stay_as_they_mostly_are(hsr):
    """Tools by day: extra touches are made on the commonest day."""
    tool = Parameter((0.0, 0.0, 0.0), unit="mm", prior_std=0.5, per="day", labels=("_x", "_y", "_z"))
    problem = Problem(hsr.problem.robot, dataclasses.replace(hsr.problem.instrument, tool=tool))
    samples = simulate(hsr.problem, hsr.cell, seed=1).samples
    days = [f"day {k % 10 if k < 100 else 7}" for k in range(120)]
    samples = dataclasses.replace(samples, labels={**samples.labels, "day": Labels.of(days)})
    whole = bind(problem, samples, backend="blocks")
    x = lm(whole).x
    touches = CalibratedCell.of(whole, x)
    assert set(touches.on(next(offers(whole, touches)).cell).labels["day"]) == {"day 7"}
    (step,) = (outcome for outcome in outcomes(whole, x) if outcome.kind == "step")
    together = bind(step.problem, joined(samples, step.rows), backend="blocks")
    kinds = by_kind(cures(whole, x))
    assert kinds.keys() == {"step", "same", "many", "noise", "face"}
    assert kinds["step"] == pytest.approx(planned_accuracy(together)[1], rel=0.05)

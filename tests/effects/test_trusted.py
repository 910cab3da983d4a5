"""Constants that instruments take for exact: doubted, never a reason to refuse, told by steps; plates that bow."""

import dataclasses
import math
from collections.abc import Mapping

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

from casacal import (
    DialOnPlane,
    Direction,
    Instrument,
    Parameter,
    Problem,
    SphereTouch,
    calibrate,
    dial_gain,
    load_problem,
    simulate,
)
from casacal.calibration.result_json import calibration_document
from casacal.calibration.verdict import verdict_of
from casacal.deployment.result_file import check_document
from casacal.effects.trusted import CONSTANTS, with_constants
from casacal.errors import ProblemError
from casacal.files import jsonable
from casacal.model import Trusted
from casacal.model.kinematics import position
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints
from casacal.values import FrozenMapping

UR5 = ROOT / "problems" / "ur5"


def tip_error(found, made):
    """Distance of the tips of a calibration from the true ones, mm RMS over the workspace, apart from the base."""
    joints = workspace_joints(made.problem.robot)
    true = made.true_tips(joints)
    return tip_rms(without_rigid((found.motion.arm.tips(found.motion.x, joints) - true).ravel(), true))


DEGREE = math.radians(1.0)


def tilted(source, seed, angle=DEGREE):
    """Touches with a plunger that stands off the axis that its problem states."""
    way = 2 * math.pi * seed / 5
    plunger = Direction((math.sin(angle) * math.cos(way), math.sin(angle) * math.sin(way), math.cos(angle)), free=False)
    other = Problem(source.problem.robot, dataclasses.replace(source.problem.instrument, plunger=plunger))
    return simulate(other, source.cell, samples=120, seed=seed)


@pytest.mark.parametrize("name", ["hsr_jr680", "ur5"])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_plunger_a_degree_off_is_neither_refused_nor_believed(name, seed):
    source = load_problem(ROOT / "problems" / name)
    made = tilted(source, seed)
    found = calibrate(source, made.samples, reference=False)
    assert verdict_of(found).level == "calibrated"
    assert tip_error(found, made) < 2 * found.tip_std[1]
    trusting = calibrate(source, made.samples, reference=False, discrepancy="none")
    assert verdict_of(trusting).level != "calibrated", "the rows show it, and geometry cannot follow"


def test_the_gain_is_said_with_its_cure_and_a_step_tells_it(hsr):
    found = calibrate(hsr, simulate(hsr.problem, hsr.cell, samples=120, seed=1).samples, reference=False)
    most = found.leverages[0]
    assert (most.name, most.std, most.unit) == ("gain", 0.15, "%")
    words = verdict_of(found).words
    assert "priors and the dial's gain within 0.15 % are right" in words
    assert (most.left_mm > found.tip_std[1] / 2, most.cure) == (True, "a gauge block")
    assert "gauge block" in found.cures[0].words
    assert found.cures[0].expected_rms_mm < 0.6 * found.tip_std[1], "a step tells the gain, other touches do not"
    source = load_problem(UR5)
    told = calibrate(source, simulate(source.problem, source.cell, samples=120, seed=1).samples, reference=False)
    assert {each.name: each.left_mm < 0.3 * told.tip_std[1] for each in told.leverages} == {
        "gain": True,
        "plunger": True,
    }
    assert "gain" not in verdict_of(told).words


def test_what_it_is_worth_is_what_a_wrong_one_does(hsr):
    """A second calibration, that trusts the dial, of readings that are 0.15 % too large."""
    made = simulate(hsr.problem, hsr.cell, samples=120, seed=3)
    reading = made.samples.columns["reading"]
    joints, tips = workspace_joints(hsr.problem.robot), []
    for times in (1.0, 1.0015):
        samples = dataclasses.replace(made.samples, columns={"reading": reading * times})
        found = calibrate(hsr, samples, reference=False, discrepancy="none", noise="stated", outliers="keep")
        tips.append(found.fit.tips(found.result.x, joints))
    moved = tip_rms(without_rigid((tips[1] - tips[0]).ravel(), tips[0]))
    doubting = calibrate(hsr, made.samples, reference=False, noise="stated", outliers="keep")
    assert doubting.leverages[0].tip_mm == pytest.approx(moved, rel=0.2)


def test_leverage_is_the_shift_of_a_fit_that_knows_no_constant(hsr):
    """H (J'J + Lambda)^-1 J' dr/du std over the unknowns that are no constants, from Jacobian and prior alone."""
    found = calibrate(hsr, simulate(hsr.problem, hsr.cell, samples=120, seed=1).samples, reference=False)
    fit, x = found.fit, found.result.x
    ours = np.array([key == CONSTANTS.key for key in fit.beside])
    jacobian, joints = fit.jacobian(x), workspace_joints(fit.problem.robot)
    field = without_rigid(fit.tip_jacobian(x, joints), fit.tips(x, joints))[..., ~ours]
    rest = jacobian[:, ~ours]
    normal = rest.T @ rest + fit.prior_information[np.ix_(~ours, ~ours)]
    shifts = np.linalg.solve(normal, rest.T @ jacobian[:, ours]) * fit.prior_std[ours]
    names = np.array(fit.names)[ours]
    for each in found.leverages:
        moved = [tip_rms(field @ shift) for name, shift in zip(names, shifts.T, strict=True) if each.name in name]
        assert each.tip_mm == pytest.approx(np.linalg.norm(moved), rel=1e-3)


def test_what_is_declared_is_not_doubted_twice(hsr):
    dial = hsr.problem.instrument
    declared = dataclasses.replace(dial, gain=dial_gain(0.05), plunger=Direction((0, 0, 1), prior_std=0.01))
    assert set(dial.trusted) == {"gain", "plunger"}
    assert declared.trusted == {}
    problem = Problem(hsr.problem.robot, declared)
    assert with_constants(problem) is problem
    once = with_constants(hsr.problem)
    assert once.terms == (CONSTANTS,)
    assert with_constants(once) is once
    certified = dataclasses.replace(dial, plunger=Direction((0, 0, 1), prior_std=0.002, free=False))
    assert certified.trusted["plunger"].std == 0.002
    assert DialOnPlane(noise_std=0.01, reading=False).trusted == {}


def test_a_sphere_of_another_size_than_stated_is_within_the_promise():
    source = load_problem(UR5)
    held = SphereTouch(noise_std=0.01, radii=Parameter(30.0, free=False), tool=source.problem.instrument.tool)
    problem = Problem(source.problem.robot, held)
    made = simulate(Problem(problem.robot, dataclasses.replace(held, radii=Parameter(30.03, free=False))), samples=150)
    found = calibrate(problem, made.samples, reference=False)
    (radius,) = found.leverages
    assert (radius.name, radius.std, radius.unit) == ("radii", 0.02, "mm")
    assert verdict_of(found).level == "calibrated"
    assert tip_error(found, made) < 2.5 * found.tip_std[1]
    trusting = calibrate(problem, made.samples, reference=False, discrepancy="none")
    assert tip_error(trusting, made) > 2.5 * trusting.tip_std[1], "who takes it for exact promises too much"


def test_a_result_keeps_them(hsr, tmp_path):
    found = calibrate(hsr, simulate(hsr.problem, hsr.cell, samples=120, seed=1).samples, reference=False)
    document = jsonable(calibration_document(found))
    check_document("result.json", document)
    assert [each["name"] for each in document["trusted_constants"]] == ["gain", "plunger"]
    assert "The dial's gain" in found.summary()
    found.report(tmp_path / "report.html")
    assert 'id="constants"' in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert calibration_document(calibrate(hsr, found.samples, discrepancy="none"))["trusted_constants"] == []


@dataclasses.dataclass(frozen=True)
class Wire(Instrument):
    """A draw wire of one's own, from a post that a survey knows, and what it takes for exact."""

    said: Mapping[str, object] = dataclasses.field(default_factory=dict)
    post: Parameter = Parameter((1500.0, 0.0, 200.0), prior_std=2.0, free=False)

    columns = FrozenMapping({"wire": "length"})
    column_stds = FrozenMapping({"wire": 0.05})

    @property
    def unknowns(self):
        return {"post": self.post}

    @property
    def trusted(self):
        return self.said

    def residual(self, pose, p, row):
        return ca.norm_2(position(pose) - p.post) - row.wire


def taken(**said):
    """A constant with what is said of it, else as it should be."""
    return Trusted(**{"words": "the wire", "std": 0.05, "unit": "%", **said})


POST = taken(words="the post", std=2.0, unit="mm", shifts="post", count=3)


def test_an_instrument_of_ones_own_says_what_it_trusts(hsr):
    """A post 6 mm elsewhere under a prior of 2 mm: within the promise where it is doubted, beyond it where not."""
    true = Problem(hsr.problem.robot, Wire(post=Parameter((1503.0, -5.0, 202.0), free=False)))
    made, ratios = simulate(true, samples=150, seed=1), []
    for said in ({"post": POST}, {}):
        found = calibrate(Problem(hsr.problem.robot, Wire(said)), made.samples, reference=False)
        ratios.append(tip_error(found, made) / found.unjudged.tip_std[1])
        assert [each.name for each in found.leverages] == list(said)
    assert ratios[0] < 1 < 1.5 < ratios[1]


@pytest.mark.parametrize(
    ("constant", "sentence"),
    [
        (taken(scales=("wires",)), "scales 'wires', which is no column"),
        (taken(), "scales and shifts nothing"),
        (taken(scales=("wire",), shifts="post"), "scales and shifts two things"),
        (taken(shifts="pole"), "shifts 'pole', which is no unknown"),
        (taken(shifts="post"), "shifts 1 numbers of 'post'. Give count=3"),
        (taken(scales=("wire",), std=0.0), "standard deviation 0.0"),
        (taken(scales=("wire",), std=math.nan), "standard deviation nan"),
        (taken(scales=("wire",), std="much"), "standard deviation 'much'"),
        (0.1, "is a float"),
    ],
)
def test_what_cannot_be_doubted_is_said(hsr, constant, sentence):
    with pytest.raises(ProblemError, match=sentence):
        Problem(hsr.problem.robot, Wire({"scale": constant}))


def test_what_is_free_has_a_prior_of_its_own(hsr):
    with pytest.raises(ProblemError, match="shifts 'post', which is not held at a value"):
        Problem(hsr.problem.robot, Wire({"post": POST}, Parameter((1500.0, 0.0, 200.0), prior_std=2.0)))


def bowed(made, source, height):
    """The touches of a cell whose plates are spherical caps, and whose block stands on one: readings by hand."""
    samples, dial, faces = made.samples, source.problem.instrument, {face.label: face for face in source.cell.faces}
    read = samples.columns["reading"]
    tips, deeper = (made.true_tips(samples.joints, readings=each) for each in (read, read + 1))
    shown = read.copy()
    for k, label in enumerate(samples.labels["plane"]):
        face = faces[dial.steps[label].on if label in dial.steps else label]
        apart = (np.array(faces[label].centre) if label in dial.steps else tips[k]) - np.array(face.centre)
        normal = np.array(face.normal, dtype=float)
        apart = apart - (apart @ normal) * normal
        rise = height * (1 - (apart @ apart) / (face.size[0] / 2) ** 2)
        shown[k] += rise / float(normal @ (deeper[k] - tips[k]))
    return dataclasses.replace(samples, columns={"reading": shown})


@pytest.mark.parametrize(("height", "seed"), [(0.15, 1), pytest.param(0.015, 2, marks=pytest.mark.long)])
def test_a_block_stands_where_the_plate_bows_to(height, seed):
    """Its height is above the plate under it, not above its mean plane; else the arm's size is that much off."""
    source = load_problem(UR5)
    made = simulate(source.problem, source.cell, samples=120, seed=seed)
    found = calibrate(source, bowed(made, source, height), reference=False)
    assert verdict_of(found).level != "do not use"
    error = tip_error(found, made)
    assert error < 0.15
    assert error < 2 * found.tip_std[1]
    forms = {name.split(".")[1][:4] for name in found.fit.names if name.startswith("form.")}
    assert "bloc" not in forms, "a step has the form of the face that it stands on"

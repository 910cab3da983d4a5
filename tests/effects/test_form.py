"""Spheres that are not round, plates that are bent, focal lengths that are wrong: errors with a shape of their own."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from casacal import Parameter, Problem, SphereTouch, bind, calibrate, load, load_problem, simulate
from casacal.effects import FocalLength, PlateForm, SphereForm
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints

INSTRUMENTS = Path(__file__).parents[2] / "problems" / "instruments"
SEEDS = [1, pytest.param(2, marks=pytest.mark.long)]


def spheres():
    """Spheres whose radius is taken for exact."""
    problem = load_problem(INSTRUMENTS / "spheres").problem
    held = Parameter(30.0, unit="mm", free=False)
    return Problem(problem.robot, dataclasses.replace(problem.instrument, radii=held))


def centre_of(points):
    """Centre of the sphere through points (N, 3), by least squares in |x|^2."""
    rows = np.column_stack([2 * points, np.ones(len(points))])
    return np.linalg.lstsq(rows, (points**2).sum(axis=1), rcond=None)[0][:3]


def not_round(made, height, rng):
    """Samples of spheres with a random quadratic form of some RMS height: tips brought to them by hand."""
    samples, step = made.samples, 1e-6
    tips, joints = made.true_tips(samples.joints), samples.joints.copy()
    slopes = np.stack(
        [(made.true_tips(joints + step * unit) - tips) / step for unit in np.eye(joints.shape[1])], axis=2
    )
    labels = np.array(samples.labels["sphere"]) if "sphere" in samples.labels else np.zeros(len(tips))
    for label in np.unique(labels):
        own = labels == label
        away = tips[own] - centre_of(tips[own])
        away /= np.linalg.norm(away, axis=1)[:, None]
        form = rng.normal(size=(3, 3))
        form = form + form.T - 2 * np.trace(form) / 3 * np.eye(3)
        rise = np.einsum("ni,ij,nj->n", away, form, away)
        along = np.einsum("ni,nij->nj", away, slopes[own])
        joints[own] += along * (rise * height / rise.std() / (along**2).sum(axis=1))[:, None]
    return dataclasses.replace(samples, joints=joints)


def bent(height):
    """A problem whose plate is bent along and twisted, and the same as it is drawn: flat."""
    flat = load_problem(INSTRUMENTS / "plate").problem
    points = {
        name: (x, y, z + height * (((x - 150) / 150) ** 2 - (x - 150) * (y - 100) / 15000))
        for name, (x, y, z) in flat.instrument.points.items()
    }
    return Problem(flat.robot, dataclasses.replace(flat.instrument, points=points)), flat


def seen_through(samples, part):
    """Poses by a camera whose focal length is wrong by a part: board farther away along the camera's axis."""
    read = samples.columns
    axis = Rotation.from_rotvec(np.column_stack([read["turn_x"], read["turn_y"], read["turn_z"]])).as_matrix()[:, :, 2]
    place = np.column_stack([read["x"], read["y"], read["z"]])
    place = place + part * (axis * place).sum(axis=1)[:, None] * axis
    return dataclasses.replace(samples, columns={**read, **dict(zip("xyz", place.T, strict=True))})


def errors(found, made):
    """Tip error (mm RMS) of a calibration over the workspace, apart from where the base stands, and of its promise."""
    joints = workspace_joints(found.fit.problem.robot)
    true, motion = made.true_tips(joints), found.motion
    return tip_rms(without_rigid((motion.arm.tips(motion.x, joints) - true).ravel(), true)), found.tip_std[1]


@pytest.mark.parametrize("seed", SEEDS)
def test_spheres_that_are_not_round_are_promised_no_more_than_they_keep(seed):
    """With the form left out 0.44 mm were promised and 1.12 true."""
    problem = spheres()
    made = simulate(problem, samples=120, seed=seed)
    samples = not_round(made, 0.05, np.random.default_rng(seed))
    found = calibrate(problem, samples, reference=False)
    assert found.verdict.level == "calibrated"
    true, promised = errors(found, made)
    assert true < 1.35 * promised
    plain, _ = errors(calibrate(problem, samples, reference=False, discrepancy="none").unjudged, made)
    assert true < plain
    (size,) = (each for each in found.effect_sizes if each.key == "roundness")
    assert size.shown
    assert 0.025 < size.size < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_a_plate_that_is_bent_is_not_taken_for_sag(seed):
    """With the form left out 0.17 mm were promised and 0.27 true."""
    true_problem, flat = bent(0.3)
    made = simulate(true_problem, samples=120, seed=seed)
    found = calibrate(flat, made.samples, reference=False)
    assert found.verdict.level == "calibrated"
    assert "give" not in found.corrected
    true, promised = errors(found, made)
    assert true < 1.35 * promised < 0.1
    named = [value for name, value in zip(found.fit.names, found.x, strict=True) if name.startswith("bow")]
    assert np.abs(named) == pytest.approx([0.3, 0.3, 0.0], abs=0.03)  # which way a normal points is nobody's matter


@pytest.mark.parametrize("seed", SEEDS)
def test_a_wrong_focal_length_is_found(seed):
    """With the camera taken for exact 0.16 mm were promised and 0.48 true."""
    problem = load_problem(INSTRUMENTS / "camera").problem
    made = simulate(problem, samples=120, seed=seed)
    found = calibrate(problem, seen_through(made.samples, 0.002), reference=False)
    assert found.verdict.level == "calibrated"
    true, promised = errors(found, made)
    assert true < 1.35 * promised < 0.4
    (part,) = (value for name, value in zip(found.fit.names, found.x, strict=True) if name.startswith("focal"))
    assert abs(part) == pytest.approx(0.002, abs=3e-4)


def test_a_roundness_of_one_is_one_on_average():
    """Amplitudes of standard deviation one make a radius of standard deviation one in every direction."""
    problem = spheres()
    samples = simulate(problem, samples=40, seed=1).samples
    whole = bind(problem, samples).under(problem.with_terms(SphereForm(size=1.0)))
    own = np.flatnonzero([key == "roundness" for key in whole.beside])
    slopes = whole.jacobian(whole.x0)[:, own] * problem.instrument.noise_std
    variances = (slopes**2).sum(axis=1)
    np.testing.assert_allclose(variances, variances[0], rtol=1e-6)
    assert variances[0] == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "effects"),
    [("tracker", (SphereForm(), PlateForm(), FocalLength())), ("camera", (SphereForm(), PlateForm()))],
)
def test_other_instruments_have_no_such_errors(name, effects):
    problem = load_problem(INSTRUMENTS / name).problem.with_terms(*effects)
    assert not any(bind(problem, simulate(problem, samples=20, seed=1).samples).beside)


class OwnSpheres(SphereTouch):
    """Somebody's own."""


def test_ones_own_instrument_is_read_back_as_it_was_calibrated(tmp_path):
    problem = load_problem(INSTRUMENTS / "spheres").problem
    made = simulate(problem, samples=60, seed=1)
    parts = {field.name: getattr(problem.instrument, field.name) for field in dataclasses.fields(problem.instrument)}
    found = calibrate(Problem(problem.robot, OwnSpheres(**parts)), made.samples, reference=False)
    assert not any(name.startswith("roundness") for name in found.fit.names)
    found.save(tmp_path)
    joints = made.samples.joints[:3]
    np.testing.assert_allclose(load(tmp_path).predict(joints).positions, found.predict(joints).positions, atol=1e-9)

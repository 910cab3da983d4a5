"""Figures that users rely on, worked out again in another way: a wrong unit or a lost term shows here."""

import argparse
import dataclasses
import json
import math

import numpy as np
import pytest
from oracles import central_difference
from scipy.stats import t
from test_scale import exact, raised_faces

from casacal import Problem, Step, bind, calibrate, lm, simulate
from casacal.calibration.set_aside import studentised_outliers
from casacal.cli.common import adjusted
from casacal.cli.main import main
from casacal.data.samples import write_samples
from casacal.kernels.losses import huber
from casacal.model.robot import random_joints
from casacal.uncertainty.figures import leverages
from casacal.uncertainty.tip_error import (
    WORKSPACE_POSES,
    accuracy_in_box,
    conditional_scale_std,
    marginal_scale_std,
    scale_direction,
    workspace_joints,
)

BOX = ((1000.0, 1700.0), (-400.0, 400.0), (400.0, 1000.0))


def test_every_standard_deviation_of_the_file_is_that_of_the_inverse(hsr, corner_simulation, tmp_path, capsys):
    """By the inverse of J'J + Lambda in units of the prior, angles in rad and lengths in mm alike."""
    file = tmp_path / "s.csv"
    write_samples(file, hsr.problem.layout(), corner_simulation.samples, [])
    assert (
        main(
            [
                "calibrate",
                str(hsr.path),
                str(file),
                "--method",
                "lm",
                "--no-reference",
                "--json",
                "--discrepancy",
                "none",
            ]
        )
        == 0
    )
    document = json.loads(capsys.readouterr().out)
    bound = bind(hsr.problem, hsr.problem.read(file))
    result = lm(bound)
    scaled = bound.jacobian(result.x) * bound.start_std
    inverse = np.linalg.inv(scaled.T @ scaled + np.diag(np.isfinite(bound.prior_std).astype(float)))
    stds = dict(zip(bound.names, bound.start_std * np.sqrt(np.diagonal(inverse)), strict=True))
    free = [row for row in document["parameters"] if row["known_from"] != "held"]
    assert {row["unit"] for row in free} == {"rad", "mm"}
    assert {row["name"] for row in free} <= stds.keys()
    told = {row["name"]: row["std"] for row in free}
    assert told == pytest.approx({name: stds[name] for name in told}, rel=1e-4)
    table = calibrate(hsr.problem, hsr.problem.read(file), method="lm", reference=False, discrepancy="none").parameters
    assert table["std"][list(told)].to_dict() == pytest.approx(told, rel=1e-9)


def test_a_prior_of_the_command_line_is_in_mm_and_rad(hsr):
    options = argparse.Namespace(accuracy=None, set=[], free=[], fix=[], prior=["theta=0.002", "alpha3=5e-4", "a=0.25"])
    priors = {key: p.prior_stds for key, p in adjusted(hsr.problem, options).robot.parameters.items()}
    np.testing.assert_array_equal(priors["theta"][1:-1], 0.002)
    assert priors["alpha"][2] == 5e-4
    assert set(priors["a"]) == {0.25}
    np.testing.assert_array_equal(priors["d"], hsr.problem.robot.parameters["d"].prior_stds)


@pytest.mark.parametrize("std", [0.0003, 0.02])
def test_a_certificate_is_believed_as_far_as_it_says(hsr, std):
    """Three lengths of 100 mm, each by its own certificate: the size is known to std / 100 / sqrt(3) at the best."""
    faces, steps = raised_faces(hsr)
    steps = {label: dataclasses.replace(step, std=std) for label, step in steps.items()}
    bound = exact(hsr, dataclasses.replace(hsr.problem.instrument, steps=steps), faces, 1.0, 240)
    columns = [j for j, name in enumerate(bound.names) if name.startswith("step_")]
    assert len(columns) == 3
    np.testing.assert_array_equal(bound.prior_std[columns], std)
    assert (lm(bound).std[columns] <= std * (1 + 1e-9)).all()
    assert marginal_scale_std(bound) > math.hypot(std / 100 / math.sqrt(3), 0.99 * conditional_scale_std(bound))


def test_a_certificate_that_is_wrong_is_found_out_as_far_as_it_allows(hsr):
    """The true height is 0.1 mm off: with a loose certificate the touches correct it, with a tight one they bend."""
    label, base = "top", "floor"
    (floor,) = (face for face in hsr.cell.faces if face.label == base)
    centre = tuple(np.array(floor.centre) + 100.1 * floor.axes[0])
    faces = (*hsr.cell.faces, dataclasses.replace(floor, label=label, centre=centre, size=(300.0, 300.0)))
    cell = dataclasses.replace(hsr.cell, faces=faces, error_scale=0.0, resolution=0.0)
    samples, found = simulate(hsr.problem, cell, samples=240, seed=1).samples, {}
    for std in (0.0003, 0.3):
        dial = dataclasses.replace(hsr.problem.instrument, steps={label: Step(base, 100.0, std=std)})
        bound = bind(Problem(hsr.problem.robot, dial), samples)
        result = lm(bound)
        found[std] = float(result.x[bound.names.index("step_1")])
    assert abs(found[0.0003]) < 0.001
    assert found[0.3] == pytest.approx(0.1, abs=0.04)


def test_joints_that_do_not_repeat_are_noise_of_a_row_by_its_slopes(hsr, corner_simulation):
    """sqrt(sum (slope std)^2) over reading and joints, slopes by differences of the residual in mm."""
    stds = np.array([1e-5, 4e-5, 2e-5, 8e-5, 3e-5, 5e-5])
    axes = [replaced(joint, std) for joint, std in zip(hsr.problem.robot.axes, stds, strict=True)]
    problem = Problem(dataclasses.replace(hsr.problem.robot, joints=axes), hsr.problem.instrument)
    samples = corner_simulation.samples.take(range(12))
    bound = bind(problem, samples)

    def residual(at):
        joints, reading = samples.joints + at[:6], samples.columns["reading"] + at[6]
        changed = dataclasses.replace(samples, joints=joints, columns={"reading": reading})
        return bound.on(changed).plain_residual(bound.x0)

    slopes = central_difference(residual, np.zeros(7), [1e-5] * 6 + [1e-3])
    expected = np.sqrt((slopes**2) @ np.append(stds, hsr.problem.instrument.noise_std) ** 2)
    np.testing.assert_allclose(bound.block.noise.ravel(), expected, rtol=1e-5)
    assert expected.max() > 3 * hsr.problem.instrument.noise_std


def replaced(joint, std):
    return dataclasses.replace(joint, repeatability_std=std)


def test_the_size_is_known_as_the_whole_matrix_says(hsr):
    """One more unknown without a prior beside all others with theirs, by an augmented QR."""
    faces, steps = raised_faces(hsr)
    for dial, where in (
        (hsr.problem.instrument, hsr.cell.faces),
        (dataclasses.replace(hsr.problem.instrument, steps=steps), faces),
    ):
        bound = exact(hsr, dial, where, 1.0, 120)
        rows = bound.jacobian(bound.x0) * bound.start_std
        prior = np.where(np.isfinite(bound.prior_std), 1.0, 0.0)
        augmented = np.block([[(rows @ (scale_direction(bound) / bound.start_std))[:, None], rows],
                              [np.zeros((len(prior), 1)), np.diag(prior)]])  # fmt: skip
        size = np.linalg.norm(augmented[:, 0])
        augmented[:, 0] /= size
        # what no other column explains of the first one
        rest, *_ = np.linalg.lstsq(augmented[:, 1:], augmented[:, 0], rcond=1e-13)
        left = np.linalg.norm(augmented[:, 0] - augmented[:, 1:] @ rest)
        assert marginal_scale_std(bound) == pytest.approx(1 / (size * left), rel=1e-3)


def test_the_worst_of_a_box_is_that_of_its_worst_posture(hsr, corner_bound):
    """By finite steps along the posterior's axes, at each posture in the box, less the workspace's rigid motion."""
    result = lm(corner_bound)
    rms, worst = accuracy_in_box(corner_bound, result.x, BOX)
    low, high = np.array(BOX).T
    tried = random_joints(hsr.problem.robot, 40_000, np.random.default_rng(0))
    tips = corner_bound.tips(result.x, tried)
    joints = tried[((tips >= low) & (tips <= high)).all(axis=1)][:WORKSPACE_POSES]
    frame = workspace_joints(hsr.problem.robot)
    here, there = corner_bound.tips(result.x, joints), corner_bound.tips(result.x, frame)
    squares = np.zeros(len(joints))
    for step in np.linalg.cholesky(result.covariance).T:
        moves = [corner_bound.tips(result.x + step, q) - at for q, at in ((joints, here), (frame, there))]
        squares += (less_rigid(moves[0], here, moves[1], there) ** 2).sum(axis=1)
    assert rms == pytest.approx(math.sqrt(squares.mean()), rel=1e-3)
    assert worst == pytest.approx(math.sqrt(squares.max()), rel=1e-3)
    assert worst > 1.25 * rms


def less_rigid(moves, tips, frame_moves, frame_tips):
    """Moves (N, 3) of tips less the small rigid motion that fits those of another set best."""

    def fields(points):
        turns = [np.cross(axis, points - frame_tips.mean(axis=0)) / 1000 for axis in np.eye(3)]
        shifts = [np.broadcast_to(axis, points.shape) for axis in np.eye(3)]
        return np.stack([field.ravel() for field in (*turns, *shifts)], axis=1)

    motion, *_ = np.linalg.lstsq(fields(frame_tips), frame_moves.ravel(), rcond=None)
    return moves - (fields(tips) @ motion).reshape(-1, 3)


def test_outliers_are_what_chance_gives_once_in_ten_thousand_sets(hsr, corner_bound):
    """Student's limit for the largest of all rows; seven standard deviations are found, three are not."""
    result = lm(corner_bound, loss=huber())
    found = studentised_outliers(corner_bound, result)
    leverage = leverages(corner_bound, result)
    free = corner_bound.rows - leverage.sum()
    assert found.limit == pytest.approx(t.isf(1e-4 / (2 * corner_bound.rows), free), rel=1e-6)
    assert 4.9 < found.limit < 5.5
    row, samples = int(np.argmin(leverage)), corner_bound.block.samples
    for size, named in ((8.0, (row,)), (3.0, ())):
        reading = samples.columns["reading"].copy()
        right = float(corner_bound.residual(lm(corner_bound).x)[row])
        reading[row] += (size - right) * hsr.problem.instrument.noise_std / math.sqrt(1 - leverage[row])
        spoiled = bind(hsr.problem, dataclasses.replace(samples, columns={"reading": reading}))
        assert studentised_outliers(spoiled, lm(spoiled, loss=huber())).rows == named

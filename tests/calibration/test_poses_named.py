"""Mistakes with whole poses are named: inverted ones, markers seen another way round, rounded orientations."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation

from casacal import Problem, TrackedPose, bind, calibrate, check, load_problem
from casacal.calibration.set_aside import gross

PLACE = ("x", "y", "z")


@pytest.fixture(scope="module")
def camera():
    source = load_problem(ROOT / "problems" / "instruments" / "camera")
    samples = source.problem.read(source.samples)
    vector = np.column_stack([samples.columns[name] for name in ("turn_x", "turn_y", "turn_z")])
    poses = np.tile(np.eye(4), (len(samples), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(vector).as_matrix()
    poses[:, :3, 3] = np.column_stack([samples.columns[name] for name in PLACE])
    return source.problem.robot, samples, poses


def written(camera, poses, orientation="quaternion", digits=12, std=3e-4):
    """A problem and samples of 4x4 poses (N), written by SciPy alone."""
    robot, samples, _ = camera
    problem = Problem(robot, TrackedPose(position_std=0.1, angle_std=std, orientation=orientation))
    turns = Rotation.from_matrix(poses[:, :3, :3])
    if orientation == "quaternion":
        numbers = np.roll(turns.as_quat(), 1, axis=1)
    else:
        numbers = turns.as_rotvec() if orientation == "rotation vector" else turns.as_euler(orientation)
    names = [name for name in problem.instrument.columns if name not in PLACE]
    columns = dict(zip(PLACE, poses[:, :3, 3].T, strict=True)) | dict(zip(names, numbers.round(digits).T, strict=True))
    return problem, replace(samples, columns=columns)


def told(problem, samples):
    return {each.about: each for each in check(problem, samples)}


@pytest.mark.long
@pytest.mark.parametrize("orientation", ["quaternion", "rotation vector", "ZYX", "xyz"])
def test_whole_poses_that_are_inverted(camera, orientation):
    problem, samples = written(camera, np.linalg.inv(camera[2]), orientation)
    assert list(told(problem, samples)) == ["poses inverted"]
    again = problem.instrument.inverted(samples.columns)
    right = written(camera, camera[2], orientation)[1]
    np.testing.assert_allclose(np.column_stack([again[name] for name in PLACE]), camera[2][:, :3, 3], atol=1e-6)
    turn, meant = (Rotation.from_quat(np.roll(problem.instrument.quaternions(each), -1, axis=1))
                   for each in (again, right.columns))  # fmt: skip
    assert (turn.inv() * meant).magnitude().max() < 1e-8
    assert told(problem, right) == {}


@pytest.mark.long
def test_inverted_poses_in_metres_are_two_mistakes(camera):
    poses = np.linalg.inv(camera[2])
    poses[:, :3, 3] /= 1000
    assert set(next(iter(told(*written(camera, poses)))).split(" and ")) == {"poses inverted", "unit of the readings"}


@pytest.mark.parametrize(("axis", "by"), [("x", 180.0), ("y", 40.0)])
def test_markers_that_are_seen_another_way_round(camera, axis, by):
    poses, rows = camera[2].copy(), [3, 8, 21]
    poses[rows, :3, :3] = poses[rows, :3, :3] @ Rotation.from_euler(axis, by, degrees=True).as_matrix()
    problem, samples = written(camera, poses)
    (found,) = told(problem, samples).values()
    assert (found.severity, found.about) == ("error", "orientation flipped")
    assert found.lines == tuple(samples.lines[row] for row in rows)
    assert f"off, by {by:.0f} degrees" in found.cause
    aside, said = gross(bind(problem, samples))
    assert np.flatnonzero(aside).tolist() == rows
    assert [each.about for each in said] == ["orientation flipped"]
    found = calibrate(problem, samples, reference=False)
    assert found.aside_lines == tuple(samples.lines[row] for row in rows)
    assert any("marker seen another way round" in each for each in found.verdict.reasons)


def test_rows_whose_position_is_off_are_not_said_to_be_turned_alone(camera):
    poses = camera[2].copy()
    poses[5, :3, 3] += 20.0
    poses[5, :3, :3] = poses[5, :3, :3] @ Rotation.from_euler("x", 90, degrees=True).as_matrix()
    assert list(told(*written(camera, poses))) == ["outliers"]


def test_rounded_orientations_are_no_noise(camera):
    (found,) = told(*written(camera, camera[2], digits=3)).values()
    assert (found.severity, found.about) == ("warning", "readings rounded")
    blur = 2 * 1e-3 / np.sqrt(12) / 3e-4  # a quaternion's number moves the turn by twice as much
    assert float(found.cause.split("by ")[1].split(" times")[0]) == pytest.approx(blur, rel=0.05)
    assert told(*written(camera, camera[2], digits=5)) == {}
    poses = camera[2].copy()
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.radians(
        Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True).round(1))).as_matrix()  # fmt: skip
    assert "steps of 0.1 degrees" in told(*written(camera, poses, "ZYX"))["readings rounded"].cause

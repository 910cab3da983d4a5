"""Poses as controllers log them, sixteen numbers of a matrix, and quaternions under the wrong headings."""

import json
import math

import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain
from scipy.spatial.transform import Rotation

from casacal import Robot, diagnose
from casacal.cli.main import main
from casacal.doctor import read_pendant_rows
from casacal.doctor.words import diagnosis_text
from casacal.errors import SamplesError

ALPHA, A = np.radians([90, 0, 0, 90, -90, 0]), (0, -425, -392.25, 0, 0, 0)
D = (89.159, 0, 0, 109.15, 94.65, 82.3)
UR5 = Robot.from_dh("UR5", alpha=tuple(ALPHA), a=A, d=D, theta=(0,) * 6)
JOINTS = np.random.default_rng(3).uniform(-140, 140, (6, 6)).round(2)
POSES = np.array([dh_chain(ALPHA, A, D, np.radians(q)) for q in JOINTS])


def read(tmp_path, names, numbers):
    file = tmp_path / "rows.csv"
    header = [f"q{k}_deg" for k in range(1, 7)] + list(names)
    rows = [",".join(f"{value:.7g}" for value in row) for row in np.hstack([JOINTS, numbers])]
    file.write_text("\n".join([",".join(header), *rows]) + "\n")
    return read_pendant_rows(file, UR5.revolute.tolist())


@pytest.mark.parametrize("scale", [1.0, 1e-3])
@pytest.mark.parametrize("by_columns", [True, False])
@pytest.mark.parametrize(
    "names",
    [
        [f"O_T_EE_{k}" for k in range(16)],
        [f"O_T_EE[{k}]" for k in range(16)],
        [f"m{k}" for k in range(1, 17)],
        [f"r{i}{j}" for i in range(1, 5) for j in range(1, 5)],
    ],
)
def test_sixteen_columns_are_a_pose(tmp_path, names, by_columns, scale):
    poses = POSES.copy()
    poses[:, :3, 3] *= scale
    found = read(tmp_path, names, (poses.transpose(0, 2, 1) if by_columns else poses).reshape(6, 16))
    np.testing.assert_allclose(found.positions, poses[:, :3, 3], atol=1e-3 * scale)
    turns = Rotation.from_quat(np.roll(found.orientations, -1, axis=1))
    assert (turns.inv() * Rotation.from_matrix(POSES[:, :3, :3])).magnitude().max() < 1e-6
    if names[0] == "O_T_EE_0":
        said = diagnose(UR5, found)
        assert said.certain
        assert said.meanings[0].length_unit == ("mm" if scale == 1 else "m")


@pytest.mark.parametrize("spoilt", ["stretched", "mirrored", "no last row"])
def test_sixteen_numbers_that_are_no_pose_are_refused(tmp_path, spoilt):
    poses = POSES.copy()
    if spoilt == "stretched":
        poses[2, :3, 0] *= 1.1
    elif spoilt == "mirrored":
        poses[2, :3, 0] *= -1
    else:
        poses[2, 3] = (0, 0, 0.5, 1)
    with pytest.raises(SamplesError, match=r"line 4: T_0 to T_15 are no pose"):
        read(tmp_path, [f"T_{k}" for k in range(16)], poses.reshape(6, 16))


def test_fifteen_columns_are_none(tmp_path):
    with pytest.raises(SamplesError, match="there is no column for x"):
        read(tmp_path, [f"T_{k}" for k in range(15)], POSES.reshape(6, 16)[:, :15])


@pytest.mark.parametrize(
    ("heading", "roll", "order"),
    [(("qw", "qx", "qy", "qz"), 0, "x, y, z, w"), (("qx", "qy", "qz", "qw"), 1, "w, x, y, z")],
)
def test_quaternions_under_the_other_heading_are_named(tmp_path, heading, roll, order, capsys):
    numbers = np.roll(Rotation.from_matrix(POSES[:, :3, :3]).as_quat(), roll, axis=1)
    found = diagnose(UR5, read(tmp_path, ("x", "y", "z", *heading), np.hstack([POSES[:, :3, 3], numbers])))
    assert found.order == order
    assert not found.certain
    assert f"in the order {order}" in diagnosis_text(found)
    assert main(["doctor", str(ROOT / "problems" / "ur5"), str(tmp_path / "rows.csv"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["order"] == order
    right = np.roll(numbers, 1 if roll == 0 else -1, axis=1)
    again = diagnose(UR5, read(tmp_path, ("x", "y", "z", *heading), np.hstack([POSES[:, :3, 3], right])))
    assert again.certain
    assert again.order == ""


def test_numbers_in_no_order_have_none(tmp_path):
    numbers = Rotation.from_matrix(POSES[:, :3, :3]).as_quat()[:, [1, 0, 2, 3]]
    found = diagnose(
        UR5, read(tmp_path, ("x", "y", "z", "qw", "qx", "qy", "qz"), np.hstack([POSES[:, :3, 3], numbers]))
    )
    assert (found.order, found.meanings) == ("", ())
    assert math.isclose(np.linalg.norm(found.rows.orientations[0]), 1, abs_tol=1e-6)

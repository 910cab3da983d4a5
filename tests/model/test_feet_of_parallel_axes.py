"""A controller table whose nearly parallel axes throw d hundreds of metres away is read as the arm that it is."""

import math
import re

import numpy as np
import pytest
from oracles import dh_chain, rot_x, rot_z, shift

from casacal import Robot
from casacal.cli.main import main
from casacal.errors import ProblemError
from casacal.model.dh_file import read_dh_file
from casacal.model.dh_table import DHTable
from casacal.model.joints import Joint

HEAD = "joint,alpha_rad,a_m,d_m,theta_rad"
UR5 = [
    (1.5703386, 0.00027933, 0.08887945, -0.0000096),
    (-0.00073389, -0.05668548, 574.24138, -1.4370704),
    (0.00325607, -0.32646702, -507.36340, 2.0254312),
    (1.57040006, 0.00001494, -66.767684, -0.58825469),
    (-1.570971, 0.0000002237, 0.09497347, 0.00004136),
    (0, 0, 0.0825625, 0.0000081737),
]
DRAWN = [0.0, -425.0, -392.25, 0.0, 0.0, 0.0], [89.159, 0.0, 0.0, 109.15, 94.65, 82.3]


def rot_y(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])


def pose(table, q):
    """Flange pose with Hayati's links, by multiplying elementary motions."""
    whole, beta = np.eye(4), dict(zip(table.parallel, table.beta, strict=True))
    for row, (alpha, a, d, theta) in enumerate(zip(table.alpha, table.a, table.d, table.theta, strict=True), 1):
        whole = whole @ shift(0, 0, d) @ rot_z(theta + q[row - 1]) @ shift(a, 0, 0) @ rot_x(alpha)
        whole = whole @ rot_y(beta.get(row, 0.0))
    return whole


def written(tmp_path, rows, convention="standard"):
    file = tmp_path / "arm.csv"
    lines = [",".join(map(str, (k, *row))) for k, row in enumerate(rows, 1)]
    file.write_text("\n".join([f"# convention: {convention}", HEAD, *lines]) + "\n")
    return file


def test_the_arm_is_the_same_and_near_its_drawing(tmp_path):
    table = read_dh_file(written(tmp_path, UR5))
    assert table.parallel == (2, 3)
    np.testing.assert_allclose(table.a, DRAWN[0], atol=0.5)
    np.testing.assert_allclose(table.d, DRAWN[1], atol=2.0)
    assert np.abs([*table.theta, *table.beta]).max() < 0.01
    assert table.note.startswith("Joints 2 to 4 are nearly parallel, which puts a d of 574 m into the file")
    alpha, a, d, theta = np.array(UR5).T
    for q in np.random.default_rng(0).uniform(-3, 3, (20, 6)):
        right = dh_chain(alpha, 1000 * a, 1000 * d, theta + q)
        np.testing.assert_allclose(pose(table, q), right, atol=1e-6)


@pytest.mark.parametrize("twist", [1e-4, -2e-3, math.pi - 1e-3])
def test_any_two_axes_also_against_one_another(twist):
    """An arm of three axes, the second and third nearly parallel or opposed, their feet metres away."""
    alpha, a, d = (math.pi / 2, twist, 0.3), (10.0, -40.0, 5.0), (300.0, 4e4, 70.0)
    table = DHTable(name="r", alpha=alpha, a=a, d=d, theta=(0.2, 2.5, -0.4), joints=(Joint(),) * 3)
    near = table.with_feet_near()
    assert near.parallel == (2,)
    assert near.d[1] == 0
    assert abs(near.theta[1]) <= math.pi / 2
    for q in np.random.default_rng(1).uniform(-3, 3, (5, 3)):
        np.testing.assert_allclose(pose(near, q), dh_chain(alpha, a, d, np.array(table.theta) + q), atol=1e-7)


def test_other_tables_are_left_as_they_are(tmp_path):
    drawn = [(math.pi / 2, 0, 0.089, 0), (0, -0.425, 0, 0), (0, -0.392, 0, 0), (math.pi / 2, 0, 0.109, 0)]
    table = read_dh_file(written(tmp_path, drawn))
    assert (table.parallel, table.note) == ((), "")
    long = [(math.pi / 2, 0, 0.5, 0), (0, 1.0, 4.0, 0), (0.2, 0, 0, 0)]  # exactly parallel, and a long column
    assert read_dh_file(written(tmp_path, long)).d[1] == 4000
    wrong = [(math.pi / 2, 0, 89.0, 0), (math.pi / 2, -425, 0, 0), (0, -392, 0, 0)]
    with pytest.raises(ProblemError, match="the largest length is 425000 mm"):
        read_dh_file(written(tmp_path, wrong))
    with pytest.raises(ProblemError, match="the largest length is 574241 mm"):
        read_dh_file(written(tmp_path, UR5, "modified"))


def test_new_says_so_and_writes_the_table_that_is_meant(tmp_path, capsys):
    file = written(tmp_path, UR5)
    assert main(["new", "ur5", "--dh", str(file), "--tool", "0,0,120", "--out", str(tmp_path)]) == 0
    assert "Joints 2 to 4 are nearly parallel" in " ".join(capsys.readouterr().out.split())
    text = (tmp_path / "ur5" / "problem.py").read_text()
    assert "parallel=(2, 3)," in text
    assert re.search(r"beta=deg\(-?0\.\d+, -?0\.\d+\)", text)
    robot = Robot.from_dh_file(file)
    assert robot.parameters["beta"].size == 2

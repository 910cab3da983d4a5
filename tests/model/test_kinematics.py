"""Forward kinematics against hand-multiplied transforms, published poses and hand geometry."""

import math
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from oracles import dh_chain, modified_dh_chain, rot_x, rot_z
from scipy.spatial.transform import Rotation

from casacal import Robot, chain, deg, dh, modified_dh
from casacal.model import ProblemFile
from casacal.model import kinematics as k

COUNT = 20


def random_rows(rng):
    return rng.uniform(-3, 3, 6), rng.uniform(-900, 900, 6), rng.uniform(-900, 900, 6), rng.uniform(-3, 3, 6)


@pytest.mark.parametrize(("link", "oracle"), [(dh, dh_chain), (modified_dh, modified_dh_chain)])
def test_links_equal_their_elementary_motions(link, oracle):
    rng = np.random.default_rng(1)
    for _ in range(COUNT):
        rows = random_rows(rng)
        pose = chain(*(link(*row) for row in zip(*rows, strict=True)))
        np.testing.assert_allclose(np.array(pose), oracle(*rows), atol=1e-9)


def test_the_same_pose_runs_on_floats_and_on_symbols(hsr: ProblemFile):
    rng = np.random.default_rng(2)
    alpha, a, d, theta = random_rows(rng)
    q = rng.uniform(-3, 3, 6)

    class P:
        pass

    P.alpha, P.a, P.d, P.theta = alpha, a, d, theta
    numeric = np.array(hsr.problem.robot.pose(P, q))
    symbol = ca.SX.sym("q", 6)
    compiled = ca.Function("pose", [symbol], [hsr.problem.robot.pose(P, symbol)])
    np.testing.assert_allclose(numeric, dh_chain(alpha, a, d, theta + q), atol=1e-9)
    np.testing.assert_allclose(np.array(compiled(q)), numeric, atol=1e-10)


def test_puma_560_at_zero_as_published():
    # Corke, Robotics, Vision and Control, standard DH of the Puma 560 in metres, p560.fkine(qz)
    robot = Robot.from_dh(
        "Puma 560",
        alpha=deg(90, 0, -90, 90, -90, 0),
        a=(0, 0.4318, 0.0203, 0, 0, 0),
        d=(0, 0, 0.15005, 0.4318, 0, 0),
        theta=(0,) * 6,
        length_std=1.0,
        angle_std=1.0,
    )

    class P:
        alpha, a, d, theta = (robot.parameters[key].values for key in ("alpha", "a", "d", "theta"))

    pose = np.array(robot.pose(P, (0,) * 6))
    np.testing.assert_allclose(pose[:3, 3], [0.4521, -0.1500, 0.4318], atol=5e-5)
    np.testing.assert_allclose(pose[:3, :3], np.eye(3), atol=1e-12)


def test_hsr_stretched_out_as_drawn(hsr: ProblemFile):
    # at q = 0 the upper arm stands upright and the forearm points ahead: lengths add up by hand, with a3 in mm (E1)
    parameters = hsr.problem.robot.parameters

    class P:
        alpha, a, d, theta = (parameters[key].values for key in ("alpha", "a", "d", "theta"))

    pose = np.array(hsr.problem.robot.pose(P, (0,) * 6))
    reach = 249.85003 + 1030.37534
    height = 653.5 + 900.32123 + 206.14449
    np.testing.assert_allclose(pose[:3, 3], [reach, 0, height - 200.6], atol=1e-6)


def test_a_prismatic_joint_moves_along_its_own_axis():
    scara = Robot.from_dh(
        "slide", alpha=(0.3, 0), a=(100, 0), d=(0, 50), theta=(0, 0.2), length_std=1, angle_std=1, joints="RP"
    )

    class P:
        alpha, a, d, theta = (scara.parameters[key].values for key in ("alpha", "a", "d", "theta"))

    pose = np.array(scara.pose(P, (0.7, 30.0)))
    np.testing.assert_allclose(pose, dh_chain((0.3, 0), (100, 0), (0, 80), (0.7, 0.2)), atol=1e-10)


def test_elementary_transforms():
    np.testing.assert_allclose(np.array(k.rotate_x(0.3)), rot_x(0.3))
    np.testing.assert_allclose(np.array(k.rotate_z(-1.1)), rot_z(-1.1))
    quarter = np.array(k.rotate_y(math.pi / 2)) @ [0, 0, 1, 1]
    np.testing.assert_allclose(quarter, [1, 0, 0, 1], atol=1e-12)
    total = np.array(chain(k.translate_x(1), k.translate_y(2), k.translate_z(3)))[:3, 3]
    np.testing.assert_allclose(total, [1, 2, 3])
    assert deg(180) == pytest.approx(math.pi)
    assert deg(0, 90) == (0.0, pytest.approx(math.pi / 2))


def test_the_same_residual_runs_on_floats(hsr: ProblemFile, corner_bound, corner_simulation):
    robot, dial = hsr.problem.robot, hsr.problem.instruments[0]
    samples, truth = corner_simulation.samples, corner_simulation.truth(corner_bound)
    values = {slot.name: slot.value(truth) for slot in corner_bound.slots}
    expected = corner_bound.plain_residual(truth)
    for i in (0, 1, 2, 50):
        plane = values[f"plane.{samples.labels['plane'][i]}"]
        p = SimpleNamespace(**{key: value for key, value in values.items() if "." not in key}, plane=plane)
        row = SimpleNamespace(reading=float(samples.columns["reading"][i]))
        residual = dial.residual(robot.pose(p, [float(q) for q in samples.joints[i]]), p, row)
        assert float(residual) == pytest.approx(expected[i], abs=1e-9)


def test_quaternions_and_turns_are_those_of_scipy_also_where_a_number_vanishes():
    rng = np.random.default_rng(0)
    halves = np.vstack([np.eye(4), -np.eye(4), [[0, -1, 1, 0], [0, 0, -1, 1], [0, 1, 0, -1], [1e-9, 1, 1, 1]]])
    given = np.vstack([rng.normal(size=(200, 4)), halves])
    turns = Rotation.from_quat(np.roll(given, -1, axis=1))
    np.testing.assert_allclose(k.turns_of(given), turns.as_matrix(), atol=1e-14)
    found = k.quaternions_of(turns.as_matrix())
    np.testing.assert_allclose(found, np.roll(turns.as_quat(canonical=True), 1, axis=1), atol=1e-12)
    assert (found[np.arange(len(found)), np.argmax(np.abs(found) > 1e-8, axis=1)] > 0).all()
    assert k.quaternions_of(np.zeros((0, 3, 3))).shape == (0, 4)

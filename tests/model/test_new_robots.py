"""A robot that casacal has never seen is defined in a few lines and calibrates; samples come from NumPy alone."""

import math

import numpy as np
import pandas as pd
from oracles import dh_chain

from casacal import DialOnPlane, Joint, Parameter, Plane, Problem, Robot, TrackedPoint, bind, chain, ipopt, lm, sckf_lm
from casacal.data.samples import Samples
from casacal.model.kinematics import rotate_z, translate_x


def test_a_planar_two_link_arm_on_lines():
    def pose(p, q):
        return chain(rotate_z(q[0] + p.zero[0]), translate_x(p.l1), rotate_z(q[1] + p.zero[1]), translate_x(p.l2))

    robot = Robot(
        "two-link",
        joints=2,
        pose=pose,
        parameters={
            "l1": Parameter(400.0, prior_std=1.0),
            "l2": Parameter(300.0, prior_std=1.0),
            "zero": Parameter((0.0, 0.0), unit="rad", prior_std=2e-3),
        },
    )
    # a line in the arm's plane is a plane whose tilt out of it stays unseen: prior on tilt, known to 1 mrad
    plane = Plane(per="plane", normal=(1, 0, 0), point=(500, 0, 0), prior_std=(1e-3, 5.0))
    problem = Problem(robot, DialOnPlane(reading=False, noise_std=0.01, plane=plane))

    rng = np.random.default_rng(0)
    l1, l2, zero = 400.6, 299.2, (0.0, 1.1e-3)
    height = rng.uniform(-350, 350, 60)
    inner = np.array([math.acos((500.2**2 + y**2 - l1**2 - l2**2) / (2 * l1 * l2)) for y in height])
    outer = np.arctan2(height, 500.2) - np.arctan2(l2 * np.sin(inner), l1 + l2 * np.cos(inner))
    frame = pd.DataFrame({"q1_rad": outer - zero[0], "q2_rad": inner - zero[1], "plane": "line"})
    result = lm(bind(problem, Samples.from_frame(frame, problem.layout())))
    estimate = dict(zip(result.problem.names, result.x, strict=True))
    std = dict(zip(result.problem.names, result.std, strict=True))
    assert result.converged
    for name, true in {"l1": 0.6, "l2": -0.8, "zero2": 1.1e-3}.items():
        assert abs(estimate[name] - true) < 4 * std[name]
    assert std["zero2"] < 0.2 * 2e-3


def scara():
    """A SCARA with a slide that touched two plates: problem, samples, and the truth as deviations from nominal."""
    alpha, a, d, theta = (0, math.pi, 0, 0), (350, 250, 0, 0), (200, 0, 0, 50), (0, 0, 0, 0)
    joints = [Joint(), Joint(), Joint("prismatic", 0, 250), Joint()]
    robot = Robot.from_dh("SCARA", alpha=alpha, a=a, d=d, theta=theta, length_std=0.5, angle_std=1e-3, joints=joints)
    problem = Problem(robot, DialOnPlane(noise_std=0.01, sign=-1))

    rng = np.random.default_rng(1)
    true = [np.array(row, dtype=float) for row in (alpha, a, d, theta)]
    for row, std in zip(true, (1e-3, 0.5, 0.5, 1e-3), strict=True):
        row += std * rng.normal(size=4)
    normals = {"low": np.array([0.02, -0.03, 1.0]), "high": np.array([-0.15, 0.1, 1.0])}
    rows = []
    for k in range(160):
        label = ("low", "high")[k % 2]
        normal = normals[label] / np.linalg.norm(normals[label])
        q = np.array([*rng.uniform(-2, 2, 2), rng.uniform(0, 200), rng.uniform(-3, 3)])
        reading = rng.uniform(0.5, 9.5)
        for _ in range(4):  # move the slide until the tip, shortened by the reading, lies on the plate
            pose = dh_chain(true[0], true[1], true[2] + [0, 0, q[2], 0], true[3] + [q[0], q[1], 0, q[3]])
            gap = normal @ (pose[:3, 3] - [300, 0, -60]) - reading * (normal @ pose[:3, 2])
            q[2] -= gap / (normal @ pose[:3, 2])
        if not 0 <= q[2] <= 250:
            continue
        rows.append([*np.degrees(q[:2]), q[2], math.degrees(q[3]), reading + 0.01 * rng.normal(), label])
    frame = pd.DataFrame(rows, columns=["q1_deg", "q2_deg", "q3_mm", "q4_deg", "reading_mm", "plane"])
    assert len(frame) > 60
    truth = np.concatenate(true) - np.concatenate([alpha, a, d, theta])
    return problem, Samples.from_frame(frame, problem.layout()), truth


def test_a_scara_with_a_prismatic_joint_on_two_plates():
    problem, samples, truth = scara()
    bound = bind(problem, samples)
    result, reference = sckf_lm(bound), ipopt(bound)
    assert result.converged
    np.testing.assert_allclose(result.cost, reference.cost, rtol=1e-8)
    error = (result.x[:16] - truth) / result.std[:16]
    assert np.abs(error).max() < 4
    assert np.sqrt(np.mean(bound.plain_residual(result.x) ** 2)) < 0.012


def test_a_tracked_reflector_calibrates_the_whole_arm(hsr):
    rng = np.random.default_rng(2)
    nominal = {key: np.array(hsr.problem.robot.parameters[key].values) for key in ("alpha", "a", "d", "theta")}
    std = {"alpha": 1e-3, "a": 0.7, "d": 0.7, "theta": 1e-3}
    true = {key: values + std[key] * rng.normal(size=6) for key, values in nominal.items()}
    angle, shift, reflector = 0.7, np.array([3000.0, -500.0, 200.0]), np.array([40.0, -25.0, 60.0, 1.0])
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    mounted = reflector + np.array([0.5, -0.3, 0.2, 0.0])
    rows = []
    for _ in range(80):
        q = rng.uniform(-1.2, 1.2, 6)
        point = dh_chain(true["alpha"], true["a"], true["d"], true["theta"] + q) @ mounted
        rows.append([*np.degrees(q), *(turn @ point[:3] + shift + 0.03 * rng.normal(size=3))])
    frame = pd.DataFrame(rows, columns=[*(f"q{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"])
    tool = Parameter(tuple(reflector[:3]), unit="mm", prior_std=2.0, labels=("_x", "_y", "_z"))
    problem = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.03, tool=tool))
    bound = bind(problem, Samples.from_frame(frame, problem.layout()))
    assert bound.rows == 240
    result, reference = lm(bound), ipopt(bound)
    assert result.converged
    assert reference.converged
    np.testing.assert_allclose(result.cost, reference.cost, rtol=1e-8)
    error = np.concatenate([true[key] - nominal[key] for key in nominal]) - result.x[:24]
    assert np.abs(error / result.std[:24]).max() < 4.5
    np.testing.assert_allclose(sckf_lm(bound).cost, result.cost, rtol=1e-8)
    sizes = dict(zip(bound.names, result.std, strict=True))
    assert sizes["a2"] < 0.05

"""The arms of problems/ stand where their makers' numbers put them: hand-multiplied poses, published ones, geometry."""

import math
import re
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from oracles import dh_chain, rot_x, rot_z, shift

from casacal import Samples, bind, calibrate, check, lm, load_problem, simulate
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main

POSES = 20
TURN = math.pi / 2


def pose_at(name, q):
    """Flange pose (4, 4) of the arm of a problem, as drawn."""
    robot = load_problem(ROOT / "problems" / name).problem.robot
    nominal = SimpleNamespace(**{key: unknown.values for key, unknown in robot.parameters.items()})
    return np.array(robot.pose(nominal, [float(value) for value in q]))


def random_joints(name):
    joints = load_problem(ROOT / "problems" / name).problem.robot.axes
    return np.random.default_rng(0).uniform([j.lower for j in joints], [j.upper for j in joints], (POSES, len(joints)))


def test_ur5_at_zero_as_its_controller_shows_it():
    pose = pose_at("ur5", [0] * 6)
    np.testing.assert_allclose(pose[:3, 3], [-817.25, -191.45, -5.491], atol=1e-9)
    np.testing.assert_allclose(pose[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


def test_ur5_equals_the_published_table():
    for q in random_joints("ur5"):
        expected = dh_chain(
            (TURN, 0, 0, TURN, -TURN, 0), (0, -425, -392.25, 0, 0, 0), (89.159, 0, 0, 109.15, 94.65, 82.3), q
        )
        np.testing.assert_allclose(pose_at("ur5", q), expected, atol=1e-9)


def test_iiwa_equals_turns_about_the_axes_of_its_drawing():
    # upright: joints turn about z, y, z, -y, z, y, z, 360 + 420 + 400 + 126 mm from the floor to the flange
    def rot_y(angle):
        return rot_x(-TURN) @ rot_z(angle) @ rot_x(TURN)

    np.testing.assert_allclose(pose_at("kuka_iiwa14", [0] * 7), shift(0, 0, 1306), atol=1e-9)
    for q in random_joints("kuka_iiwa14"):
        shoulder = rot_z(q[0]) @ shift(0, 0, 360) @ rot_y(q[1])
        elbow = rot_z(q[2]) @ shift(0, 0, 420) @ rot_y(-q[3])
        wrist = rot_z(q[4]) @ shift(0, 0, 400) @ rot_y(q[5]) @ rot_z(q[6])
        np.testing.assert_allclose(pose_at("kuka_iiwa14", q), shoulder @ elbow @ wrist @ shift(0, 0, 126), atol=1e-9)


def test_scara_moves_in_the_plane_and_down():
    for q in random_joints("adept_cobra600"):
        x = 325 * math.cos(q[0]) + 275 * math.cos(q[0] + q[1])
        y = 325 * math.sin(q[0]) + 275 * math.sin(q[0] + q[1])
        pose = pose_at("adept_cobra600", q)
        np.testing.assert_allclose(pose[:3, 3], [x, y, 387 - q[2]], atol=1e-9)
        turn = q[0] + q[1] - q[3]  # joint 4 turns about an axis that points down
        np.testing.assert_allclose(pose[:3, 0], [math.cos(turn), math.sin(turn), 0], atol=1e-12)
        np.testing.assert_allclose(pose[:3, 2], [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize("name", ["ur5", "kuka_iiwa14", "adept_cobra600"])
def test_samples_stay_inside_the_joint_limits(name):
    source = load_problem(ROOT / "problems" / name)
    joints = source.problem.read(source.samples).joints
    assert (joints >= [joint.lower for joint in source.problem.robot.axes]).all()
    assert (joints <= [joint.upper for joint in source.problem.robot.axes]).all()


def test_other_priors_share_what_was_compiled_and_nothing_else(hsr):
    """A trace knows no priors; what binds, simulates or compares does."""
    plain = load_problem(hsr.path).problem
    samples = plain.read(hsr.samples)
    _ = bind(plain, samples).residual
    wide = plain.with_prior({"a": 7.0, "theta2": math.inf})
    fresh = load_problem(hsr.path).problem.with_prior(
        {"a": 7.0, "theta2": math.inf}
    )  # nothing was compiled of this one
    assert wide.models[0].residual is plain.models[0].residual
    assert wide.models[0].rows() is plain.models[0].rows()
    assert fresh.models[0].residual is not plain.models[0].residual
    assert wide == fresh != plain
    assert wide.digest == fresh.digest != plain.digest
    one, two = bind(wide, samples), bind(fresh, samples)
    np.testing.assert_array_equal(one.prior_std, two.prior_std)
    assert one.prior_std[one.names.index("a3")] == 7.0
    assert np.isinf(one.prior_std[one.names.index("theta2")])
    assert bind(plain, samples).prior_std[one.names.index("a3")] == 0.7
    assert {u.prior_stds[0] for u in [wide.symbols.unknowns["a"], wide.robot.parameters["a"]]} == {7.0}
    np.testing.assert_array_equal(lm(one).x, lm(two).x)
    cell = hsr.cell
    np.testing.assert_array_equal(simulate(wide, cell, seed=1).local["a"], simulate(fresh, cell, seed=1).local["a"])


EXAMPLES = sorted(path.parent for path in (ROOT / "problems" / "instruments").glob("*/problem.py"))


@pytest.mark.long_unless("tracker")
@pytest.mark.parametrize("folder", EXAMPLES, ids=lambda folder: folder.name)
def test_every_instrument_has_an_example_that_is_as_its_page_says(folder, tmp_path):
    page = (folder.parent / "README.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith(f"| `{folder.name}` |"))
    count, promised = (float(cell) for cell in row.split("|")[3:5])
    source = load_problem(folder)
    samples = source.problem.read(source.samples)
    assert len(samples) == count
    found = calibrate(source, reference=False)
    assert verdict_of(found).level == "calibrated"
    assert found.tip_std[1] == pytest.approx(promised, rel=0.03)
    again = tmp_path / "samples.csv"
    assert main(["simulate", str(folder), "--samples", f"{count:.0f}", "--seed", "0", "--out", str(again)]) == 0
    made = source.problem.read(again)
    np.testing.assert_allclose(made.joints, samples.joints, atol=1e-6)
    for name, values in samples.columns.items():
        np.testing.assert_allclose(made.columns[name], values, atol=2e-3)


def test_no_instrument_lacks_an_example():
    text = "".join((folder / "problem.py").read_text() for folder in [*EXAMPLES, ROOT / "problems" / "ur5"])
    for name in ("DialOnPlane", "Distance", "FixedPoint", "KnownPoint", "SelfContact", "Sockets", "SphereTouch"):
        assert name in text
    assert {"TrackedPoint", "TrackedPose"} <= set(re.findall(r"Tracked\w+", text))


def test_a_tracker_whose_sessions_nobody_wrote_down_is_warned_of():
    """A station for each session, and no column that says which: one station for all would be a silent guess."""
    source = load_problem(ROOT / "problems" / "instruments" / "tracker")
    samples = source.problem.read(source.samples)
    samples = samples.take(samples.labels["session"].rows()["1"])  # nothing moved: no misfit tells
    joints = {f"q{j + 1}_rad": q for j, q in enumerate(samples.joints.T)}
    columns = {f"{name}_mm": values for name, values in samples.columns.items()}
    layout = source.problem.layout()
    for session, named in (({"session": ["1"] * len(samples)}, False), ({}, True)):
        found = check(source.problem, Samples.from_frame(pd.DataFrame({**joints, **columns, **session}), layout))
        assert ("labels absent" in [finding.about for finding in found]) is named
    said = next(finding for finding in found if finding.about == "labels absent")
    assert "there is no column 'session', which 'station' is declared to depend on" in said.cause

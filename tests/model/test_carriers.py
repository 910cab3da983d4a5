"""Rails and turntables: an arm on them, or its work, against poses multiplied out in NumPy."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from instruments_on_ur5 import ROBOT, ROOT, TOOL, flanges
from scipy.spatial.transform import Rotation

from casacal import Problem, TrackedPoint, calibrate, load_problem, simulate, tool_point
from casacal.cli.main import main
from casacal.effects import LinkSag
from casacal.errors import ProblemError
from casacal.model import carried, facing, rail, turntable
from casacal.simulation import Disturbances

TRACKER = TrackedPoint(noise_std=0.02, tool=tool_point(*TOOL, prior_std=1.0))
ALONG = np.array([3.0, 4.0, 0.0]) / 5


def poses_of(robot, joints):
    drawn = SimpleNamespace(**robot.traced.drawn)
    return np.array([np.array(robot.pose(drawn, [float(value) for value in q])) for q in joints])


def apart(points, wanted):
    """Root mean square distance of points where the base has been moved to where they fit best."""
    one, two = points - points.mean(axis=0), wanted - wanted.mean(axis=0)
    turn, _ = Rotation.align_vectors(two, one)
    return float(np.sqrt(((turn.apply(one) - two) ** 2).sum(axis=1).mean()))


def test_an_arm_on_a_rail_is_shifted_along_it():
    joints = np.random.default_rng(0).uniform(-2, 2, (6, 7)) * [500, 1, 1, 1, 1, 1, 1]
    wanted = flanges(joints[:, 1:])
    wanted[:, :3, 3] += joints[:, :1] * ALONG
    robot = carried(ROBOT, by=rail(-1000, 1000, direction=(3, 4, 0)))
    assert robot.axes[0].kind == "prismatic"
    np.testing.assert_allclose(poses_of(robot, joints), wanted, atol=1e-9)


def test_a_turntable_turns_the_arm_or_the_work():
    joints = np.random.default_rng(1).uniform(-2, 2, (6, 7))
    point, turns = np.array([300.0, -100, 50]), Rotation.from_rotvec(joints[:, :1] * [[0, 0, 1.0]]).as_matrix()
    table = np.tile(np.eye(4), (6, 1, 1))
    table[:, :3, :3], table[:, :3, 3] = turns, point - turns @ point
    robot = turntable(-3, 3, point=point)
    np.testing.assert_allclose(poses_of(carried(ROBOT, by=robot), joints), table @ flanges(joints[:, 1:]), atol=1e-9)
    seen = poses_of(facing(ROBOT, robot), np.roll(joints, -1, axis=1))  # the arm's joints come first
    np.testing.assert_allclose(seen, np.linalg.inv(table) @ flanges(joints[:, 1:]), atol=1e-9)
    with pytest.raises(ProblemError, match=r"A turntable goes from .*within 4 turns of zero"):
        turntable(*np.radians((-1700.0, 1700.0)))


@pytest.mark.long
def test_a_rail_that_points_elsewhere_and_is_long_is_found():
    """A metre of 1.0003 m, 1.5 mrad aside; the arm as drawn, by hand."""
    still = Disturbances(resolution=0.0, repeatability=0.0, error_scale=0.0)
    robot = carried(ROBOT, by=rail(-1000, 1000, scale_std=0.3))
    samples = simulate(Problem(robot, TRACKER), still, samples=120, seed=2).samples
    true = flanges(samples.joints[:, 1:])[:, :3] @ [*TOOL, 1.0]
    true += samples.joints[:, :1] * 1.0003 * np.array([np.cos(1.5e-3), np.sin(1.5e-3), 0.0])
    true += np.random.default_rng(2).normal(size=true.shape) * 0.02
    samples = dataclasses.replace(samples, columns=dict(zip("xyz", true.T, strict=True)))
    found = calibrate(Problem(robot, TRACKER), samples)
    assert abs(found.reference.relative_gap) < 1e-8
    names = {row["name"]: row for row in found.to_dict()["parameters"]}
    assert names["carrier_scale"]["estimate"] == pytest.approx(0.3, abs=0.05)
    elsewhere = np.random.default_rng(3).uniform(-1, 1, (50, 7)) * [1000, 2, 2, 2, 2, 2, 2]
    wanted = flanges(elsewhere[:, 1:])[:, :3] @ [*TOOL, 1.0]
    wanted += elsewhere[:, :1] * 1.0003 * np.array([np.cos(1.5e-3), np.sin(1.5e-3), 0.0])
    assert apart(found.predict(elsewhere, frame="tip").positions, wanted) < 0.1
    assert apart(found.predict(elsewhere, frame="tip", nominal=True).positions, wanted) > 0.3


def test_any_arm_rides_and_its_links_weigh():
    arm = load_problem(ROOT / "problems" / "kuka_iiwa14").problem.robot
    problem = Problem(carried(arm, by=rail(0, 2000)), TRACKER, terms=(LinkSag(),))
    assert "give" in problem.symbols.unknowns
    scara = load_problem(ROOT / "problems" / "adept_cobra600").problem.robot
    assert carried(scara, by=rail(0, 2000)).revolute.tolist() == [False, *scara.revolute]
    two = carried(ROBOT, by=carried(turntable(-1, 1), by=rail(0, 500)))
    assert [axis.kind for axis in two.axes[:2]] == ["prismatic", "revolute"]


def test_a_carrier_may_be_carried_either_way():
    """A gantry: along y on a bridge along x, put together from the arm up or from the ground up."""
    bridge, trolley = rail(0, 2000), rail(0, 1000, direction=(0, 1, 0))
    up, down = carried(carried(ROBOT, by=trolley), by=bridge), carried(ROBOT, by=carried(trolley, by=bridge))
    joints = np.random.default_rng(4).uniform(0, 1, (4, 8)) * [2000, 1000, 2, 2, 2, 2, 2, 2]
    wanted = flanges(joints[:, 2:])
    wanted[:, :2, 3] += joints[:, :2]
    np.testing.assert_allclose(poses_of(up, joints), wanted, atol=1e-9)
    np.testing.assert_allclose(poses_of(down, joints), wanted, atol=1e-9)
    assert "carrier_carrier_direction" in up.parameters


@pytest.mark.long
def test_the_command_line_takes_an_arm_on_a_rail(tmp_path, capsys):
    (tmp_path / "problem.py").write_text(
        "from casacal import Problem, TrackedPoint, load_problem, tool_point\nfrom casacal.model import carried, rail\n"
        f"arm = load_problem({str(ROOT / 'problems' / 'ur5')!r}).problem.robot\n"
        "tracker = TrackedPoint(noise_std=0.03, tool=tool_point(0, 0, 100, prior_std=1.0))\n"
        "problem = Problem(carried(arm, by=rail(0, 1500)), tracker)\n"
    )
    assert (
        main(["simulate", str(tmp_path), "--samples", "150", "--seed", "1", "--out", str(tmp_path / "samples.csv")])
        == 0
    )
    assert "q1_mm" in (tmp_path / "samples.csv").read_text()
    assert main(["calibrate", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert "Calibrated" in capsys.readouterr().out


def test_what_is_no_carrier_is_refused():
    with pytest.raises(ProblemError, match="Got an int as an arm or what carries it"):
        carried(ROBOT, by=5)
    for wrong in ((10, 0), (0, 3), ("0", "3000"), (None, 1), (0, 1e308)):
        with pytest.raises(ProblemError, match="Give its travel in mm"):
            rail(*wrong)
    for limits in ((-180, 180), (3, -3), ("a", 3)):
        with pytest.raises(ProblemError, match="Give its limits in rad"):
            turntable(*limits)
    with pytest.raises(ProblemError):
        turntable(-1, 1, axis=(0, 0, 0))

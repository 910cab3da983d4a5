"""Closed chains: poses against closed forms, derivatives, the side of a singularity, and loops that stay open."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from closed_forms import FORMS
from conftest import ROOT

from casacal import (
    Joint,
    Parameter,
    Problem,
    Robot,
    Samples,
    TrackedPoint,
    bind,
    calibrate,
    compensate,
    load_problem,
    simulate,
)
from casacal.calibration.mirror import mirror_image
from casacal.cli.main import main
from casacal.errors import CasacalError, ProblemError, SamplesError
from casacal.model import passive
from casacal.model.kinematics import chain, rotate_z, rotation, translate
from casacal.model.links import Links
from casacal.model.robot import random_joints


def arm(name):
    return load_problem(ROOT / "problems" / name).problem.robot


def numbers(robot, scale, seed):
    """Parameter values some prior standard deviations from nominal, and all of them in one row."""
    rng, values = np.random.default_rng(seed), {}
    for key, each in robot.parameters.items():
        values[key] = np.asarray(each.nominal) + scale * each.prior_stds * rng.uniform(-1, 1, each.size)
    return SimpleNamespace(**{key: ca.DM(each) for key, each in values.items()}), np.concatenate([*values.values()])


@pytest.mark.parametrize("name", FORMS)
def test_poses_are_those_of_a_closed_form(name):
    robot = arm(name)
    for seed, q in enumerate(random_joints(robot, 60, np.random.default_rng(4))):
        p, row = numbers(robot, 2.0, seed)
        np.testing.assert_allclose(np.array(robot.pose(p, ca.DM(q)))[:3, 3], FORMS[name](row, q), atol=1e-9)


def test_a_parallelogram_does_what_the_maker_computes():
    """`swift_fk` of UFACTORY's swiftpro_moveit_node.cpp, without the gripper's height, turned by its 90 degrees."""
    robot = arm("palletiser")
    p, _ = numbers(robot, 0.0, 0)
    for turn, upper, forearm in np.radians([(90, 60, 30), (10, 80, 60), (60, 45, 10)]):
        stretch = 142.07 * np.cos(upper) + 158.81 * np.cos(forearm) + 13.2 + 56.55
        height = 142.07 * np.sin(upper) - 158.81 * np.sin(forearm) + 106.6
        wanted = (stretch * np.sin(turn), -stretch * np.cos(turn), height)
        found = robot.pose(p, ca.DM([turn - np.pi / 2, upper, forearm, 0.3]))
        np.testing.assert_allclose(np.array(found)[:3, 3], wanted, atol=1e-9)
        np.testing.assert_allclose(np.array(rotation(found))[2], (0, 0, 1), atol=1e-12)


def test_first_and_second_derivatives_are_those_of_the_closed_form():
    """Of a loop of one: the far end of a rod on a crank slides on a line; u = r cos q + sqrt(l^2 - r^2 sin^2 q)."""
    x = ca.SX.sym("x", 3)
    q, r, length = ca.vertsplit(x)
    u = passive(lambda u, q: (u - r * ca.cos(q)) ** 2 + (r * ca.sin(q)) ** 2 - length**2, q, home=(1,), start=(3,))
    explicit = r * ca.cos(q) + ca.sqrt(length**2 - (r * ca.sin(q)) ** 2)
    orders = []
    for value in (u, explicit):
        hessian, slope = ca.hessian(value, x)
        orders.append(ca.Function("f", [x], [value, slope, hessian, ca.jacobian(ca.vec(hessian), x)]))
    for at in ([0.3, 1.0, 3.0], [1.0, 1.1, 2.9], [2.4, 0.9, 3.1]):
        for found, wanted in zip(*(each(at) for each in orders), strict=True):
            np.testing.assert_allclose(np.array(ca.DM(found)), np.array(ca.DM(wanted)), atol=1e-8)


def crossed(u, q):
    """Two rods of 90 mm on pivots 100 mm apart, the first lifted by q."""
    ends = [90 * ca.vertcat(ca.cos(u[i]), ca.sin(u[i])) for i in range(2)]
    return ends[0] + ca.vertcat(0, q[0]) - ends[1] - ca.vertcat(100, 0)


def test_a_loop_stays_as_it_was_assembled_or_is_not_a_number():
    above, below = (
        passive(crossed, [20.0], home=(0.0,), start=np.radians(start)) for start in ((56, 124), (-56, -124))
    )
    heights = [20 + 90 * float(np.sin(u.ravel()[0])) for u in map(np.array, (above, below))]
    assert heights[0] > 60
    assert heights[1] < -40
    for lift in (200.0, 1e6, -1e3):  # too far for the rods to meet
        assert np.isnan(np.array(passive(crossed, [lift], home=(0.0,), start=np.radians((56, 124))))).all()
    # the root on the other side of a singularity closes the loop, and is not taken
    assert np.isnan(float(passive(lambda u, q: u**2 - q, [-1.0], home=(1.0,), start=(1.0,))))
    for q in (2.5, 20.0, 40.0):  # Newton's steps find that of 40, at 3.71
        assert np.isnan(float(passive(lambda u, q: u**3 - 3 * u - q, [q], home=(0.0,), start=(0.1,))))


def test_numbers_go_in_as_they_come():
    whole = passive(crossed, [20.0], home=(0.0,), start=(1.0, 2.1))
    for q in (np.array([20.0]), (20,), ca.DM(20), ca.DM([20])):
        np.testing.assert_array_equal(passive(crossed, q, home=(0.0,), start=(1.0, 2.1)), whole)
    x = ca.MX.sym("x")
    by_mx = ca.Function("f", [x], [passive(crossed, x, home=(0.0,), start=(1.0, 2.1))])
    np.testing.assert_allclose(np.array(by_mx(20)), np.array(whole), atol=1e-12)
    with pytest.raises(ProblemError, match="2 closure errors and 1 passive joints at its start"):
        passive(lambda u, q: ca.vertcat(u, q), [1.0], home=(0.0,), start=(1.0,))
    with pytest.raises(ProblemError, match="2 joint values and 1 at its home"):
        passive(crossed, [1.0, 2.0], home=(0.0,), start=(1.0, 2.0))


def test_postures_in_which_the_loop_stays_open_are_neither_drawn_nor_taken(tmp_path, capsys):
    source = load_problem(ROOT / "problems" / "five_bar")
    robot, rows = source.problem.robot, source.problem.read(source.samples)
    lower, upper = robot.limits
    assert not robot.traced.closed(np.array([[upper[0], lower[1]]])).any()
    drawn = random_joints(robot, 500, np.random.default_rng(0))
    assert all(np.isfinite(FORMS["five_bar"](numbers(robot, 3.0, k)[1], q)).all() for k, q in enumerate(drawn))
    assert ((drawn >= lower) & (drawn <= upper)).all()
    lines = source.samples.read_text().splitlines()
    for row in (5, 9):
        lines[row] = ",".join(["130", "50", *lines[row].split(",")[2:]])
    (tmp_path / "samples.csv").write_text("\n".join(lines))
    with pytest.raises(SamplesError, match=r"line 6: the pose of 'DexTAR' is not a number .*; line 10 likewise"):
        bind(source.problem, source.problem.read(tmp_path / "samples.csv"))
    for command in ("check", "calibrate"):
        assert main([command, str(ROOT / "problems" / "five_bar"), str(tmp_path / "samples.csv")]) != 0
        assert "line 6: the pose of 'DexTAR' is not a number" in "".join(capsys.readouterr())
    assert len(bind(source.problem, rows).measured) == 60


def test_an_arm_that_never_closes_is_refused_in_a_sentence():
    def pose(p, q):
        u = passive(lambda u, q: u**2 + p.size + q**2, q, home=(0.0,), start=(1.0,))
        return translate(u, 0, 0)

    robot = Robot("open", [Joint("revolute", -1, 1)], pose, {"size": Parameter(1.0)})
    with pytest.raises(ProblemError, match="The pose of 'open' is a number in hardly any posture"):
        random_joints(robot, 10, np.random.default_rng(0))


def test_a_loop_that_a_passive_joint_is_no_part_of_is_refused_in_a_sentence():
    def pose(p, q):
        u = passive(lambda u, q: ca.vertcat(p.a * ca.cos(q) - 100.0, u[0]), q[0], home=(0.5,), start=(0.0, 0.0))
        return chain(rotate_z(q[0]), translate(p.a + u[1], 0, 0))

    robot = Robot("loose", [Joint("revolute", -1, 1)], pose, {"a": Parameter(100.0, prior_std=0.1)})
    with pytest.raises(CasacalError, match="loops close"):
        simulate(Problem(robot, TrackedPoint(noise_std=0.02)), samples=20)


def test_where_a_loop_is_open_nothing_is_compared():
    source = load_problem(ROOT / "problems" / "five_bar")
    assert mirror_image(bind(source.problem, source.problem.read(source.samples))) is None
    for name in FORMS:  # the palletiser's loop is singular at zero, where links are laid
        with pytest.raises(ProblemError, match="do not carry one another in order"):
            Links.of(arm(name))


def test_a_target_in_which_the_loop_stays_open_is_named(tmp_path, capsys):
    where, out = str(ROOT / "problems" / "five_bar"), str(tmp_path / "s.csv")
    assert main(["simulate", where, "--samples", "6", "--out", out]) == 0
    (tmp_path / "targets.csv").write_text("q1_deg,q2_deg\n90,90\n130,50\n")
    code = main(
        ["predict", str(tmp_path / "s.truth.json"), str(tmp_path / "targets.csv"), "--out", str(tmp_path / "p")]
    )
    assert code == 2
    assert "line 3: the pose of 'DexTAR' is not a number at these joint values" in capsys.readouterr().err
    assert not (tmp_path / "p").exists()


def test_a_serial_arm_draws_the_postures_it_drew_before():
    robot = load_problem(ROOT / "problems" / "ur5").problem.robot
    wanted = np.random.default_rng(3).uniform(*robot.limits, size=(20, 6))
    np.testing.assert_array_equal(random_joints(robot, 20, np.random.default_rng(3)), wanted)


@pytest.mark.parametrize(
    "name", ["palletiser", *(pytest.param(n, marks=pytest.mark.long) for n in ("five_bar", "delta"))]
)
def test_joint_targets_are_corrected_by_the_calibrated_loop(name):
    """Corrected joints bring the closed form at the estimate to where the closed form as drawn was to be."""
    source = load_problem(ROOT / "problems" / name)
    robot = source.problem.robot
    calibration = calibrate(source.problem, source.problem.read(source.samples))
    lower, upper = robot.limits
    targets = np.array([0.6 * lower + 0.4 * upper, 0.5 * lower + 0.5 * upper])
    moved = np.asarray(compensate(calibration, Samples.of_joints(targets)).joints)
    assert (np.abs(moved - targets).max(axis=1) > 1e-4).all()
    names, x = calibration.motion.arm.names, calibration.motion.x  # where rows and priors tell nothing, as drawn
    _, nominal = numbers(robot, 0.0, 0)
    estimate = nominal + [x[names.index(n)] for key, each in robot.parameters.items() for n in each.names(key)]
    for before, after in zip(targets, moved, strict=True):
        np.testing.assert_allclose(FORMS[name](estimate, after), FORMS[name](nominal, before), atol=1e-5)

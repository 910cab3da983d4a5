"""Conventions of makers, several joints counted otherwise at once, are found and written as a problem needs them."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain

from casacal import Conventions, Robot, check, deg, load_problem
from casacal.calibration.cause import explained
from casacal.calibration.conventions import CONVENTIONS, in_problem, patterns, settings_of, tips_of
from casacal.calibration.finding import misfit
from casacal.model.axes import axes_of

QUARTER = np.pi / 2


def measured(name):
    source = load_problem(ROOT / "problems" / name)
    return source.problem, source.problem.read(source.samples)


def shown(samples, signs, offsets=None, coupled=0.0):
    """The rows as a controller shows them whose joints are signs * (shown + coupled * joint 2 in joint 3) + offsets."""
    n = len(signs)
    mixing = np.eye(n)
    mixing[2, 1] += coupled
    matrix = np.diag(signs) @ mixing
    there = samples.joints - (np.zeros(n) if offsets is None else np.array(offsets))
    return replace(samples, joints=np.linalg.solve(matrix, there.T).T)


MAKERS = {
    "A1, A4, A6": ((-1, 1, 1, -1, 1, -1), None, 0.0, "signs=(-1, 1, 1, -1, 1, -1))"),
    "a parallelogram": ((1, 1, -1, 1, 1, 1), None, -1.0, "signs=(1, 1, -1, 1, 1, 1), coupling=((3, 2, -1),))"),
    "90 - q2": (
        (1, -1, -1, 1, -1, 1),
        (0, QUARTER, 0, 0, 0, 0),
        0.0,
        "signs=(1, -1, -1, 1, -1, 1), offsets=deg(0, 90, 0, 0, 0, 0))",
    ),
    "coupled, wrist reversed": (
        (1, 1, 1, -1, -1, -1),
        (0, -QUARTER, 0, 0, 0, 0),
        1.0,
        "signs=(1, 1, 1, -1, -1, -1), offsets=deg(0, -90, 0, 0, 0, 0), coupling=((3, 2, 1),))",
    ),
}


@pytest.mark.long_unless("a parallelogram")
@pytest.mark.parametrize("maker", MAKERS)
def test_patterns_of_makers_are_found_by_a_tracker(maker):
    signs, offsets, coupled, line = MAKERS[maker]
    problem, samples = measured("instruments/tracker")
    (found,) = (each for each in check(problem, shown(samples, signs, offsets, coupled)) if each.severity == "error")
    assert found.about == CONVENTIONS
    assert found.fix.endswith(f"conventions=Conventions({line}")


@pytest.mark.long_unless("instruments/spike")
@pytest.mark.parametrize("name", ["hsr_jr680", "instruments/spike", "instruments/ball_bar", "instruments/camera"])
def test_what_is_found_puts_the_joints_back_or_the_same_arm(name):
    """Undone, the rows fit as the right ones do, whichever of several equivalent patterns is taken."""
    problem, right = measured(name)
    wrong = shown(right, *MAKERS["90 - q2"][:3])
    base = misfit(problem, wrong)
    cause = explained(problem, wrong, base)
    assert cause.finding.about == CONVENTIONS
    assert misfit(problem, cause.undone.samples) == pytest.approx(misfit(problem, right), rel=0.1)
    if name == "hsr_jr680":
        np.testing.assert_allclose(cause.undone.samples.joints, right.joints, atol=1e-9)


@pytest.mark.long
def test_seven_joints_stay_within_their_limits():
    problem, right = measured("kuka_iiwa14")
    wrong = shown(right, (1, 1, -1, -1, 1, 1, 1))
    cause = explained(problem, wrong, misfit(problem, wrong))
    assert cause.finding.about == CONVENTIONS
    np.testing.assert_allclose(cause.undone.samples.joints, right.joints, atol=1e-9)
    turned = shown(right, (1, -1, 1, 1, 1, -1, 1), (0, np.pi, 0, 0, 0, 0, 0))  # "q2 as 180 - q2" is beyond its limits
    lower, upper = problem.robot.limits
    first, *_ = patterns(problem, turned)
    joints = first.undo(problem, turned).samples.joints
    assert ((joints >= lower) & (joints <= upper)).all()


@pytest.mark.long
def test_a_mirror_image_beside_the_pattern_is_said(hsr):
    samples = hsr.problem.read(hsr.samples)
    found = check(hsr.problem, shown(samples, *MAKERS["a parallelogram"][:3]))
    assert [each.about for each in found if each.severity == "error"] == [CONVENTIONS]
    assert "mirror image" in {each.about for each in found}
    assert "mirror image" not in {
        each.about for each in check(hsr.problem, shown(samples, *MAKERS["a parallelogram"][:3]), confirmed=True)
    }


@pytest.mark.long
def test_one_sign_alone_is_no_pattern_and_clean_rows_have_none():
    problem, samples = measured("instruments/tracker")
    assert list(patterns(problem, samples)) == []
    (found,) = (each for each in check(problem, shown(samples, (1, 1, -1, 1, 1, 1))) if each.severity == "error")
    assert found.about == "joint 3 flipped"


def test_tips_of_every_pattern_are_those_of_the_dh_chain():
    alpha, a, d, theta = (0.3, -1.2, 0.4), (100.0, 50.0, 20.0), (30.0, 10.0, 60.0), (0.1, -0.4, 0.9)
    robot = Robot.from_dh("r", alpha=alpha, a=a, d=d, theta=theta)
    axes, q = axes_of(robot), np.array([[0.3, -0.8, 1.1], [1.4, 0.2, -0.5]])
    tool = np.array([[5.0, -7.0, 11.0], [1.0, 2.0, 3.0]])
    tips = tips_of(axes, settings_of(axes.turns), q, tool @ axes.turn.T + axes.place)
    (first, second, third), k = settings_of(axes.turns), 0
    for one in first:
        for two in second:
            for three in third:
                for row in range(2):
                    before = (0.0, q[row, 0], q[row, 1])
                    u = [s * (q[row, i] + f * before[i]) + n * QUARTER for i, (s, n, f) in enumerate((one, two, three))]
                    pose = dh_chain(alpha, a, d, np.array(theta) + u)
                    np.testing.assert_allclose(tips[row, :, k], (pose @ [*tool[row], 1])[:3], atol=1e-6)
                k += 1
    assert k == tips.shape[2] == 2 * 8 * 6


def test_the_line_is_that_of_table_and_pattern_together():
    """With it the table takes the joints as shown to where the old one took what they mean."""
    old = Conventions((1, -1, 1), tuple(deg(0, 90, 0)), ((3, 2, 1.0),))
    numbers = {"alpha": (0.3, -1.2, 0.4), "a": (100.0, 50.0, 20.0), "d": (30.0, 10.0, 60.0), "theta": (0.1, -0.4, 0.9)}
    meant = Conventions((1, -1, -1), tuple(deg(0, 180, 0)), ((3, 2, -1.0),))
    line = in_problem(Robot.from_dh("r", **numbers, conventions=old), meant)
    new = eval(line.split("conventions=")[1], {"Conventions": Conventions, "deg": deg})
    u = meant.to_model(np.array([0.2, -0.7, 1.3]))  # of the axes, which the table's own signs and offsets are part of
    np.testing.assert_allclose(new.to_model(np.array([0.2, -0.7, 1.3])), np.array([1, -1, 1]) * u + deg(0, 90, 0))
    assert in_problem(replace(Robot.from_dh("r", **numbers), arm=None), meant) == ""

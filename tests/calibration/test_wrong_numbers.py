"""A joint whose zero was lost, a misprint in the table: one number far from where the problem says, and it is named."""

import dataclasses
import math

import numpy as np
import pytest

from casacal import (
    Cell,
    DialOnPlane,
    Joint,
    Problem,
    Robot,
    bind,
    calibrate,
    corner,
    deg,
    scaled_to_accuracy,
    simulate,
    tool_point,
)
from casacal.calibration.check import check
from casacal.calibration.numbers import wrong_number
from casacal.calibration.verdict import verdict_of
from casacal.deployment.compensate import compensate, read_targets
from casacal.deployment.programs import notes


def with_lost_zero(hsr, joint, degrees, seed=0, **changes):
    """Rows of an arm whose controller shows angles that are off by so much."""
    samples = simulate(hsr.problem, dataclasses.replace(hsr.cell, **changes), samples=90, seed=seed).samples
    joints = samples.joints.copy()
    joints[:, joint - 1] -= math.radians(degrees)
    return dataclasses.replace(samples, joints=joints)


@pytest.mark.long_unless("0.6")
@pytest.mark.parametrize("degrees", [0.6, 1.0, -3.0, 10.0])
def test_a_lost_zero_is_named_with_its_size_and_the_advice_mends_it(hsr, degrees):
    samples = with_lost_zero(hsr, 3, degrees)
    refused = verdict_of(calibrate(hsr.problem, samples, reference=False))
    assert refused.level == "do not use"
    assert "theta3 elsewhere" in refused.words
    (named,) = [reason for reason in refused.reasons if "theta3 elsewhere" in reason.lower()]
    size = float(named.split(", by ")[1].split(" degrees")[0])
    assert size == pytest.approx(degrees, rel=0.02, abs=0.1)
    wide = 0.2 if degrees == 10 else 0.1
    assert f"--prior theta3={wide} tries it" in named
    assert "re-master that joint" in named
    mended = calibrate(hsr.problem.with_prior({"theta3": wide}), samples, reference=False)
    assert verdict_of(mended).level == "calibrated"
    assert math.degrees(mended.x[mended.fit.names.index("theta3")]) == pytest.approx(degrees, abs=0.15)


@pytest.mark.long
def test_check_names_it_too(hsr):
    for degrees in (0.6, 5.0):  # one by the prior that it contradicts, one by undoing it
        errors = [found for found in check(hsr.problem, with_lost_zero(hsr, 2, degrees)) if found.severity == "error"]
        assert [found.about for found in errors] == ["theta2 elsewhere"], degrees


@pytest.mark.parametrize(("off", "tried"), [(12.0, "20"), (27.0, "30")])
def test_a_misprinted_length_is_named(hsr, off, tried):
    """The problem says so much less than the arm has; what planes cannot see of it, other numbers do not take over."""
    unknown = hsr.problem.robot.parameters["a"]
    values = np.array(unknown.values)
    values[2] -= off
    printed = dataclasses.replace(unknown, values=tuple(values))
    robot = dataclasses.replace(hsr.problem.robot, parameters={**hsr.problem.robot.parameters, "a": printed})
    samples = simulate(hsr.problem, hsr.cell, samples=90, seed=1).samples
    found = wrong_number(bind(type(hsr.problem)(robot, *hsr.problem.instruments), samples))
    assert [each.about for each in found] == ["a3 elsewhere"]
    assert found[0].fix == f"Correct a3 in the problem file (--prior a3={tried} tries it)"


@pytest.mark.long_unless("clean", "backlash")
@pytest.mark.parametrize(
    "changes",
    [{}, {"repeatability": 0.1}, {"joint_std": 1e-4}, {"backlash": 1e-4}, {"compliance": 0.5}],
    ids=["clean", "noise ten times as stated", "joints that do not repeat", "backlash", "compliance"],
)
def test_no_number_is_blamed_for_what_none_is_to_blame_for(hsr, changes):
    for seed in range(8):
        samples = simulate(hsr.problem, dataclasses.replace(hsr.cell, **changes), samples=90, seed=seed).samples
        assert wrong_number(bind(hsr.problem, samples)) == []


def test_where_all_numbers_are_far_off_none_is_singled_out(hsr):
    """Errors three times as large as the priors say are a matter of the priors."""
    blamed = 0
    for seed in range(8):
        samples = simulate(hsr.problem, dataclasses.replace(hsr.cell, error_scale=3.0), samples=90, seed=seed).samples
        blamed += bool(wrong_number(bind(hsr.problem, samples)))
    assert blamed <= 1


def test_rows_too_few_to_tell_name_nothing(hsr):
    samples = simulate(hsr.problem, hsr.cell, samples=36, seed=3).samples
    assert wrong_number(bind(hsr.problem, samples)) == []
    assert wrong_number(bind(hsr.problem.fix("a", "alpha", "d", "theta"), samples)) == []


def test_noise_that_was_already_found_hides_no_number(hsr):
    """What a number holds back looks like noise; a fit that took it for noise is asked with the noise as stated."""
    bound = bind(hsr.problem, with_lost_zero(hsr, 3, 1.0))
    assert [found.about for found in wrong_number(bound.with_noise({"": 8.0}))] == ["theta3 elsewhere"]


@pytest.mark.long_unless("0")
@pytest.mark.parametrize("seed", range(3))
def test_an_error_of_manufacture_is_no_wrong_number(hsr, seed):
    """Four standard deviations of one zero happen, and the samples see them; that is what calibration is for."""
    samples = with_lost_zero(hsr, 3, math.degrees(4e-3), seed, error_scale=0.2)
    assert wrong_number(bind(hsr.problem, samples)) == []
    assert wrong_number(bind(hsr.problem, with_lost_zero(hsr, 3, math.degrees(9e-3), seed, error_scale=0.2)))


def _ur10e(length, d6=116.55):
    """A UR10e with a tool of a length (mm), as its maker's table has it, or with another last length."""
    rows = ((90, 0, 180.7), (0, -612.7, 0), (0, -571.55, 0), (90, 0, 174.15), (-90, 0, 119.85), (0, 0, d6))
    robot = Robot.from_dh(
        "UR10e",
        alpha=deg(*(row[0] for row in rows)),
        a=[row[1] for row in rows],
        d=[row[2] for row in rows],
        theta=deg(*[0] * 6),
        parallel=(2, 3),
        joints=[Joint("revolute", *deg(-360, 360))] * 6,
    )
    dial = DialOnPlane(noise_std=0.01, sign=-1, travel=10.0, tool=tool_point(0, 0, length, prior_std=1.0))
    return scaled_to_accuracy(Problem(robot, dial), 0.5)


@pytest.fixture(scope="module")
def longer_tool():
    """Rows of an arm whose tool is 4.5 mm longer than stated, and the problem that states 115 mm."""
    cell = Cell(faces=corner((800.0, 0.0, 400.0), size=400.0))
    return _ur10e(115.0), simulate(_ur10e(119.5), cell, samples=90, seed=5).samples


@pytest.mark.long
def test_a_longer_tool_and_the_last_link_are_named_together_the_tool_first(longer_tool):
    """The two move the tip alike; whoever corrected d6 got a flange that is 4.5 mm wrong, and "Calibrated"."""
    problem, samples = longer_tool
    (error,) = (finding for finding in check(problem, samples) if finding.severity == "error")
    assert error.about == "tool or d6 elsewhere"
    assert error.cause.index("the tool") < error.cause.index("d6")
    sizes = [float(error.cause.split(name)[1].split(" mm")[0]) for name in ("tool_z by ", "d6 (by ")]
    assert sizes == pytest.approx([4.5, 4.5], abs=0.5)
    assert "Measure the tool from the flange and the zero of the dial first" in error.fix
    refused = verdict_of(calibrate(problem, samples, reference=False))
    assert refused.level == "do not use"
    for words in (str(error), *refused.reasons):
        assert "--prior" not in words
    assert not [finding for finding in check(problem, samples) if finding.about == "tool elsewhere"], "said once"
    right = calibrate(_ur10e(119.5), samples, reference=False)
    assert verdict_of(right).level == "calibrated", "who obeys is better off"


@pytest.mark.parametrize(("tool", "told"), [(1.0, True), (0.1, False)])
def test_a_length_freed_by_hand_promises_nothing_at_the_flange_while_the_tool_may_be_longer(longer_tool, tool, told):
    """Who knows the tool to a tenth is believed: then it is the length that differs."""
    problem, samples = longer_tool
    dial = dataclasses.replace(problem.instrument, tool=tool_point(0, 0, 115.0, prior_std=(1.0, 1.0, tool)))
    freed = Problem(problem.robot, dial).with_prior({"d6": 20.0})
    found = calibrate(freed, samples, reference=False)
    verdict, (_, flange) = verdict_of(found), found.flange_std
    if not told:
        assert flange < 0.5
        return
    assert verdict.level == "use with care"
    assert "cannot tell tool from d6, so nothing is promised at the flange" in verdict.words
    assert math.isnan(flange), "1.0 mm, where 4.5 were wrong"
    assert "Measure the tool from the flange; only if it is as stated, keep d6" in " ".join(verdict.reasons)


@pytest.mark.long_unless("119.5")
@pytest.mark.parametrize("length", [112.0, 119.5])
def test_a_held_tool_is_named_as_well(length):
    """A tool without a prior is no unknown, and yet these rows cannot tell it from the last link."""
    held = tool_point(0, 0, 115.0, free=False)
    problem = _ur10e(115.0)
    problem = Problem(problem.robot, dataclasses.replace(problem.instrument, tool=held))
    cell = Cell(faces=corner((800.0, 0.0, 400.0), size=400.0))
    samples = simulate(_ur10e(length), cell, samples=90, seed=6).samples
    (error,) = (finding for finding in check(problem, samples) if finding.severity == "error")
    assert error.about.startswith("tool")
    assert "--prior" not in str(error)


@pytest.mark.long_unless("False")
@pytest.mark.parametrize("held", [False, True])
def test_a_last_link_that_is_shorter_is_named_beside_the_tool(held):
    """5 mm of d6 look like a tool 5 mm longer, which is a warning as such, or an error where the tool is held."""
    right = _ur10e(120.0)
    cell = Cell(faces=corner((800.0, 0.0, 400.0), size=400.0))
    samples = simulate(right, cell, samples=120, seed=9).samples
    problem = _ur10e(120.0, d6=112.55).with_prior({"d6": 0.7})
    problem = problem.fix("tool") if held else problem
    found = [each for each in check(problem, samples) if "elsewhere" in each.about]
    assert found
    for each in found:
        assert "tool" in str(each)
        assert "d6" in str(each)
        assert "--prior" not in str(each)


def test_compensated_flanges_promise_nothing_while_the_tool_may_be_longer(longer_tool, tmp_path):
    problem, samples = longer_tool
    found = calibrate(problem.with_prior({"d6": 20.0}), samples, reference=False)
    file = tmp_path / "targets.csv"
    rows = [",".join(f"{value:.4f}" for value in np.degrees(row)) for row in samples.joints[:3]]
    file.write_text("\n".join([",".join(f"q{i}_deg" for i in range(1, 7)), *rows]) + "\n")
    targets = read_targets(file, found.arm.source)
    for frame, known in (("flange", False), ("tip", True)):
        said = " ".join(notes(compensate(found.arm, targets, frame=frame), found.arm))
        assert ("position error of the tip to expect" in said) == known
        assert ("the error of the flange is not known" in said) != known

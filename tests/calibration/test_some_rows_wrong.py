"""Mistakes of some rows: angles in radians, a dial of wrong gain, a fifth of the places those of lost targets."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

from casacal import Problem, calibrate, check, load_problem, simulate
from casacal.calibration.faults import some_radians


def measured(name):
    source = load_problem(ROOT / "problems" / name)
    return source.problem, source.problem.read(source.samples)


def errors(problem, samples):
    return [finding for finding in check(problem, samples) if finding.severity == "error"]


@pytest.mark.long_unless("0.05-instruments/tracker")
@pytest.mark.parametrize("name", ["hsr_jr680", "ur5", "instruments/tracker"])
@pytest.mark.parametrize("part", [0.05, 0.2, 0.5])
def test_rows_in_radians_are_named_by_their_lines(name, part):
    problem, samples = measured(name)
    rows = np.arange(len(samples)) >= round((1 - part) * len(samples))
    joints = np.where(rows[:, None], np.radians(samples.joints), samples.joints)
    (found,) = errors(problem, replace(samples, joints=joints))
    assert found.about == "unit of some joints"
    first = np.flatnonzero(rows)[0]
    assert f"the joint angles of lines {samples.lines[first]}, {samples.lines[first + 1]}" in found.cause


def test_a_row_near_zero_is_in_degrees_like_all():
    problem, samples = measured("hsr_jr680")
    rows = replace(samples, joints=np.vstack([np.full(6, 0.05), samples.joints[1:]]))
    assert [found.about for found in errors(problem, rows)] == ["outliers"], "its reading is another posture's"


@pytest.mark.long_unless("-0.03")
@pytest.mark.parametrize("by", [0.02, -0.03])
def test_the_gain_of_a_dial(hsr, by):
    samples = hsr.problem.read(hsr.samples)
    shown = replace(samples, columns={"reading": samples.columns["reading"] * (1 + by)})
    (found,) = errors(hsr.problem, shown)
    assert found.about == "scale of the dial"
    assert "gain=dial_gain" in found.fix
    said = float(found.cause.split("by ")[1].split(" %")[0])
    assert said == pytest.approx(100 * by, abs=0.1)


@pytest.mark.parametrize("part", [0.1, 0.2, 0.28])
@pytest.mark.parametrize("size", [150.0, 1e4])
def test_lost_places_are_named_however_many(part, size):
    problem, samples = measured("instruments/tracker")
    rng = np.random.default_rng(1)
    rows = np.sort(rng.choice(len(samples), round(part * len(samples)), replace=False))
    columns = {name: values.copy() for name, values in samples.columns.items()}
    away = rng.normal(size=(len(rows), 3))
    for k, name in enumerate("xyz"):
        columns[name][rows] += size * (away / np.linalg.norm(away, axis=1, keepdims=True))[:, k]
    (found,) = errors(problem, replace(samples, columns=columns))
    assert (found.about, found.lines) == ("outliers", tuple(samples.lines[row] for row in rows))
    if part == 0.1:
        result = calibrate(problem, replace(samples, columns=columns), reference=False)
        right = calibrate(problem, samples, reference=False)
        assert result.tip_std[1] == pytest.approx(right.tip_std[1], rel=0.2)


def test_only_what_one_turn_in_radians_may_be_is_taken_for_radians():
    """2 pi degrees: a joint never stands a whole turn and more from zero."""
    problem, samples = measured("hsr_jr680")
    joints = samples.joints.copy()
    joints[:3] = np.radians([[6.2] * 6, [-6.3] * 6, [10.0] * 6])
    (fault,) = some_radians(problem, replace(samples, joints=joints))
    assert f"angles of line {samples.lines[0]} look" in fault.cause
    undone = fault.undo(problem, samples).samples.joints
    np.testing.assert_allclose(undone, np.vstack([np.full(6, 6.2), joints[1:]]))
    assert list(some_radians(problem, samples)) == []


@pytest.mark.parametrize("name", ["instruments/tracker", "hsr_jr680", "adept_cobra600"])
def test_a_pose_function_in_metres_is_named_whatever_it_is_measured_with(name):
    source = load_problem(ROOT / "problems" / name)
    robot, instrument = source.problem.robot, source.problem.instrument
    samples = simulate(source.problem, source.cell, samples=40, seed=1).samples

    def metres(p, q):
        pose = robot.pose(p, q)
        return ca.vertcat(ca.horzcat(pose[:3, :3], pose[:3, 3] / 1000), ca.DM([[0, 0, 0, 1]]))

    found = errors(Problem(replace(robot, pose=metres, arm=None), instrument), samples)
    assert [each.about for each in found] == ["arm in metres"]
    assert "arm in metres" not in {each.about for each in errors(source.problem, samples)}

"""Numbers of an arm that contradict their priors: borne out by rows of the tip, or refused; a tool's own prior."""

import dataclasses
import math

import numpy as np
import pytest
from conftest import ROOT

from casacal import Problem, TrackedPoint, bind, calibrate, lm, load_problem, simulate, tool_point
from casacal.calibration.verdict import verdict_of
from casacal.effects.selection import regions_borne_out
from casacal.uncertainty.moves import prior_scatter

UR5 = load_problem(ROOT / "problems" / "ur5")


def tracked(prior_std=20.0):
    """The arm with a reflector whose place on the flange is known to so many mm."""
    return Problem(UR5.problem.robot, TrackedPoint(noise_std=0.05, tool=tool_point(0, 0, 60, prior_std=prior_std)))


def with_lost_zero(degrees, seed=1):
    """Rows of a tracker, of an arm whose controller shows angles of joint 4 that are off by so much."""
    samples = simulate(tracked(), samples=120, seed=seed).samples
    joints = samples.joints.copy()
    joints[:, 3] -= math.radians(degrees)
    return dataclasses.replace(samples, joints=joints)


@pytest.mark.long
def test_a_number_that_rows_of_the_tip_bear_out_is_no_reason_to_refuse():
    found = calibrate(tracked(), with_lost_zero(0.7), reference=False)
    said = verdict_of(found)
    assert (said.level, found.borne_out) == ("use with care", {"theta4"})
    assert any("bear out that theta4 of this arm differs from the drawing" in reason for reason in said.reasons)
    assert any("state wider priors (--prior" in reason for reason in said.reasons)


@pytest.mark.long
def test_no_arm_is_built_so_far_from_its_drawing():
    found = calibrate(tracked(), with_lost_zero(10.0), reference=False)
    assert (verdict_of(found).level, found.borne_out) == ("do not use", frozenset())


def test_faces_bear_nothing_out(hsr):
    samples = simulate(hsr.problem, hsr.cell, samples=90, seed=0).samples
    joints = samples.joints.copy()
    joints[:, 2] -= math.radians(0.6)
    found = calibrate(hsr.problem, dataclasses.replace(samples, joints=joints), reference=False)
    assert (verdict_of(found).level, found.borne_out) == ("do not use", frozenset())


@pytest.mark.parametrize(("wave", "borne"), [(0.0, True), (2e-3, False)])
def test_regions_that_were_left_out_show_what_a_fit_leaves_out(wave, borne):
    """A wave of the second joint that geometry does not know, of 2 mrad."""
    samples = simulate(tracked(), samples=120, seed=2).samples
    joints = samples.joints.copy()
    joints[:, 1] += wave * np.sin(3 * joints[:, 1])
    bound = bind(tracked(), dataclasses.replace(samples, joints=joints))
    assert regions_borne_out(bound, lm(bound)) is borne


def test_the_prior_of_a_tool_is_no_part_of_the_arms():
    """What the drawn arm misses by says nothing of a reflector that nobody measured."""
    samples = simulate(tracked(), samples=120, seed=3).samples
    near, far = (bind(tracked(std), samples) for std in (1.0, 100.0))
    assert prior_scatter(far).rms == pytest.approx(prior_scatter(near).rms, rel=1e-9)
    assert prior_scatter(far, flat_counts=True).rms > 10 * prior_scatter(near, flat_counts=True).rms

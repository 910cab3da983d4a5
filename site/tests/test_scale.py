"""The size of the arm: what readings of a dial and a known step say of it."""

import dataclasses

import numpy as np
import pytest

from casacal import Face, Problem, Step, bind, gauge_block, ipopt, lm, simulate
from casacal.errors import ProblemError
from casacal.instruments import DialOnBody
from casacal.uncertainty.workspace import bayesian_bound, conditional_scale_std, marginal_scale_std, workspace_joints


def exact(hsr, instrument, faces, travel, samples):
    """The nominal arm in exact contact."""
    problem = Problem(hsr.problem.robot, instrument)
    cell = dataclasses.replace(hsr.cell, faces=faces, travel=travel, error_scale=0.0, repeatability=0.0, resolution=0.0)
    return bind(problem, simulate(problem, cell, samples=samples, seed=1).samples)


@pytest.mark.parametrize(("travel", "ppm"), [(1.0, 1650), (10.0, 165)])
def test_dial_travel_alone_says_little_of_size(hsr, travel, ppm):
    # 120 readings uniform over the travel, 0.01 mm, all else known
    bound = exact(hsr, hsr.problem.instruments[0], hsr.cell.faces, travel, 120)
    assert 1e6 * conditional_scale_std(bound) == pytest.approx(ppm, rel=0.1)
    assert marginal_scale_std(bound) > conditional_scale_std(bound)


def raised_faces(hsr):
    faces = [
        Face(f"{face.label} raised", tuple(np.array(face.centre) + 100 * face.axes[0]), face.normal, (300, 300))
        for face in hsr.cell.faces
    ]
    steps = {face.label: Step(face.label.removesuffix(" raised"), 100.0) for face in faces}
    return (*hsr.cell.faces, *faces), steps


def test_a_known_step_fixes_the_size(hsr):
    # 480 touches, half of them on faces raised by a certified 100 mm: 100 ppm / sqrt(240), a little less for tilt
    faces, steps = raised_faces(hsr)
    dial = dataclasses.replace(hsr.problem.instruments[0], steps=steps)
    bound = exact(hsr, dial, faces, 1.0, 480)
    assert 1e6 * conditional_scale_std(bound) == pytest.approx(6, rel=0.1)


@pytest.mark.parametrize("seed", range(1, 4))
def test_knowing_the_length_of_a_gauge_block_lowers_the_expected_tip_error(hsr, seed):
    # the same touches twice: once the block's faces are two more planes, once their distance is certified
    joints, robot = workspace_joints(hsr.problem.robot), hsr.problem.robot
    stepped = Problem(robot, dataclasses.replace(hsr.problem.instruments[0], steps={"top": Step("base", 100.0)}))
    faces = (*hsr.cell.faces, *gauge_block((1200.0, 100.0, 450.0)))
    simulation = simulate(stepped, dataclasses.replace(hsr.cell, faces=faces), samples=200, seed=seed)
    bounds = []
    for problem in (hsr.problem, stepped):
        bound = bind(problem, simulation.samples)
        result = lm(bound)
        assert result.cost == pytest.approx(ipopt(bound).cost, rel=1e-8)
        error = (result.x - simulation.truth(bound)) / result.std
        assert np.abs(error).max() < 4.5
        tips, slopes = bound.tips(bound.x0, joints), bound.tip_jacobian(bound.x0, joints)
        bounds.append(bayesian_bound(bound.normal(bound.x0).information, bound.prior_std, slopes, tips))
    assert bounds[1] < 0.75 * bounds[0]


def test_certified_angles_need_fewer_unknowns_and_agree(hsr):
    normals = {face.label: face.normal for face in hsr.cell.faces}
    problem = Problem(hsr.problem.robot, DialOnBody(noise_std=0.01, normals=normals))
    simulation = simulate(problem, hsr.cell, seed=2)
    bound = bind(problem, simulation.samples)
    assert bound.unknowns == 24 + 3 + 3
    result = lm(bound)
    assert result.converged
    reference = ipopt(bound)
    assert reference.converged
    assert result.cost == pytest.approx(reference.cost, rel=1e-8)
    error = (result.x - simulation.truth(bound))[:24] / result.std[:24]
    assert np.abs(error).max() < 4.5


def test_steps_and_bodies_that_make_no_sense_are_refused(hsr):
    dial = hsr.problem.instruments[0]
    for steps in ({"a": Step("a", 1.0)}, {"a": Step("b", 1.0), "b": Step("c", 1.0)}, {"a": Step("b", 0.0)}):
        with pytest.raises(ProblemError, match="Step"):
            dataclasses.replace(dial, steps=steps)
    with pytest.raises(ProblemError, match="not parallel"):
        DialOnBody(noise_std=0.01, normals={"a": (0, 0, 1), "b": (0, 0, -1)})
    body = Problem(hsr.problem.robot, DialOnBody(noise_std=0.01, normals={"floor": (0, 0, 1), "wall": (-1, 0, 0)}))
    with pytest.raises(ProblemError, match="the body does not have"):
        bind(body, simulate(hsr.problem, hsr.cell, seed=1).samples)

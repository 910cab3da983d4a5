"""What holds for every problem of this project; a new folder of problems/ is adopted without writing a test."""

import re

import numpy as np
import pytest
from conftest import ROOT
from oracles import central_difference

from casacal import bind, ekf, ipopt, lm, load_problem, sckf, sckf_lm, simulate
from casacal.fit import plane_only
from casacal.uncertainty.identifiability import identifiability
from casacal.uncertainty.tip_error import workspace_joints

FOLDERS = sorted(path.parent for path in (ROOT / "problems").glob("*/problem.py"))


@pytest.fixture(scope="module", params=FOLDERS, ids=lambda folder: folder.name)
def folder(request):
    return request.param


@pytest.fixture(scope="module")
def bound(folder):
    """The problem with its own samples, or, where it has none, with simulated ones."""
    source = load_problem(folder)
    if source.samples.is_file():
        numbers = range(len(source.problem.instruments))
        return bind(source.problem, *(source.problem.read(source.samples_of(i), i) for i in numbers))
    return bind(source.problem, simulate(source.problem, source.cell, seed=1).measured)


def test_a_problem_says_what_it_is(folder):
    text = (folder / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) >= 5
    for samples in folder.glob("samples*.csv"):
        # it says in its first line whether it was simulated; then the command that makes it must be given
        simulated = samples.read_text(encoding="utf-8").startswith("# simulated")
        assert not simulated or ("**simulated**" in text and re.search(r"casacal simulate problems/\w+.* --out", text))


def test_residual_and_jacobian_are_finite(bound):
    x = 0.5 * bound.start_std * np.random.default_rng(0).normal(size=bound.unknowns)
    for where in (bound.x0, x):
        assert np.isfinite(bound.residual(where)).all()
        assert np.isfinite(bound.jacobian(where)).all()


def test_the_jacobian_equals_a_central_difference(bound):
    x = 0.5 * bound.start_std * np.random.default_rng(1).normal(size=bound.unknowns)
    steps = 1e-3 * bound.start_std
    expected = central_difference(bound.residual, x, steps) * bound.start_std
    np.testing.assert_allclose(bound.jacobian(x) * bound.start_std, expected, atol=1e-5 * np.abs(expected).max())


def test_all_views_of_the_seam_agree(bound):
    rng = np.random.default_rng(2)
    x = 0.3 * bound.start_std * rng.normal(size=bound.unknowns)
    r, jacobian, normal = bound.residual(x), bound.jacobian(x), bound.normal(x)
    assert normal.cost == pytest.approx(r @ r / 2, rel=1e-12)
    np.testing.assert_allclose(normal.gradient, jacobian.T @ r, rtol=1e-9, atol=1e-9 * np.abs(jacobian.T @ r).max())
    np.testing.assert_allclose(normal.information, jacobian.T @ jacobian, rtol=1e-9, atol=1e-6)
    states = np.array([x, bound.x0, -x])
    for k in (0, bound.rows // 2, bound.rows - 1):
        np.testing.assert_allclose(bound.row(k, states), [bound.residual(s)[k] for s in states], rtol=1e-9, atol=1e-9)
        value, gradient = bound.row_jacobian(k, x)
        assert value == pytest.approx(r[k], rel=1e-9, abs=1e-9)
        np.testing.assert_allclose(gradient, jacobian[k], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(bound.costs(states), [bound.cost(s) for s in states])


def test_minimisers_agree_with_each_other_and_with_ipopt(bound):
    costs = [method(bound).cost for method in (lm, sckf_lm, ipopt)]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-8)
    assert ipopt(bound).converged


def test_filters_come_near_and_the_control_stays_behind(bound):
    best, nominal = lm(bound).cost, bound.cost(bound.x0)
    for method in (sckf, ekf):
        assert best - 1e-6 <= method(bound).cost < best + 0.05 * (nominal - best)
    assert best < plane_only(bound).cost <= nominal * (1 + 1e-12)  # least squares starts at the best planes


def test_rank_is_what_the_readme_states(folder, bound):
    joints = workspace_joints(bound.problem.robot)
    found = identifiability(bound, bound.tip_jacobian(bound.x0, joints), bound.tips(bound.x0, joints))
    stated = re.search(r"[Rr]ank (\d+) of (\d+)", (folder / "README.md").read_text(encoding="utf-8"))
    assert stated is not None
    assert (found.rank, found.unknowns) == (int(stated[1]), int(stated[2]))


def test_tip_jacobian_equals_a_central_difference(bound):
    joints = workspace_joints(bound.problem.robot, poses=7)
    x = 0.3 * bound.start_std * np.random.default_rng(3).normal(size=bound.unknowns)
    expected = central_difference(lambda x: bound.tips(x, joints).ravel(), x, 1e-3 * bound.start_std)
    np.testing.assert_allclose(bound.tip_jacobian(x, joints) * bound.start_std, expected * bound.start_std, atol=1e-5)

"""Estimators on problems whose answer is known, and filters against other people's filters."""

import dataclasses
import math
import shutil
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from filterpy.kalman import CubatureKalmanFilter
from linear import Matrix, Weighing, as_symbols, random_linear
from oracles import central_difference, cubature_step, posterior
from scipy.optimize import least_squares

from casacal import (
    Parameter,
    Problem,
    bind,
    calibrate,
    ekf,
    ipopt,
    lm,
    load_problem,
    nominal,
    plate,
    sckf,
    sckf_lm,
    simulate,
)
from casacal.errors import ProblemError
from casacal.fit import null_step, plane_only, scipy_least_squares
from casacal.fit.filters import Belief, cubature_update, linear_update, predict
from casacal.fit.ipopt import Objective
from casacal.fit.least_squares import DampedStep, Normal, Status
from casacal.fit.lm import Damping, Move, Point, Shortest, acceptable, given_up, next_move
from casacal.simulation import Simulated
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints

ALL = {"lm": lm, "sckf": sckf, "sckf_lm": sckf_lm, "ekf": ekf, "ipopt": ipopt, "scipy": scipy_least_squares}


@pytest.mark.parametrize("method", ALL.values(), ids=ALL)
@pytest.mark.parametrize("seed", range(3))
def test_linear_problems_are_solved_to_the_closed_form(method, seed):
    a, y, nominal, prior, noise = random_linear(seed)
    mean, covariance = posterior(a / noise, y / noise, nominal, prior)
    result = method(as_symbols(a, y, nominal, prior, noise))
    assert result.converged
    np.testing.assert_allclose(result.x + nominal, mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(result.covariance, covariance, rtol=0, atol=1e-10)


@pytest.mark.parametrize("method", [lm, sckf, sckf_lm, ekf, scipy_least_squares], ids=lambda m: m.__name__)
def test_estimators_need_no_more_than_a_matrix(method):
    a, y, nominal, prior, noise = random_linear(7)
    mean, covariance = posterior(a / noise, y / noise, nominal, prior)
    result = method(Matrix(a / noise, y / noise, nominal, prior))
    np.testing.assert_allclose(result.x, mean, atol=1e-10)
    np.testing.assert_allclose(result.covariance, covariance, atol=1e-10)
    with pytest.raises(ProblemError, match="symbolic form"):
        ipopt(result.problem)


def test_plane_only_solves_its_own_unknowns_and_leaves_the_rest():
    a, y, nominal, prior, noise = random_linear(8)
    own = np.array([False, True, False, True, True])
    result = plane_only(Matrix(a / noise, y / noise, nominal, prior, datum=own))
    fixed = (y - a[:, ~own] @ nominal[~own]) / noise
    mean, covariance = posterior(a[:, own] / noise, fixed, nominal[own], prior[own])
    np.testing.assert_allclose(result.x[own], mean, atol=1e-10)
    np.testing.assert_array_equal(result.x[~own], nominal[~own])
    np.testing.assert_allclose(result.covariance[np.ix_(own, own)], covariance, atol=1e-10)
    np.testing.assert_allclose(result.std[~own], prior[~own])


@pytest.mark.parametrize("method", [*ALL.values(), plane_only], ids=[*ALL, "plane_only"])
def test_estimators_repeat_themselves_and_mutate_nothing(method, corner_bound):
    before = (corner_bound.x0.copy(), corner_bound.blocks[0].data.copy(), corner_bound.prior_std.copy())
    first, second = method(corner_bound), method(corner_bound)
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(first.covariance, second.covariance)
    after = (corner_bound.x0, corner_bound.blocks[0].data, corner_bound.prior_std)
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)
    assert first.converged
    assert first.residual_rows > 0


def test_scipy_finds_the_same_minimum(corner_bound):
    ours, theirs = lm(corner_bound), scipy_least_squares(corner_bound)
    assert theirs.converged
    assert theirs.cost == pytest.approx(ours.cost, rel=1e-10)
    np.testing.assert_allclose(theirs.x / ours.std, ours.x / ours.std, rtol=0, atol=1e-5)
    assert scipy_least_squares(corner_bound, max_evaluations=2).status is Status.MAX_STEPS


def test_the_nominal_control_estimates_nothing(corner_bound):
    result = nominal(corner_bound)
    np.testing.assert_array_equal(result.x, corner_bound.x0)
    np.testing.assert_array_equal(result.std, corner_bound.prior_std)
    assert (result.status, result.residual_rows) == (Status.NOMINAL, 0)


def test_a_step_in_the_null_space_moves_the_tip_and_no_plane(hsr):
    # one face with the tool nearly normal, where much of the arm goes unseen
    cell = dataclasses.replace(hsr.cell, faces=plate((1350.0, 0.0, 500.0)), tilt=math.radians(5))
    trials = [Simulated(hsr.problem, cell).trial(seed) for seed in range(5)]
    judged = [(t.judge(lm(t.problem)), t.judge(null_step(t.problem, seed=k))) for k, t in enumerate(trials)]
    assert all(after["fit_rmse_mm"] == pytest.approx(before["fit_rmse_mm"], rel=0.03) for before, after in judged)
    worse = [after["heldout_rmse_mm"] / before["heldout_rmse_mm"] for before, after in judged]
    assert np.median(worse) == pytest.approx(1, abs=0.03)
    one_face = trials[4]
    joints = workspace_joints(one_face.problem.problem.robot)
    tips = [one_face.problem.tips(method(one_face.problem).x, joints) for method in (lm, null_step)]
    assert tip_rms(without_rigid((tips[1] - tips[0]).ravel(), tips[0])) > 0.5
    wild = null_step(one_face.problem, seed=4, size=300.0)  # halved until the planes do not notice
    best = lm(one_face.problem).x
    r, bent, bolder = (one_face.problem.residual(x) for x in (best, wild.x, 2 * wild.x - best))
    assert np.linalg.norm(bent) <= 1.01 * np.linalg.norm(r) < np.linalg.norm(bolder)  # no more often than need be
    wild_tips = one_face.problem.tips(wild.x, joints)
    assert tip_rms(without_rigid((wild_tips - tips[0]).ravel(), tips[0])) > 0.5
    np.testing.assert_array_equal(wild.x, null_step(one_face.problem, seed=4, size=300.0).x)


def test_running_out_of_steps_is_said(corner_bound):
    assert lm(corner_bound, max_steps=1).status is Status.MAX_STEPS
    assert ipopt(corner_bound, max_steps=1).status is Status.MAX_STEPS
    assert not lm(corner_bound, max_steps=1).converged


def test_values_that_are_not_finite_are_said():
    a, y, nominal, prior, _ = random_linear(9)
    a[3, 2] = math.nan
    for method in (lm, sckf, ekf):
        assert method(Matrix(a, y, nominal, prior)).status is Status.NOT_FINITE


class Circle(Matrix):
    """A curved residual: distances from two points of the plane, far from linear."""

    def __init__(self, x0):
        super().__init__(np.zeros((2, 2)), np.array([5.0, 5.0]), np.array(x0), np.full(2, np.inf), np.full(2, 1.0))
        self.anchors = np.array([[0.0, 0.0], [6.0, 0.0]])

    def residual(self, x):
        return np.linalg.norm(x - self.anchors, axis=1) - self.b

    def jacobian(self, x):
        away = x - self.anchors
        return away / np.linalg.norm(away, axis=1)[:, None]


def test_lm_finds_a_curved_zero_from_afar_and_its_cost_never_rises():
    result = lm(Circle([40.0, 1.0]))
    np.testing.assert_allclose(result.x, [3.0, 4.0], atol=1e-8)
    assert all(after <= before + 1e-9 for before, after in pairwise(result.trace["cost"]))
    assert result.kkt < 1e-8


def test_lm_agrees_with_scipy_on_a_robot(corner_bound):
    lam = np.sqrt(np.diagonal(corner_bound.prior_information))
    scipy_result = least_squares(
        lambda x: np.concatenate([corner_bound.residual(x), lam * x]),
        corner_bound.x0,
        jac=lambda x: np.vstack([corner_bound.jacobian(x), np.diag(lam)]),
        x_scale=corner_bound.start_std,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-12,
    )
    result = lm(corner_bound)
    assert result.cost == pytest.approx(scipy_result.cost, rel=1e-9)
    np.testing.assert_allclose(result.x / result.std, scipy_result.x / result.std, atol=1e-4)


def test_lm_from_nominal_needs_few_evaluations(corner_bound):
    assert lm(corner_bound).steps <= 8


class Spoilt(Matrix):
    """Residuals that are finite everywhere, with a Jacobian that is not, or with no step; it counts what is asked."""

    def __init__(self, *, slopes=None, beyond=-1.0, steps=True):
        super().__init__(np.eye(3), np.ones(3), np.zeros(3), np.ones(3))
        self.slopes, self.beyond, self.steps, self.asked = slopes, beyond, steps, 0

    def jacobian(self, x):
        spoilt = self.slopes is not None and np.linalg.norm(x) > self.beyond
        return np.full((3, 3), self.slopes) if spoilt else self.a.copy()

    def damped_step(self, x, normal, damping):
        self.asked += 1
        assert self.asked <= 1000, "more steps than max_steps allows"
        return super().damped_step(x, normal, damping) if self.steps else None

    def revealing_step(self, x, normal, damping, loss=None):
        return super().revealing_step(x, normal, damping, loss) if self.steps else None


@pytest.mark.parametrize("slopes", [math.nan, math.inf, -math.inf, 1e200], ids=str)
@pytest.mark.filterwarnings("ignore:(invalid value|overflow) encountered:RuntimeWarning")
def test_lm_ends_where_the_cost_is_finite_and_its_derivatives_are_not(slopes):
    start = lm(Spoilt(slopes=slopes))
    assert (start.status, start.steps, start.converged) == (Status.NOT_FINITE, 0, False)
    np.testing.assert_array_equal(start.x, 0.0)
    later = lm(Spoilt(slopes=slopes, beyond=0.1))  # it goes as far as slopes are finite
    assert later.status is Status.STUCK
    assert 0.09 < np.linalg.norm(later.x) <= 0.1
    assert later.steps < 500


def test_lm_ends_where_there_is_never_a_step():
    problem = Spoilt(steps=False)
    result = lm(problem)
    assert result.status is Status.STUCK
    assert result.steps == problem.asked < 20
    assert lm(Spoilt(steps=False), max_steps=3).status is Status.MAX_STEPS
    assert lm(Spoilt(steps=False), damping=0.0, max_steps=100).steps == 100


@pytest.mark.parametrize("backend", ["c", "blocks"])
def test_a_model_with_an_infinite_slope_is_refused_before_any_step(backend):
    class Root(Weighing):
        def residual(self, pose, p, row):
            return ca.sqrt(p.b[0]) - row.y

    linear = as_symbols(*random_linear(1, 9, 1))
    problem = Problem(linear.problem.robot, Root(Parameter((0.0,), prior_std=1.0), 0.2))
    if backend == "c" and not any(shutil.which(name) for name in ("gcc", "clang", "cc")):
        pytest.skip("no C compiler")
    with pytest.raises(ProblemError, match="line 1: the residual of Root has no finite derivative in this row"):
        bind(problem, *linear.samples, backend=backend)


def test_damping_follows_the_gain_ratio_as_nielsen_has_it():
    level = Damping(9.0)
    assert [level.accepted(ratio).mu for ratio in (1.0, 0.5, 1e-9, 100.0)] == pytest.approx([3.0, 9.0, 18.0, 3.0])
    mus = [(level := level.rejected()).mu for _ in range(3)]
    assert mus == [18.0, 72.0, 576.0]
    assert level.accepted(0.5) == Damping(576.0, 2.0)
    assert not level.stuck
    assert Damping(1e51).stuck


def test_on_a_linear_problem_the_model_foretells_the_fall():
    a, y, nominal, prior, noise = random_linear(4)
    problem = Matrix(a / noise, y / noise, nominal, prior)
    result = lm(problem)
    assert result.trace["gain_ratio"][1] == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(result.trace["damping"][:2], [1e-3, 1e-3 / 3])


def a_move(length, *, undamped=True, hidden=True, predicted=1e-20):
    return Move(DampedStep(np.zeros(1), length**2, predicted), undamped, hidden)


def test_when_lm_stops():
    last = a_move(1e-3)
    assert a_move(1e-10).negligible(None, 1e-9)
    assert a_move(1e-7).negligible(last, 1e-9)  # the next, again 1e-4 times as long, is below the tolerance
    assert not a_move(1e-5).negligible(last, 1e-9)
    assert not a_move(1e-7).negligible(None, 1e-9)
    assert not a_move(1e-7).negligible(a_move(1e-3, undamped=False), 1e-9)  # shorter, but not by its own merit
    assert not a_move(1e-7, hidden=False).negligible(last, 1e-9)
    assert not a_move(1e-30, undamped=False).negligible(last, 1e-9)  # damping makes any step short


def test_lm_gives_up_when_no_damping_is_left_to_try():
    here = Point(np.zeros(1), Normal(3.0, np.zeros(1), np.eye(1)), 3.0)
    assert given_up(a_move(1.0, predicted=1e-15), here, Shortest()) is None
    assert given_up(a_move(1.0, predicted=1e-16), here, Shortest()) is Status.STUCK
    assert given_up(a_move(1.0, predicted=1e-16), here, Shortest(1e-4, here)) is Status.PRECISION
    assert given_up(a_move(1.0, predicted=1e-16), here, Shortest(1e-2, here)) is Status.STUCK


def test_the_shortest_undamped_step_is_remembered():
    one, other = (Point(np.full(1, k), Normal(1.0, np.zeros(1), np.eye(1)), 1.0) for k in (0.0, 1.0))
    shortest = Shortest().after(a_move(1e-3), one).after(a_move(1e-9, undamped=False), other)
    assert shortest == (1e-3, one, 0)
    assert shortest.after(a_move(1e-3), other) == (1e-3, one, 1)
    assert shortest.after(a_move(9e-4), other) == (9e-4, other, 0)


def test_a_step_is_accepted_where_the_cost_falls_or_an_undamped_fall_is_hidden():
    fine, spoilt = (Point(np.zeros(1), Normal(1.0, np.full(1, slope), np.eye(1)), 1.0) for slope in (0.0, math.nan))
    assert acceptable(a_move(1.0, undamped=False, hidden=False), fine, 1e-9)
    assert not acceptable(a_move(1.0, undamped=False), fine, -1e-9)
    assert acceptable(a_move(1.0), fine, -1e-9)
    assert not acceptable(a_move(1.0), spoilt, -1e-9)
    assert not acceptable(a_move(1.0, hidden=False), fine, -1e-9)


def test_the_undamped_step_is_tried_where_it_is_short_and_none_was_rejected():
    problem = Matrix(np.eye(2), np.array([1e-2, 1e-3]), np.zeros(2), np.full(2, 1e3))
    here = Point(problem.x0, problem.normal(problem.x0), problem.cost(problem.x0))
    move = next_move(problem, here, Damping(1e12), None, None)
    assert move.undamped
    np.testing.assert_allclose(move.step.x, [1e-2, 1e-3], rtol=1e-5)
    damped = next_move(problem, here, Damping(1e12).rejected(), None, None)
    assert not damped.undamped
    assert damped.length < 1e-3 * move.length
    far = Matrix(np.eye(2), np.array([1e2, 1e-3]), np.zeros(2), np.full(2, 1e3))
    there = Point(far.x0, far.normal(far.x0), far.cost(far.x0))
    assert not next_move(far, there, Damping(1e12), None, None).undamped  # short for its damping alone


@pytest.mark.parametrize("method", [lm, sckf_lm])
def test_gauges_are_left_alone_whatever_their_number(method):
    """Three directions that nothing holds, one of them hidden in a badly scaled column."""
    rng = np.random.default_rng(2)
    a = rng.normal(size=(40, 6))
    a[:, 3], a[:, 4], a[:, 5] = a[:, 0], 1e-6 * (a[:, 1] + a[:, 2]), 0.0
    truth = np.array([1.0, -2.0, 0.5, 0.0, 0.0, 0.0])
    problem = Matrix(a, a @ truth + 1e-3 * rng.normal(size=40), np.zeros(6), np.full(6, np.inf), np.ones(6))
    result = method(problem)
    best = np.linalg.lstsq(a, problem.b, rcond=None)[0]
    assert result.converged
    assert result.steps <= 6
    assert result.cost == pytest.approx(np.sum((a @ best - problem.b) ** 2) / 2, rel=1e-12)
    assert np.linalg.norm(result.x) == pytest.approx(np.linalg.norm(best), rel=1e-6)  # nothing was added along them
    assert result.x[5] == 0.0


# --- filters ---------------------------------------------------------------------------------------------------------


def curved(x):
    return float(np.sin(x[0]) + x[1] * x[2] + 0.3 * x[0] ** 2)


def test_the_square_root_step_equals_the_plain_cubature_filter():
    rng = np.random.default_rng(5)
    a = rng.normal(size=(3, 3))
    mean, covariance = rng.normal(size=3), a @ a.T + np.eye(3)
    belief = Belief(mean, np.linalg.cholesky(covariance))
    for measured in (0.4, -1.3, 2.0):
        belief = cubature_update(belief, lambda s: np.array([curved(x) for x in s]), measured, 0.3).belief
        mean, covariance = cubature_step(mean, covariance, curved, measured, 0.09)
        np.testing.assert_allclose(belief.mean, mean, atol=1e-12)
        np.testing.assert_allclose(belief.root @ belief.root.T, covariance, atol=1e-12)


def test_the_square_root_step_equals_filterpy():
    other = CubatureKalmanFilter(3, 1, 1.0, hx=lambda x: np.array([curved(x.ravel())]), fx=lambda x, dt: x)
    other.x, other.P, other.R, other.Q = (
        np.array([[0.1], [0.2], [0.3]]),
        np.diag([1.0, 0.5, 2.0]),
        0.25,
        np.zeros((3, 3)),
    )
    belief = Belief(np.array([0.1, 0.2, 0.3]), np.diag(np.sqrt([1.0, 0.5, 2.0])))
    for measured in (0.7, -0.2):
        other.predict()
        other.update(np.array([[measured]]))
        belief = cubature_update(belief, lambda s: np.array([curved(x) for x in s]), measured, 0.5).belief
    np.testing.assert_allclose(belief.mean, other.x.ravel(), atol=1e-10)
    np.testing.assert_allclose(belief.root @ belief.root.T, other.P, atol=1e-10)


def test_a_linear_step_equals_kalman_to_rounding():
    rng = np.random.default_rng(6)
    a, h = rng.normal(size=(4, 4)), rng.normal(size=4)
    p = a @ a.T + np.eye(4)
    x = rng.normal(size=4)
    gain = p @ h / (h @ p @ h + 0.04)
    expected_x, expected_p = x + gain * (1.5 - h @ x), p - np.outer(gain, h @ p)
    update = cubature_update(Belief(x, np.linalg.cholesky(p)), lambda s: s @ h, 1.5, 0.2)
    np.testing.assert_allclose(update.belief.mean, expected_x, atol=1e-12)
    np.testing.assert_allclose(update.belief.root @ update.belief.root.T, expected_p, atol=1e-12)
    assert update.innovation_std == pytest.approx(math.sqrt(h @ p @ h + 0.04))
    ekf_x, ekf_p, _ = linear_update(x, p, h, 1.5 - h @ x, 0.2)
    np.testing.assert_allclose(ekf_x, expected_x, atol=1e-12)
    np.testing.assert_allclose(ekf_p, expected_p, atol=1e-12)


def test_the_order_of_rows_does_not_matter_on_a_linear_problem():
    a, y, nominal, prior, noise = random_linear(10)
    order = np.random.default_rng(0).permutation(len(y))
    for method in (sckf, ekf):
        one = method(Matrix(a / noise, y / noise, nominal, prior))
        other = method(Matrix(a[order] / noise, y[order] / noise, nominal, prior))
        np.testing.assert_allclose(one.x, other.x, atol=1e-11)
        np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-11)


def test_drift_adds_its_covariance():
    belief = Belief(np.zeros(2), np.array([[1.0, 0.0], [0.4, 0.8]]))
    drifted = predict(belief, np.diag([0.3, 0.1]))
    np.testing.assert_allclose(drifted.root @ drifted.root.T, belief.root @ belief.root.T + np.diag([0.09, 0.01]))
    assert predict(belief, None) is belief


def test_filters_take_a_flat_prior_from_start_std_only():
    a, y, nominal, prior, noise = random_linear(11, rows=60)
    flat = prior.copy()
    flat[0] = np.inf
    start = np.where(np.isfinite(flat), flat, 1e4)
    problem = Matrix(a / noise, y / noise, nominal, flat, start)
    mean, _ = posterior(a / noise, y / noise, nominal, np.where(np.isfinite(flat), flat, 1e12))
    np.testing.assert_allclose(lm(problem).x, mean, atol=1e-9)
    np.testing.assert_allclose(sckf(problem).x, mean, atol=1e-6)


def test_jacobian_of_the_raw_circle_is_right():
    circle = Circle([1.0, 2.0])
    x = np.array([1.3, -0.7])
    np.testing.assert_allclose(circle.jacobian(x), central_difference(circle.residual, x, [1e-6] * 2), atol=1e-8)


def test_levenberg_marquardt_needs_at_most_six_evaluations_from_the_drawing(hsr):
    touches = simulate(hsr.problem, hsr.cell, samples=1000, seed=5).samples
    every = np.arange(1000)
    for rows in (every[::8], every, np.tile(every, 10)):
        bound = bind(hsr.problem, touches.take(rows))
        result = lm(bound)
        assert result.converged
        assert result.residual_rows <= 6 * bound.rows
        # what the last step leaves is far below what the data can tell
        left = lm(bound, start=result.x, tolerance=1e-12)
        shift = left.x - result.x
        assert np.sqrt(shift @ np.linalg.solve(left.covariance, shift)) < 1e-8


# --- never worse than the start --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "scale", "seed"), [("ur5", 100.0, 14), ("ur5", 100.0, 41), ("hsr_jr680", 100.0, 44)])
def test_the_papers_method_is_no_less_robust_than_lm_alone(name, scale, seed):
    """Errors a hundred times a robot's, where the filter's estimate alone leads to a minimum far above."""
    source = load_problem(ROOT / "problems" / name)
    bound = bind(
        source.problem, simulate(source.problem, dataclasses.replace(source.cell, error_scale=scale), seed=seed).samples
    )
    alone, both = lm(bound), sckf_lm(bound)
    filtered = lm(bound, start=sckf(bound).x)
    assert filtered.cost > 2 * alone.cost or not filtered.converged
    assert both.cost <= alone.cost * (1 + 1e-6)


@pytest.mark.long_unless("sckf")
@pytest.mark.parametrize("method", ["sckf", "ekf"])
def test_a_filter_that_ends_far_from_the_minimum_has_failed(hsr, method):
    """Dial readings in micrometres that were declared as millimetres: linearised, each row throws the belief about."""
    samples = hsr.problem.read(hsr.samples)
    wild = dataclasses.replace(samples, columns={**samples.columns, "reading": samples.columns["reading"] * 1e3})
    found = calibrate(hsr.problem, wild, method=method, reference=False, discrepancy="none")
    assert (
        found.result.cost
        > 100 * calibrate(hsr.problem, wild, method="lm", reference=False, discrepancy="none").result.cost
    )
    assert found.result.status in (Status.FAR, Status.WORSE, Status.NOT_FINITE)
    assert not found.passed
    fine = calibrate(hsr.problem, samples, method=method, reference=False)
    assert (fine.result.status, fine.passed) == (Status.ONE_PASS, True)


def test_what_ends_at_an_infinite_cost_has_failed(hsr):
    found = calibrate(hsr.problem, hsr.samples, method=lambda problem: problem.x0 + 1e200, reference=False)
    assert found.result.status is Status.NOT_FINITE
    assert not found.passed
    worse = calibrate(hsr.problem, hsr.samples, method=lambda problem: problem.x0 + problem.start_std, reference=False)
    assert worse.result.status is Status.WORSE
    assert not worse.passed
    drawn = calibrate(hsr.problem, hsr.samples, method=lambda problem: problem.x0, reference=False)
    assert drawn.result.status is Status.UNSAID


def test_the_reference_starts_from_what_it_finds_there_again(corner_bound):
    """Its scales come from an evaluation at the start, which is kept: scaled as all that follow."""
    objective = Objective(corner_bound.graph, corner_bound)
    start = np.zeros(corner_bound.graph.start.size)
    first = objective(start)
    objective(start + 1e-3)
    for kept, again in zip(first, objective(start), strict=True):
        np.testing.assert_allclose(kept, again, rtol=1e-12, atol=1e-12 * np.abs(again).max())

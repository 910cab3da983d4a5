"""An estimator's step stands in NumPy, in MX and in C: all forms find the same, and each is taken where it is said."""

import sys
from dataclasses import dataclass, fields
from functools import partial

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from linear import Matrix, Weighing, as_symbols, random_linear
from oracles import cubature_step
from test_kernels import BACKENDS, HAS_COMPILER, bounds

from casacal import DialOnPlane, Problem, Samples, TrackedPoint, bind, ekf, lm, sckf
from casacal.fit import BoundProblem
from casacal.fit import least_squares as objective
from casacal.fit.filters import Belief, cubature_update, linear_update
from casacal.fit.least_squares import Conditioned, LeastSquares
from casacal.kernels.filter_passes import Cubature
from casacal.kernels.native_rows import NativeNormal, PackedPieces

needs_compiler = pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler")
SIZES = ((1, 1), (2, 9), (5, 40), (27, 300), (5, 9_000))
SMALL = {f"{kind}, {n} unknowns, {rows} rows": (kind, n, rows) for kind in ("linear", "curved") for n, rows in SIZES}
ROBOTS = ("hsr", "scara", "two instruments", "many rows")
EQUAL, EQUAL_ON_ROBOTS = 1e-11, 1e-9
"""Relative. A robot's residuals are known to ten digits of their noise: metres beside hundredths of a millimetre."""


@dataclass(frozen=True)
class Bending(Weighing):
    """Reads y = sum (t_i + sin(t_i) / 4) + b_1 b_n / 20, t_i = a_i b_i: rows that bend within a prior."""

    def residual(self, pose, p, row):
        terms = [getattr(row, f"a{i + 1}") * p.b[i] for i in range(self.b.size)]
        return sum(t + ca.sin(t) / 4 for t in terms) + p.b[0] * p.b[self.b.size - 1] / 20 - row.y


LONG = ("curved, 5 unknowns, 9000 rows", "many rows")  # long passes go in parts: of such, the linear ones are quick


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=[pytest.mark.long] * (name in LONG)) for name in (*SMALL, *ROBOTS)]
)
def case(request):
    """What binds a problem on a back end, and how equal steps must be: one piece and several, one pattern and several,
    one residual per row and three."""
    if request.param in ROBOTS:
        problem, samples = robot(request.param)
        return lambda backend: bind(problem, *samples, backend=backend), EQUAL_ON_ROBOTS
    kind, n, rows = SMALL[request.param]
    linear = as_symbols(*random_linear(n, rows, n))
    problem = linear.problem
    if kind == "curved":
        weighing = problem.instruments[0]
        problem = Problem(problem.robot, Bending(weighing.b, weighing.noise_std))
    return lambda backend: bind(problem, *linear.samples, backend=backend), EQUAL


def robot(name):
    made, rng = bounds(), np.random.default_rng(0)
    if name in made:
        problem, samples, _ = made[name]
        return problem, (samples,)
    problem, samples, _ = made["hsr"]
    if name == "many rows":
        return problem, (samples.take(rng.integers(len(samples), size=8_500)),)
    joints = rng.uniform(-60, 60, size=(12, 6))
    pair = Problem(problem.robot, *problem.instruments, TrackedPoint(noise_std=0.05))
    tracked = pd.DataFrame(joints, columns=[f"q{i}_deg" for i in range(1, 7)])
    bound = bind(problem, samples)
    shift = np.array([1000.0, 0.0, -300.0])
    tracked[["x_mm", "y_mm", "z_mm"]] = bound.tips(0.5 * bound.start_std, np.radians(joints)) + shift
    return pair, (samples, Samples.from_frame(tracked, pair.layout(1)))


def cubature_in_numpy(problem):
    """Belief (mean, root) after all rows, and the trace by row: mean, innovation, its standard deviation."""
    n, trace = problem.unknowns, []
    belief = Belief(np.zeros(n), np.eye(n))
    for k in range(problem.rows):
        seen = partial(problem.row, k)
        update = cubature_update(belief, lambda s, seen=seen: seen(problem.x0 + problem.start_std * s), 0.0, 1.0)
        belief = update.belief
        trace.append((belief.mean, update.innovation, update.innovation_std))
    return belief.mean, belief.root, [np.array(each) for each in zip(*trace, strict=True)]


def cubature_by_passes(problem):
    """The same by the passes of C or MX, one an instrument."""
    mean, root, k, trace = np.zeros(problem.unknowns), np.eye(problem.unknowns), 0, []
    while k < problem.rows:
        done = problem.filter_pass(k, mean, root)
        assert done.stop > k
        mean, root, k = done.mean, done.root, done.stop
        trace.append((done.means, done.innovations, done.stds))
    return mean, root, [np.concatenate(each) for each in zip(*trace, strict=True)]


def extended_in_numpy(problem):
    """Belief (mean, covariance) after all rows, and the trace by row."""
    n, scale, trace = problem.unknowns, problem.start_std, []
    mean, covariance = np.zeros(n), np.eye(n)
    for k in range(problem.rows):
        predicted, gradient = problem.row_jacobian(k, problem.x0 + scale * mean)
        mean, covariance, std = linear_update(mean, covariance, scale * gradient, -predicted, 1.0)
        trace.append((mean, -predicted, std))
    return mean, covariance, [np.array(each) for each in zip(*trace, strict=True)]


def assert_equal_passes(one, other, equal):
    """Beliefs in units of the prior; innovations in units of their own standard deviation."""
    (mean, spread, (means, innovations, stds)), (mean2, spread2, (means2, innovations2, stds2)) = one, other
    np.testing.assert_allclose(mean, mean2, rtol=0, atol=equal * max(1, np.abs(mean2).max()))
    np.testing.assert_allclose(spread, spread2, rtol=0, atol=equal)
    np.testing.assert_allclose(means, means2, rtol=0, atol=equal * np.abs(means2).max())
    np.testing.assert_allclose(stds, stds2, rtol=10 * equal)
    np.testing.assert_allclose(innovations / stds2, innovations2 / stds2, rtol=0, atol=10 * equal)


@pytest.mark.parametrize("backend", BACKENDS)
def test_cubature_steps_are_equal(case, backend):
    bound, equal = case[0](backend), case[1]
    assert_equal_passes(cubature_by_passes(bound), cubature_in_numpy(bound), equal)


@needs_compiler
def test_extended_steps_are_equal(case):
    bound, equal = case[0]("c"), case[1]
    done = bound.extended_pass(np.zeros(bound.unknowns), np.eye(bound.unknowns))
    one = (done.mean, done.covariance, (done.means, done.innovations, done.stds))
    assert_equal_passes(one, extended_in_numpy(bound), equal)
    assert (np.linalg.eigvalsh(done.covariance) > 0).all()


@needs_compiler
@pytest.mark.parametrize("damping", [1e-3, 1.0, 1e3])
def test_damped_steps_are_equal(case, damping):
    """In the metric of the objective: what it hardly sees is known to few digits in either form."""
    bound = case[0]("c")
    x = 0.3 * bound.start_std * np.random.default_rng(0).normal(size=bound.unknowns)
    normal, scale = bound.normal(x), bound.start_std
    one, other = bound.damped_step(x, normal, damping), LeastSquares.damped_step(bound, x, normal, damping)
    whole = scale[:, None] * (normal.information + bound.prior_information) * scale
    apart, step = (one.x - other.x) / scale, (other.x - x) / scale
    assert np.sqrt(apart @ whole @ apart) <= 1e-10 * np.sqrt(step @ whole @ step)
    assert one.squared_length == pytest.approx(other.squared_length, rel=1e-11)
    assert one.predicted == pytest.approx(other.predicted, rel=1e-11)


@pytest.mark.parametrize("backend", BACKENDS)
def test_all_filters_take_the_step_of_the_plain_filter_on_linear_rows(backend):
    """Where rows are linear, the cubature filter on full covariances, which shares no code, is the extended one too."""
    a, y, nominal, prior, noise = random_linear(3, 40, 5)
    problem = bind(as_symbols(a, y, nominal, prior, noise).problem, *as_symbols(a, y, nominal, prior, noise).samples,
                   backend=backend)  # fmt: skip
    mean, covariance = nominal, np.diag(prior**2)
    for row, measured in zip(a, y, strict=True):
        mean, covariance = cubature_step(mean, covariance, lambda x, row=row: row @ x, measured, noise**2)
    for method in (sckf, ekf):
        result = method(problem)
        np.testing.assert_allclose(result.x + nominal, mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(result.covariance, covariance, rtol=0, atol=1e-13)


@pytest.mark.long_unless("hsr-c")
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["hsr", "scara"])
def test_the_downdate_in_passes_is_the_triangularisation(name, backend, monkeypatch):
    problem, samples = robot(name)
    one = sckf(bind(problem, *samples, backend=backend))
    monkeypatch.setattr(BoundProblem, "filter_pass", LeastSquares.filter_pass)
    monkeypatch.setattr(sys.modules["casacal.fit.filters"], "downdated", lambda root, u: None)  # QR in every row
    other = sckf(bind(problem, *samples, backend=backend))
    scale = one.problem.start_std
    np.testing.assert_allclose(one.x / scale, other.x / scale, rtol=0, atol=1e-10)
    np.testing.assert_allclose(one.covariance / np.outer(scale, scale), other.covariance / np.outer(scale, scale),
                               rtol=0, atol=1e-10)  # fmt: skip
    assert one.residual_rows == other.residual_rows == 2 * one.problem.unknowns * one.problem.rows


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_fused_filter_hands_over_the_rows_that_would_lose_digits(hsr, backend, monkeypatch):
    rows = hsr.problem.read(hsr.samples)
    expected = sckf(bind(hsr.problem, rows, backend=backend))
    # as if much more of a variance had to remain: the first rows of each face then need the full triangularisation
    monkeypatch.setattr("casacal.kernels.filter_passes.LEAST_LEFT", 0.2)
    bound = bind(hsr.problem, rows, backend=backend)
    assert bound.filter_pass(0, np.zeros(bound.unknowns), np.eye(bound.unknowns)).stop < bound.rows
    mixed = sckf(bound)
    np.testing.assert_allclose(mixed.x / bound.start_std, expected.x / bound.start_std, rtol=0, atol=1e-10)
    assert len(mixed.trace["innovation"]) == bound.rows


def test_a_measurement_that_tells_all_is_triangularised_in_full():
    belief = Belief(np.zeros(3), np.eye(3))
    update = cubature_update(belief, lambda s: s @ np.array([1.0, 2.0, 3.0]), 1.0, 1e-9)
    root = update.belief.root
    assert (np.diagonal(root) >= 0).all()
    np.testing.assert_allclose(np.array([1.0, 2.0, 3.0]) @ root, 0, atol=1e-8)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_damped_step_solves_the_system_of_the_whole_objective(hsr, backend):
    bound = bind(hsr.problem, hsr.problem.read(hsr.samples), backend=backend)
    x = 0.3 * bound.start_std * np.random.default_rng(0).normal(size=bound.unknowns)
    jacobian, r = bound.jacobian(x), bound.residual(x)
    stacked = np.vstack([jacobian, np.sqrt(bound.prior_information)]) * bound.start_std
    residual = np.concatenate([r, np.sqrt(bound.prior_information) @ (x - bound.x0)])
    for damping in (1e-3, 10.0):
        damped = np.vstack([stacked, np.sqrt(damping) * np.eye(bound.unknowns)])
        y = np.linalg.lstsq(damped, -np.concatenate([residual, np.zeros(bound.unknowns)]), rcond=None)[0]
        step = bound.damped_step(x, bound.normal(x), damping)
        np.testing.assert_allclose((step.x - x) / bound.start_std, y, rtol=1e-6, atol=1e-9)
        assert step.squared_length == pytest.approx(np.sum((stacked @ y) ** 2), rel=1e-6)
        fall = (residual @ residual - np.sum((residual + stacked @ y) ** 2)) / 2
        assert step.predicted == pytest.approx(fall, rel=1e-6)


@needs_compiler
def test_a_step_in_c_is_numpys_and_says_when_there_is_none(hsr):
    bound = bind(hsr.problem, hsr.problem.read(hsr.samples), backend="c")
    normal = bound.normal(bound.x0)
    one, other = bound.damped_step(bound.x0, normal, 0.1), LeastSquares.damped_step(bound, bound.x0, normal, 0.1)
    np.testing.assert_allclose(one.x / bound.start_std, other.x / bound.start_std, rtol=0, atol=1e-9)
    for spoilt in (-normal.information, normal.information * np.nan):
        assert bound.damped_step(bound.x0, type(normal)(0.0, normal.gradient, spoilt), 0.1) is None


# --- who takes a step ------------------------------------------------------------------------------------------------


class Unprintable(DialOnPlane):
    """An instrument whose residual has no form in C."""

    def residual(self, pose, p, row):
        return super().residual(pose, p, row) + 1e-3 * ca.erfinv(1e-4 * pose[0, 3])


@pytest.fixture
def taken(monkeypatch):
    """Names of the forms whose steps were taken."""
    seen = set()

    def watch(owner, name, form):
        original = getattr(owner, name)

        def watched(*args, **kwargs):
            seen.add(form)
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, watched)

    module = sys.modules
    watch(Cubature, "_by_c", "cubature in C")
    watch(Cubature, "_by_blocks", "cubature in MX")
    watch(module["casacal.fit.filters"], "cubature_update", "cubature in NumPy")
    watch(PackedPieces, "extended_pass", "extended in C")
    watch(module["casacal.fit.filters"], "linear_update", "extended in NumPy")
    watch(NativeNormal, "step", "damped in C")
    watch(objective, "damped_solution", "damped in NumPy")
    return seen


def all_three(problem):
    for method in (sckf, ekf, lm):
        assert method(problem).converged


IN_NUMPY = {"cubature in NumPy", "extended in NumPy", "damped in NumPy"}


@needs_compiler
def test_where_c_evaluates_rows_it_takes_all_steps(corner_bound, taken):
    all_three(bind(corner_bound.problem, *corner_bound.samples, backend="c"))
    assert taken == {"cubature in C", "extended in C", "damped in C"}


def test_without_c_mx_takes_the_cubature_filters_step_and_numpy_the_others(corner_bound, taken):
    all_three(bind(corner_bound.problem, *corner_bound.samples, backend="blocks"))
    assert taken == {"cubature in MX", "extended in NumPy", "damped in NumPy"}


@needs_compiler
def test_one_instrument_without_c_leaves_the_others_their_cubature_steps(hsr, taken):
    dial, samples = hsr.problem.instruments[0], hsr.problem.read(hsr.samples)
    other = Unprintable(**{field.name: getattr(dial, field.name) for field in fields(dial) if field.init})
    all_three(bind(Problem(hsr.problem.robot, dial, other), samples, samples.take(np.arange(40))))
    assert taken == {"cubature in C", "cubature in MX", "extended in NumPy", "damped in NumPy"}


def test_numpy_takes_every_step_of_what_is_not_bound(corner_bound, taken):
    a, y, nominal, prior, noise = random_linear(7)
    all_three(Matrix(a / noise, y / noise, nominal, prior))
    assert taken == IN_NUMPY
    taken.clear()
    all_three(Conditioned(corner_bound, corner_bound.datum, corner_bound.x0))
    assert taken == IN_NUMPY


def test_numpy_takes_the_cubature_steps_of_parameters_that_drift(corner_bound, taken):
    sckf(corner_bound, process_std=1e-3 * corner_bound.start_std)
    assert taken == {"cubature in NumPy"}

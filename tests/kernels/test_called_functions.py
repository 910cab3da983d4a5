"""Poses and residuals that call a rootfinder, a table or a callback, evaluated by CasADi."""

import casadi as ca
import numpy as np
import pytest

from casacal import Joint, Parameter, Problem, Robot, TrackedPoint, bind, calibrate, ekf, ipopt, lm, sckf, simulate
from casacal.errors import ProblemError
from casacal.kernels import native_rows
from casacal.model.kinematics import chain, rotate_z, translate


def arm(function, limit=1.5):
    """Two links; the second is turned by a function of the second joint value and a parameter."""

    def pose(p, q):
        turned = rotate_z(function(q[1], p.bend))
        return chain(rotate_z(q[0]), translate(p.link[0], 0, 0), turned, translate(p.link[1], 0, 50 * ca.cos(q[1])))

    joints = [Joint("revolute", -1.5, 1.5), Joint("revolute", -limit, limit)]
    links = Parameter((400.0, 300.0), unit="mm", prior_std=0.5)
    robot = Robot("linkage", joints, pose, {"link": links, "bend": Parameter(0.3, unit="rad", prior_std=0.01)})
    return Problem(robot, TrackedPoint(noise_std=0.05))


def explicit(angle, bend):
    """The one real root of x^3 + 3 x = 4 angle + bend, by Cardano."""
    half = (4 * angle + bend) / 2
    return ca.sinh(ca.asinh(half) / 3) * 2


def _rootfinder():
    x, a = ca.SX.sym("x"), ca.SX.sym("a", 2)
    g = ca.Function("g", [x, a], [x**3 + 3 * x - 4 * a[0] - a[1]])
    found = ca.rootfinder("found", "newton", g, {"abstol": 1e-13})
    return lambda angle, bend: found(0.0, ca.vertcat(angle, bend))


class Cardano(ca.Callback):
    """The root in Python, with a derivative of its own."""

    def __init__(self):
        super().__init__()
        self.construct("cardano", {})

    def eval(self, arguments):
        return [2 * np.sinh(np.arcsinh(float(arguments[0]) / 2) / 3)]

    def has_jacobian(self, *_):
        return True

    def get_jacobian(self, name, inputs, outputs, options):
        x, y = ca.MX.sym("x"), ca.MX.sym("y")
        return ca.Function(name, [x, y], [1 / (3 * y**2 + 3)], inputs, outputs, options)


def _callback():
    found = Cardano()
    return lambda angle, bend: found(4 * angle + bend)


def _table():
    at = np.linspace(-9, 9, 400)
    table = ca.interpolant("table", "bspline", [at], 2 * np.sinh(np.arcsinh(at / 2) / 3))
    return lambda angle, bend: table(4 * angle + bend)


@pytest.fixture(scope="module")
def written_out():
    """The problem without calls, its samples and its minimum."""
    problem = arm(explicit)
    rows = simulate(problem, samples=40, seed=2).samples
    return problem, rows, lm(bind(problem, rows))


@pytest.mark.parametrize(("make", "off"), [(_rootfinder, 1e-9), (_callback, 1e-9), (_table, 1e-3)])
def test_whatever_asks_for_rows_has_what_it_has_of_the_root_written_out(make, off, written_out):
    _, rows, wanted = written_out
    problem = arm(make())
    bound, other = bind(problem, rows), wanted.problem
    assert (bound.backend, bound.unknowns) == ("blocks", other.unknowns)
    x = 0.5 * other.start_std * np.random.default_rng(0).normal(size=other.unknowns)
    scale = np.abs(other.jacobian(x)).max(axis=0)
    np.testing.assert_allclose(bound.residual(x), other.residual(x), atol=300 * off)
    np.testing.assert_allclose(bound.jacobian(x) / scale, other.jacobian(x) / scale, atol=10 * off)
    one, two = bound.normal(x), other.normal(x)
    assert one.cost == pytest.approx(two.cost, rel=off)
    np.testing.assert_allclose(
        one.information / np.outer(scale, scale), two.information / np.outer(scale, scale), atol=off * 99
    )
    np.testing.assert_allclose(bound.costs(np.array([x, -x])), other.costs(np.array([x, -x])), rtol=off)
    fit, reference = lm(bound), ipopt(bound)
    assert fit.cost == pytest.approx(wanted.cost, rel=off)
    assert reference.converged
    assert reference.cost == pytest.approx(fit.cost, rel=1e-9)
    for method in (sckf, ekf):
        assert method(bound).cost == pytest.approx(method(other).cost, rel=off)


def test_the_hessian_that_the_reference_asks_for_is_exact(written_out):
    _, rows, _ = written_out
    one, two = (bind(arm(f), rows).graph for f in (_rootfinder(), explicit))
    v = two.start + 1e-3 * np.random.default_rng(1).normal(size=two.start.size)
    for found, expected in zip(one.blocks[0](v), two.blocks[0](v), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def test_a_calibration_is_the_one_of_the_root_written_out_and_says_what_evaluated_it(written_out, caplog):
    problem, rows, _ = written_out
    native_rows._notice.cache_clear()
    with caplog.at_level("WARNING", logger="casacal"):
        found, wanted = calibrate(arm(_rootfinder()), rows), calibrate(problem, rows)
    assert sum("rootfinder, a table or a Callback, which CasADi evaluates" in text for text in caplog.messages) == 1
    assert found.verdict.level == wanted.verdict.level == "calibrated"
    assert found.tip_std == pytest.approx(wanted.tip_std, rel=1e-6)
    assert found.reference.cost == pytest.approx(found.result.cost, rel=1e-9)


def test_rows_by_the_thousand_are_evaluated_too(written_out):
    problem, *_ = written_out
    models = [each.models[0] for each in (problem, arm(_rootfinder()))]
    data = np.random.default_rng(0).uniform(-1, 1, (5000, models[0].pose.numel_in(2)))
    z, c = np.full(models[0].pose.numel_in(0), 1e-3), np.zeros(models[0].pose.numel_in(1))
    one, two = (model.columnwise("tip")(z, c, data) for model in models)
    np.testing.assert_allclose(one, two, atol=1e-9)


def test_no_kernel_is_made_of_a_call_and_one_that_fails_is_said(written_out):
    _, rows, _ = written_out
    with pytest.raises(ProblemError, match="The back end c cannot be used: the model calls a rootfinder"):
        bind(arm(_rootfinder()), rows, backend="c")
    x, a = ca.SX.sym("x"), ca.SX.sym("a")
    half = ca.rootfinder("half", "newton", ca.Function("g", [x, a], [x**2 + 0.1 * x - a]))
    with pytest.raises(ProblemError, match=r"such as a rootfinder, failed: rootfinder process failed\. Narrow"):
        simulate(arm(lambda angle, bend: half(1.1, angle + bend)), samples=10)

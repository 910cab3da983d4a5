"""All rows as CasADi expressions: one's own program finds what lm and ipopt find, and steps are those of estimators."""

import dataclasses
import shutil
import subprocess
from functools import partial

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from test_symbols import hsr_row, tracked, tracked_row, ur5_row

from casacal import DialOnPlane, Problem, Samples, TrackedPoint, bind, huber, ipopt, lm, load_problem
from casacal.errors import ProblemError
from casacal.fit import SymbolicProblem
from casacal.fit.filters import Belief, cubature_update
from casacal.fit.least_squares import LeastSquares
from casacal.study.trial import Metered

IPOPT = ("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
SILENT = {"print_header": False, "print_iteration": False, "print_status": False, "print_time": False}
SQP = {"qpsol": "qrqp", "qpsol_options": {"print_iter": False, "print_header": False, "print_info": False}, **SILENT}


def shipped(name):
    source = load_problem(ROOT / "problems" / name)
    return bind(source.problem, source.problem.read(source.samples))


def followed():
    """The HSR seen by a tracker in 40 poses, with errors of one standard deviation of the prior."""
    rng, problem = np.random.default_rng(1), tracked()
    joints = rng.uniform(-60, 60, size=(40, 6))
    frame = pd.DataFrame(joints, columns=[f"q{i}_deg" for i in range(1, 7)])
    touching = bind(Problem(problem.robot, DialOnPlane(noise_std=0.01)), shipped("hsr_jr680").samples[0])
    errors = np.where(touching.datum, 0.0, touching.start_std) * rng.normal(size=touching.unknowns)
    tips = touching.tips(errors, np.radians(joints)) + rng.normal(scale=0.05, size=(40, 3))
    frame[["x_mm", "y_mm", "z_mm"]] = tips @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]).T + [900.0, -200.0, 50.0]
    # joints that do not repeat give the three coordinates of a row different noises
    joints = [dataclasses.replace(joint, repeatability_std=3e-5) for joint in problem.robot.axes]
    robot = dataclasses.replace(problem.robot, joints=joints)
    problem = Problem(robot, TrackedPoint(noise_std=0.05)).with_prior({"tool": 5.0})
    return bind(problem, Samples.from_frame(frame, problem.layout(0)))


def both():
    """A dial and a tracker together."""
    touching, seen = shipped("hsr_jr680"), followed()
    pair = Problem(seen.problem.robot, DialOnPlane(noise_std=0.02), TrackedPoint(noise_std=0.05))
    return bind(pair.with_prior({"instrument2.tool": 5.0}), touching.samples[0], seen.samples[0])


BOUND = {"hsr": partial(shipped, "hsr_jr680"), "ur5": partial(shipped, "ur5"), "tracked": followed, "both": both}


@pytest.fixture(scope="module", params=BOUND)
def bound(request):
    return BOUND[request.param]()


@pytest.fixture(scope="module")
def ur5():
    return shipped("ur5")


def some_x(bound, seed=0, part=0.3):
    return part * bound.start_std * np.random.default_rng(seed).normal(size=bound.unknowns)


def solved(bound, objective, *constraints):
    """Cost and x of one's own program by IPOPT, in scaled unknowns."""
    opti, symbolic = ca.Opti(), bound.symbolic
    y = opti.variable(bound.unknowns)
    x = symbolic.x0 + symbolic.start_std * y
    opti.minimize(objective(x))
    for constraint in constraints:
        opti.subject_to(constraint(x))
    opti.solver(*IPOPT)
    solution = opti.solve()
    return solution.value(opti.f), solution.value(x)


def array(matrix):
    return np.array(matrix).squeeze()


# --- expressions -----------------------------------------------------------------------------------------------------


def test_residuals_equal_those_of_the_kernels_for_every_kind_of_expression(bound):
    symbolic, x = bound.symbolic, some_x(bound)
    assert isinstance(symbolic, SymbolicProblem)
    expected = bound.residual(x)
    np.testing.assert_allclose(array(symbolic.residual(x)), expected, rtol=1e-9, atol=1e-8)
    for kind in (ca.SX, ca.MX):
        symbol = kind.sym("x", bound.unknowns)
        found = ca.Function("f", [symbol], [symbolic.residual(symbol), symbolic.objective(symbol)])(x)
        np.testing.assert_allclose(array(found[0]), expected, rtol=1e-9, atol=1e-8)
        assert float(found[1]) == pytest.approx(bound.cost(x), rel=1e-12)
    assert float(symbolic.prior(x)) == pytest.approx(bound.prior_cost(x), rel=1e-12)
    assert (symbolic.names, symbolic.units) == (bound.names, bound.units)


def test_data_are_parameters_for_ones_own_solver(bound):
    """Other readings and noise as numbers in p, against rows that were bound anew with them."""
    rows, x, p = bound.symbolic, some_x(bound), bound.symbolic.data.copy()
    np.testing.assert_allclose(array(rows.residual(x, p)), bound.residual(x), rtol=1e-9, atol=1e-8)
    rng, sets = np.random.default_rng(4), []
    for i, samples in enumerate(bound.samples):
        columns = {name: each + rng.normal(size=len(samples)) for name, each in samples.columns.items()}
        joints = samples.joints + 1e-3 * rng.normal(size=samples.joints.shape)
        p[rows.data_index("joints", i)] = joints
        for name, each in columns.items():
            p[rows.data_index(name, i)] = each
        sets.append(dataclasses.replace(samples, joints=joints, columns=columns))
    expected = bound.on(*sets).plain_residual(x)
    noise = np.concatenate([p[rows.data_index("noise", i)].ravel() for i in range(len(sets))])
    np.testing.assert_allclose(array(rows.residual(x, p)) * noise, expected, rtol=1e-9, atol=1e-9)
    p[rows.data_index("noise")] *= 2
    assert float(rows.objective(x, p)) == pytest.approx(
        float(ca.sumsqr(rows.residual(x, p))) / 2 + bound.prior_cost(x), rel=1e-12
    )


def test_one_solver_serves_every_session(ur5):
    """`nlpsol(p=...)`, made once: with the readings of another session it finds what lm finds there."""
    rows = ur5.symbolic
    y, p = ca.MX.sym("y", ur5.unknowns), ca.MX.sym("p", rows.data.size)
    program = {"x": y, "p": p, "f": rows.objective(rows.x0 + rows.start_std * y, p)}
    solver = ca.nlpsol("own", "ipopt", program, {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}})
    moved = ur5.samples[0].columns["reading"] + 0.01 * np.random.default_rng(2).normal(size=ur5.rows)
    other = ur5.on(dataclasses.replace(ur5.samples[0], columns={"reading": moved}))
    data = rows.data.copy()
    data[rows.data_index("reading")] = moved
    for bound, given in ((ur5, rows.data), (other, data)):
        assert float(solver(x0=0, p=given)["f"]) == pytest.approx(lm(bound).cost, rel=1e-9)


def test_data_that_do_not_exist_are_named(ur5):
    with pytest.raises(ProblemError, match=r"no 'readings' of instrument 1\. Known: joints, noise, reading"):
        ur5.symbolic.data_index("readings")
    with pytest.raises(ProblemError, match="no 'noise' of instrument 2"):
        ur5.symbolic.data_index("noise", 1)
    with pytest.raises(ProblemError, match="p has the shape"):
        ur5.symbolic.objective(ur5.x0, np.zeros(3))


@pytest.mark.parametrize(("name", "by_hand"), [("hsr", hsr_row), ("ur5", ur5_row), ("tracked", tracked_row)])
def test_residuals_equal_the_arm_by_hand(name, by_hand):
    bound = BOUND[name]()
    x, found = some_x(bound), []
    found = array(bound.symbolic.residual(x)).reshape(len(bound.samples[0]), -1)
    for kind in bound.symbolic.kinds:
        for i, d, w in zip(kind.samples, kind.data, kind.noise, strict=True):
            expected = by_hand(x[kind.columns], kind.constants, d)[2] / w
            np.testing.assert_allclose(found[i], expected, rtol=0, atol=1e-7)


def test_the_coordinates_of_a_row_differ_in_noise():
    (kind,) = followed().symbolic.kinds
    assert (np.ptp(kind.noise, axis=1) > 0.002).mean() > 0.5


def test_kinds_say_which_rows_see_what(ur5):
    kinds = ur5.symbolic.kinds
    assert sum(len(kind.samples) for kind in kinds) == len(ur5.samples[0])
    labels = np.array(list(ur5.samples[0].labels["plane"]))
    for kind in kinds:
        (label,) = set(labels[kind.samples])
        assert f"plane.{'floor' if label == 'block' else label}" in kind.unknowns
        assert sum(name.startswith("plane") for name in kind.unknowns) == 1
    assert "120 residuals" in repr(ur5.symbolic)


def test_values_are_those_of_the_unknowns(ur5):
    x = some_x(ur5)
    found = ur5.symbolic.values(x)
    a = array(found["a"])
    assert a[1] == pytest.approx(-425 + x[ur5.symbolic.index("a2")], rel=1e-14)
    symbol = ca.MX.sym("x", ur5.unknowns)
    values = ur5.symbolic.values(symbol)
    normal = array(ca.Function("n", [symbol], [values["plane.floor"].normal])(x))
    assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-12)
    for slot in ur5.slots:
        if slot.name == "plane.floor":
            u = x[slot.first : slot.first + 2]
            s = (u @ u) / 4
            n = slot.nominal
            np.testing.assert_allclose(normal, ((1 - s) * n[:3] + u[0] * n[3:6] + u[1] * n[6:9]) / (1 + s), atol=1e-14)
    with pytest.raises(ProblemError, match="no unknown 'a9'"):
        ur5.symbolic.index("a9")
    with pytest.raises(ProblemError, match="Got a str as the kind of row"):
        ur5.symbolic.cubature_step("dial")


def test_another_size_is_refused(ur5):
    for x in (np.zeros(3), ca.MX.sym("x", 5), ca.SX.sym("x", 1, ur5.unknowns)):
        with pytest.raises(ProblemError, match="must be a column of 37 unknowns"):
            ur5.symbolic.objective(x)


# --- one's own program -----------------------------------------------------------------------------------------------


def by_sqp(bound):
    """Cost and x by sqpmethod with the Hessian of Gauss-Newton, from the symbolic normal equations."""
    symbolic, n = bound.symbolic, bound.unknowns
    y, weight, scale = ca.MX.sym("y", n), ca.MX.sym("lam_f"), ca.DM(bound.start_std)
    x = symbolic.x0 + scale * y
    hessian = weight * (scale @ scale.T * symbolic.normal(x)[2] + scale @ scale.T * ca.DM(bound.prior_information))
    inputs = [y, ca.MX.sym("p", 0, 1), weight, ca.MX.sym("lam_g", 0, 1)]
    bend = ca.Function("nlp_hess_l", inputs, [hessian], ["x", "p", "lam_f", "lam_g"], ["hess_gamma_x_x"])
    solver = ca.nlpsol("own", "sqpmethod", {"x": y, "f": symbolic.objective(x)}, {**SQP, "hess_lag": bend})
    found = solver(x0=0)
    assert solver.stats()["success"]
    return float(found["f"]), array(symbolic.x0 + scale * found["x"])


@pytest.mark.parametrize("how", ["ipopt in Opti", "sqpmethod"])
def test_ones_own_program_finds_the_minimum_of_lm_and_ipopt(bound, how):
    result, reference = lm(bound), ipopt(bound)
    cost, x = by_sqp(bound) if how == "sqpmethod" else solved(bound, bound.symbolic.objective)
    assert cost == pytest.approx(result.cost, rel=1e-8)
    assert cost == pytest.approx(reference.cost, rel=1e-8)
    assert np.abs((x - result.x) / result.std).max() < 1e-3


def test_a_robust_loss_of_ones_own_is_that_of_lm(hsr):
    samples = hsr.problem.read(hsr.samples)
    readings = samples.columns["reading"].copy()
    readings[::17] += 1.0
    spoilt = {f"q{i + 1}_rad": samples.joints[:, i] for i in range(6)}
    frame = pd.DataFrame(spoilt | {"reading_mm": readings, "plane": list(samples.labels["plane"])})
    bound = bind(hsr.problem, Samples.from_frame(frame, hsr.problem.layout(0)))
    loss = huber()
    result = lm(bound, loss=loss)

    def rho(r):
        size = ca.fabs(r)
        return ca.if_else(size <= 1.345, r**2 / 2, 1.345 * (size - 1.345 / 2))

    symbolic = bound.symbolic
    cost, x = solved(bound, lambda x: ca.sum1(rho(symbolic.residual(x))) + symbolic.prior(x))
    expected = float(loss.cost(bound.residual(result.x)).sum()) + bound.prior_cost(result.x)
    assert cost == pytest.approx(expected, rel=1e-8)
    assert np.abs((x - result.x) / result.std).max() < 1e-3
    assert result.cost == pytest.approx(expected, rel=1e-12)
    assert np.abs((lm(bound).x - x) / result.std).max() > 1  # it matters


def test_a_constraint_of_ones_own_is_met_at_the_minimum_on_it(ur5):
    """Against a closed form of the linear algebra: the constrained step of Gauss-Newton, by its KKT system."""
    symbolic, i, j = ur5.symbolic, ur5.symbolic.index("a2"), ur5.symbolic.index("a3")
    row = np.eye(ur5.unknowns)[i] - np.eye(ur5.unknowns)[j]
    wanted = float(row @ lm(ur5).x) + 0.2

    cost, x = solved(ur5, symbolic.objective, lambda x: x[i] - x[j] == wanted)
    assert x[i] - x[j] == pytest.approx(wanted, abs=1e-9)
    best, s = lm(ur5).x.copy(), ur5.start_std
    for _ in range(8):
        normal = ur5.normal(best)
        h = s[:, None] * (normal.information + ur5.prior_information) * s
        g = s * (normal.gradient + ur5.prior_information @ (best - ur5.x0))
        system = np.block([[h, (row * s)[:, None]], [(row * s)[None], np.zeros((1, 1))]])
        best = best + s * np.linalg.solve(system, np.concatenate([-g, [wanted - row @ best]]))[:-1]
    assert cost == pytest.approx(ur5.cost(best), rel=1e-8)
    assert cost > lm(ur5).cost


def test_the_seam_carries_the_symbols(ur5):
    metered = Metered(ur5)
    assert metered.symbolic is ur5.symbolic
    assert metered.used_graph
    assert LeastSquares.symbolic is None


# --- steps -----------------------------------------------------------------------------------------------------------


def test_normal_equations_are_those_of_the_kernels_and_of_the_jacobian(bound):
    x = some_x(bound)
    cost, gradient, information = bound.symbolic.normal(x)
    normal, jacobian, r = bound.normal(x), bound.jacobian(x), bound.residual(x)
    scale = np.sqrt(np.diagonal(normal.information))
    scale[scale < 1e-9 * scale.max()] = scale.max()  # what no row sees
    assert float(cost) == pytest.approx(normal.cost, rel=1e-11)
    for g, h in ((normal.gradient, normal.information), (jacobian.T @ r, jacobian.T @ jacobian)):
        np.testing.assert_allclose(array(gradient) / scale, g / scale, rtol=0, atol=1e-9 * np.linalg.norm(r))
        np.testing.assert_allclose(array(information) / np.outer(scale, scale), h / np.outer(scale, scale), atol=1e-11)


@pytest.mark.parametrize("mu", [1e-3, 10.0])
def test_the_damped_step_is_that_of_the_estimator(bound, mu):
    x = some_x(bound)
    expected = LeastSquares.damped_step(bound, x, bound.normal(x), mu).x
    found = array(bound.symbolic.damped_step(x, mu))
    normal, s = bound.normal(x), bound.start_std
    whole = s[:, None] * (normal.information + bound.prior_information) * s
    apart, step = (found - expected) / s, (expected - x) / s
    assert np.sqrt(apart @ whole @ apart) <= 1e-9 * np.sqrt(step @ whole @ step)


def test_damped_steps_in_a_loop_are_levenberg_marquardt(ur5):
    x = ur5.x0
    for _ in range(30):
        x = ur5.symbolic.damped_step(x, 1e-9)
    assert float(ur5.symbolic.objective(x)) == pytest.approx(lm(ur5).cost, rel=1e-10)


def test_the_filters_step_is_that_of_the_estimator(bound):
    """All rows in their order, a kind's function at a time, against the step in NumPy."""
    n, symbolic = bound.unknowns, bound.symbolic
    belief, mean, root = Belief(np.zeros(n), np.eye(n)), np.zeros(n), np.eye(n)
    steps = [symbolic.cubature_step(kind) for kind in symbolic.kinds]
    where = sorted((kind.first + s * kind.noise.shape[1], k, i) for k, kind in enumerate(symbolic.kinds)
                   for i, s in enumerate(kind.samples))  # fmt: skip
    for first, k, i in where[:: max(len(where) // 40, 1)]:
        kind = symbolic.kinds[k]
        for component in range(kind.noise.shape[1]):
            seen = partial(bound.row, first + component)
            h = lambda s, seen=seen: seen(bound.x0 + bound.start_std * s)  # noqa: E731
            belief = cubature_update(belief, h, 0.0, 1.0).belief
        mean, root = (np.array(each) for each in steps[k](mean, root, kind.data[i], kind.noise[i]))
    np.testing.assert_allclose(mean.ravel(), belief.mean, rtol=0, atol=1e-8 * max(1, np.abs(belief.mean).max()))
    np.testing.assert_allclose(root, belief.root, rtol=0, atol=1e-8)
    assert np.diagonal(root).min() < 0.1  # it learnt something


# --- size and C ------------------------------------------------------------------------------------------------------


def test_ten_thousand_rows_are_mapped_not_written_out(ur5):
    rows = np.random.default_rng(0).integers(len(ur5.samples[0]), size=10_000)
    many = bind(ur5.problem, ur5.samples[0].take(rows))
    x, symbol = some_x(many), ca.MX.sym("x", many.unknowns)
    objective = ca.Function("f", [symbol], [many.symbolic.objective(symbol)])
    assert float(objective(x)) == pytest.approx(many.cost(x), rel=1e-11)
    assert many.symbolic.cost_function.n_instructions() < 1_000
    gradient = ca.Function("g", [symbol], [ca.gradient(many.symbolic.objective(symbol), symbol)])
    expected = many.normal(x).gradient + many.prior_information @ x
    np.testing.assert_allclose(array(gradient(x)) * many.start_std, expected * many.start_std,
                               rtol=0, atol=1e-10 * np.abs(expected * many.start_std).max())  # fmt: skip
    np.testing.assert_allclose(array(many.symbolic.residual(x)), many.residual(x), rtol=1e-8, atol=1e-7)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("name", ["damped_step", "cubature_step"])
def test_steps_become_c(ur5, tmp_path, name, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ur5.on(ur5.samples[0].take(np.arange(0, 120, 7)))
    kind = small.symbolic.kinds[0]
    n = small.unknowns
    step = small.symbolic.damped_step if name == "damped_step" else small.symbolic.cubature_step(kind)
    inputs = (some_x(small), 0.1) if name == "damped_step" else (np.zeros(n), np.eye(n), kind.data[0], kind.noise[0])
    step.generate("step.c")
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", "step.c", "-o", "step.so", "-lm"], check=True)
    external = ca.external(name, "./step.so")
    for found, expected in zip(external.call(list(inputs)), step.call(list(inputs)), strict=True):
        np.testing.assert_allclose(np.array(found), np.array(expected), rtol=1e-6, atol=1e-9)

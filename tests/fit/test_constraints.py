"""Constraints: every estimator against KKT systems written out here, and against IPOPT in raw coordinates."""

import itertools
import pickle

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from linear import Weighing, random_linear

from casacal import Parameter, Problem, Robot, bind, calibrate, ekf, ipopt, lm, load_problem, sckf, sckf_lm, swarm
from casacal.calibration.inputs import estimate
from casacal.data.samples import Samples
from casacal.errors import CasacalError, ProblemError
from casacal.fit import LeastSquares, scipy_least_squares
from casacal.fit.least_squares import Conditioned, Status
from casacal.fit.methods import method_of
from casacal.kernels.losses import huber
from casacal.linalg import constrained_solution, nearest, null_basis
from casacal.model import between, certified, equal
from casacal.model.kinematics import translate_z
from casacal.uncertainty.figures import effective_unknowns, leverages
from casacal.uncertainty.identifiability import identifiability

INF = float("inf")


def weighing(seed, *known):
    """(A, y, nominal, prior std, noise), and their problem with constraints w'b in low ... high on values b."""
    a, y, nominal, prior, noise = random_linear(seed)
    made = []
    for k, (w, low, high) in enumerate(known):
        made.append(between(f"c{k}", lambda p, w=w: ca.dot(ca.DM(w), p.b), low, high))
    robot = Robot("slide", "P", lambda p, q: translate_z(q[0]), {})
    instrument = Weighing(Parameter(tuple(nominal), prior_std=tuple(prior)), noise)
    problem = Problem(robot, instrument, constraints=made)
    frame = pd.DataFrame(a, columns=[f"a{i + 1}" for i in range(a.shape[1])]).assign(y=y, q1_mm=0.0)
    return (a, y, nominal, prior, noise), bind(problem, Samples.from_frame(frame, problem.layout()))


def by_enumeration(a, y, nominal, prior, noise, known):
    """Deviations, covariance and multipliers: the KKT system of every set of active ends, the one whose signs fit."""
    hessian = a.T @ a / noise**2 + np.diag(1 / prior**2)
    pull = a.T @ (y - a @ nominal) / noise**2
    rows = np.array([w for w, _, _ in known])
    low, high = (np.array([k[i] for k in known]) - rows @ nominal for i in (1, 2))
    sides = [(0,) if k[1] == k[2] else (None, *(i for i in (0, 1) if np.isfinite(k[1 + i]))) for k in known]
    for chosen in itertools.product(*sides):
        held = [k for k, side in enumerate(chosen) if side is not None]
        ends = np.array([(low, high)[chosen[k]][k] for k in held])
        m, n = len(held), len(nominal)
        kkt = np.block([[hessian, rows[held].T], [rows[held], np.zeros((m, m))]])
        found = np.linalg.solve(kkt, np.concatenate([pull, ends]))
        x, pulls = found[:n], np.zeros(len(known))
        pulls[held] = found[n:]
        fits = ((rows @ x >= low - 1e-9) & (rows @ x <= high + 1e-9)).all()
        signs = all(low[k] == high[k] or (pulls[k] > 0) == bool(chosen[k]) for k in held)
        if fits and signs:
            return x, np.linalg.inv(kkt)[:n, :n], pulls
    raise AssertionError("no set of ends fits")


TIE, SUM, ONE = (1.0, -1.0, 0, 0, 0), (0, 0.5, 1.0, 1.0, 0), (0, 0, 0, 0, 1.0)
LINEAR = {
    "a tie": [(TIE, 0.0, 0.0)],
    "two ties": [(TIE, 0.2, 0.2), (SUM, -0.3, -0.3)],
    "a bound from above": [(ONE, -INF, -3.0)],
    "a bound from below": [(ONE, 3.0, INF)],
    "a tie and bounds": [(TIE, 0.1, 0.1), (SUM, 2.0, 2.5), (ONE, -0.1, 0.1)],
    "bounds that do not bind": [(SUM, -50.0, 50.0)],
}


@pytest.mark.parametrize("case", LINEAR)
@pytest.mark.parametrize("seed", [1, 2])
def test_on_linear_problems_all_estimators_find_what_the_kkt_system_says(case, seed):
    data, bound = weighing(seed, *LINEAR[case])
    x, covariance, pulls = by_enumeration(*data, LINEAR[case])
    best = lm(bound)
    assert best.status is Status.CONVERGED
    for method in (lm, sckf, sckf_lm, ekf, ipopt):
        found = method(bound)
        loose = 1e-6 if method is ipopt else 1e-9  # an inner point of IPOPT's stays as far from its bounds
        np.testing.assert_allclose(found.x, x, atol=loose, err_msg=method.__name__)
        assert found.cost == pytest.approx(best.cost, rel=1e-9), method
        np.testing.assert_allclose(found.covariance, covariance, atol=1e-9, err_msg=method.__name__)
        named = np.array([found.multipliers[f"c{k}"] for k in range(len(pulls))])
        np.testing.assert_allclose(named, pulls, rtol=1e-6, atol=1e-6, err_msg=method.__name__)
        bounds = [k for k, pull in enumerate(pulls) if pull and LINEAR[case][k][1] != LINEAR[case][k][2]]
        assert found.active == tuple(f"c{k}" for k in bounds), method
    assert best.kkt < 1e-6


@pytest.fixture(scope="module")
def ur5():
    source = load_problem(ROOT / "problems" / "ur5")
    return source.problem, source.problem.read(source.samples)


def tied(ur5, *constraints):
    problem, samples = ur5
    return bind(Problem(problem.robot, *problem.instruments, constraints=constraints), samples)


def links(p):
    return p.a[1] - p.a[2]


BENT = {
    "twins": (equal("twins", links, value=-32.6),),
    "lengths and an angle": (equal("mix", lambda p: p.a[1] + p.d[3] + 100 * p.theta[2], value=-315.7),),
    "a bent tie": (equal("ring", lambda p: (p.a[1] ** 2 + p.a[2] ** 2) / 1000, value=334.8),),
    "the tilt of a face": (equal("level", lambda p: p["plane.floor"].normal[0], value=0.001, unit="1"),),
    "a bound": (between("base", lambda p: p.d[0], high=89.0),),
    "a bent bound and another": (
        between("elbow", lambda p: p.a[2], -392.0, -391.95),
        between("product", lambda p: p.d[3] * p.a[1] / 100, high=-463.7),
    ),
    "all of it": (
        equal("twins", links, value=-32.6),
        equal("ring", lambda p: (p.d[3] ** 2 + p.d[4] ** 2) / 100, value=210.0),
        between("tool", lambda p: ca.norm_2(p.tool), high=119.6),
    ),
}


@pytest.mark.parametrize("case", BENT)
def test_on_an_arm_lm_and_ipopt_agree_and_the_filters_come_near(ur5, case):
    bound = tied(ur5, *BENT[case])
    best, reference = lm(bound), ipopt(bound)
    assert best.converged
    assert reference.converged
    assert best.cost == pytest.approx(reference.cost, rel=1e-9)
    assert best.multipliers.keys() == {each.name for each in BENT[case]}
    assert any(abs(pull) > 1e-3 for pull in best.multipliers.values()), "nothing binds, and the case shows nothing"
    for name, pull in best.multipliers.items():
        assert pull == pytest.approx(reference.multipliers[name], rel=1e-6, abs=1e-6), name
    assert best.kkt < 1e-4
    assert sckf_lm(bound).cost == pytest.approx(best.cost, rel=1e-9)
    for method in (sckf, ekf):
        found = method(bound)
        assert (bound.constraints.slack(found.x) > -1e-7).all(), method
        assert found.cost < 1.1 * best.cost, method
        assert found.active == best.active


def test_the_covariance_is_that_of_the_tangent(ur5):
    bound = tied(ur5, *BENT["all of it"])
    found = lm(bound)
    assert found.active == ("tool",)
    steps = 1e-5 * bound.start_std
    slopes = np.empty((3, bound.unknowns))
    for j, step in enumerate(steps):
        ends = [bound.constraints.evaluate(found.x + s * step * np.eye(bound.unknowns)[j])[0] for s in (1, -1)]
        slopes[:, j] = (ends[0] - ends[1]) / (2 * step)
    hessian = bound.jacobian(found.x).T @ bound.jacobian(found.x) + bound.prior_information
    scale = 1 / np.sqrt(np.diagonal(hessian))
    free = np.linalg.svd(slopes * scale)[2][3:].T * scale[:, None]
    wanted = free @ np.linalg.solve(free.T @ hessian @ free, free.T)
    np.testing.assert_allclose(found.covariance / np.outer(scale, scale), wanted / np.outer(scale, scale), atol=1e-4)


def test_what_nothing_holds_stays_unbounded_apart_from_what_a_tie_settles(ur5):
    """Two lengths with flat priors: tied to each other both are lost, tied to a third that has a prior neither is."""
    problem, samples = ur5
    flat = problem.with_prior({"d1": INF, "a6": INF})
    for known, lost in (
        ([equal("t", lambda p: p.d[0] - p.a[5], value=89.159)], {"d1", "a6"}),
        ([equal("t", lambda p: p.d[0] - p.a[1], value=514.159)], {"a6"}),
        ([equal("t", lambda p: p.d[0], value=89.159), between("u", lambda p: p.a[5], 0.0)], set()),
    ):
        bound = bind(Problem(flat.robot, *flat.instruments, constraints=known), samples)
        covariance = bound.posterior(0 * bound.prior_information, bound.x0)
        found = {name for name, value in zip(bound.names, np.diagonal(covariance), strict=True) if value == INF}
        assert {name for name in found if not name.startswith("plane")} == lost


def test_figures_count_what_a_tie_settles_as_none(ur5):
    free, bound = tied(ur5), tied(ur5, *BENT["twins"])
    one, two = lm(free), lm(bound)
    told = effective_unknowns(free, one.x) - effective_unknowns(bound, two.x)
    assert 0.3 < told < 1.7
    assert leverages(bound, two).sum() == pytest.approx(effective_unknowns(bound, two.x), rel=1e-9)
    joints = np.random.default_rng(0).uniform(-1, 1, (50, 6))
    ranks = [identifiability(b, b.tip_jacobian(b.x0, joints), b.tips(b.x0, joints)) for b in (free, bound)]
    assert (ranks[0].unknowns, ranks[1].unknowns) == (free.unknowns, free.unknowns - 1)
    assert ranks[0].rank + len(ranks[0].null) == free.unknowns
    assert ranks[1].rank + len(ranks[1].null) == free.unknowns - 1
    for direction in (*ranks[1].null, *ranks[1].weak):  # each keeps the tie
        change = dict(zip(bound.names, direction.direction * bound.start_std, strict=True))
        assert abs(change["a2"] - change["a3"]) < 1e-6


def test_a_part_of_the_unknowns_keeps_the_constraints_that_it_can_move(ur5):
    bound = tied(ur5, *BENT["twins"])
    assert Conditioned(bound, bound.datum, bound.x0).constraints is None
    at = bound.feasible(bound.x0)
    part = Conditioned(bound, np.array([name != "a3" for name in bound.names]), at)
    found = lm(part)
    assert found.x[part.names.index("a2")] == pytest.approx(at[bound.names.index("a2")], abs=1e-9)


def test_with_a_robust_loss_too(ur5):
    bound = tied(ur5, *BENT["a bent tie"])
    found, reference = lm(bound, loss=huber()), ipopt(bound, loss=huber())
    assert found.converged
    assert found.cost == pytest.approx(reference.cost, rel=1e-9)


def test_a_start_far_off_is_brought_back(ur5):
    bound = tied(ur5, *BENT["all of it"])
    far = bound.x0 + 5 * bound.start_std * np.random.default_rng(1).normal(size=bound.unknowns)
    assert lm(bound, start=far).cost == pytest.approx(lm(bound).cost, rel=1e-9)


@pytest.mark.parametrize("case", ["a bent tie", "all of it"])
def test_every_step_ends_within_the_constraints(ur5, case):
    """Straight ahead it would leave them: the objective is a merit only where both ends of a step meet them."""
    bound = tied(ur5, *BENT[case])
    far = bound.x0 + 3 * bound.start_std * np.random.default_rng(2).normal(size=bound.unknowns)
    here = bound.feasible(far)
    step = bound.constrained_step(here, bound.normal(here), 1e-3)
    assert step.finite
    assert np.linalg.norm((step.x - here) / bound.start_std) > 1
    assert (bound.constraints.slack(step.x) > -1e-11).all()


def test_numerical_steps_against_hand_made_ones():
    w, held = nearest(np.array([[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]]), np.array([-1.0, 2.0, 0.5]))
    np.testing.assert_allclose(w, [0.0, 1.0], atol=1e-12)
    assert held.tolist() == [False, True, False]
    assert nearest(np.array([[1.0], [-1.0]]), np.array([1.0, 1.0])) is None
    basis, rank = null_basis(np.array([[1.0, -1.0, 0.0], [2.0, -2.0, 0.0]]), np.ones(3))
    assert rank == 1
    np.testing.assert_allclose(np.array([1.0, -1.0, 0.0]) @ basis, 0.0, atol=1e-12)
    rows, none = np.array([[2.0, 0.0], [0.0, 1.0]]), np.zeros((0, 2))
    step = constrained_solution(
        rows, np.array([-4.0, -1.0]), 0.0, np.array([[1.0, 1.0]]), np.ones(1), none, np.zeros(0)
    )
    np.testing.assert_allclose(step, [4 / 5, 1 / 5], atol=1e-12)  # 4 s1 - 4 = s2 - 1, s1 + s2 = 1


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: equal("t", lambda p: p.a), "not one number"),
        (lambda: equal("t", lambda p: [p.a[0]]), "not one number"),
        (lambda: equal("t", lambda p: 3.0), "not one number"),
        (lambda: equal("t", lambda p: p.a[0] * 0), "depends on no unknown"),
        (lambda: equal("t", lambda p: p.b[0]), "no unknown named 'b'"),
        (lambda: equal("t", lambda p: p["dial.tool"]), "no unknown named 'dial.tool'"),
        (lambda: equal("t", lambda p: p.plane.normal[0]), r"one 'plane' for each plane.*plane\.LABEL"),
        (lambda: equal("t", lambda p: 1 / 0 * p.a[0]), "ZeroDivisionError"),
        (lambda: equal("t", lambda p: p.a[0] - ca.SX.sym("mine")), "no part of p"),
        (lambda: equal("t", 3.0), "Got a float as the expression"),
        (lambda: equal("", links), "is named ''"),
        (lambda: equal("t", links, value=float("nan")), "Give numbers"),
        (lambda: between("t", links, 2.0, 1.0), "the lower end first"),
        (lambda: between("t", links), "one end finite at least"),
        (lambda: between("t", links, INF, INF), "one end finite at least"),
        (lambda: equal("t", links, unit="um"), "'t' has the unit 'um'. Build it in mm or rad"),
        (lambda: between("t", links, 0.0, unit="deg"), "the unit 'deg'"),
        (lambda: links, "Got a function as a constraint"),
    ],
)
def test_what_is_no_constraint_is_refused_where_the_problem_is_made(ur5, make, said):
    with pytest.raises(CasacalError, match=said):
        Problem(ur5[0].robot, *ur5[0].instruments, constraints=[make()])


def test_what_is_certified_beyond_rounding_is_refused(ur5):
    problem, samples = ur5
    made = Problem(problem.robot, *problem.instruments, constraints=[certified("links", links, -32.35, std=1e-9)])
    with pytest.raises(ProblemError, match=r"'links' is certified to 1e-09, below a millionth .* equal\(\)"):
        bind(made, samples)


def test_names_are_told_apart_and_a_list_is_asked_for(ur5):
    for wrong, said in (([equal("t", links)] * 2, "Two constraints are called 't'"), (equal("t", links), "in a tuple")):
        with pytest.raises(ProblemError, match=said):
            Problem(ur5[0].robot, *ur5[0].instruments, constraints=wrong)


@pytest.mark.parametrize(
    ("constraints", "said"),
    [
        ([equal("one", links), equal("two", links, value=1.0)], "No values.*'one', 'two'"),
        ([equal("one", links), between("low", links, 2.0)], "No values.*'one', 'low'"),
        ([equal("one", lambda p: p.a[1] ** 2 + 1)], "No values.*'one'"),
        ([equal("one", links), equal("two", lambda p: 2 * links(p))], "'one' and 'two' say the same"),
        ([equal("one", lambda p: p["plane.roof"].normal[0])], "'plane.roof', which no samples are of.*plane.floor"),
    ],
)
def test_what_cannot_be_met_is_refused_by_name_where_rows_are_bound(ur5, constraints, said):
    with pytest.raises(ProblemError, match=said):
        tied(ur5, *constraints)


def test_a_constraint_on_what_is_held_is_met_or_refused(ur5):
    problem, samples = ur5
    for value, met in ((-32.75, True), (-32.0, False)):
        made = Problem(problem.robot, *problem.instruments, constraints=[equal("twins", links, value=value)]).fix("a")
        if met:
            assert lm(bind(made, samples)).cost == pytest.approx(lm(bind(problem.fix("a"), samples)).cost, rel=1e-9)
        else:
            with pytest.raises(
                ProblemError, match=r"'twins' is -32\.75 of unknowns that are held, and is to be -32\. Free"
            ):
                bind(made, samples)


def test_methods_that_cannot_keep_them_say_so(ur5):
    bound = tied(ur5, *BENT["twins"])
    for method in (swarm, scipy_least_squares):
        with pytest.raises(ProblemError, match=r"Use .*lm"):
            method(bound)


def test_a_problem_with_constraints_is_a_value(ur5):
    made = Problem(ur5[0].robot, *ur5[0].instruments, constraints=BENT["all of it"])
    again = pickle.loads(pickle.dumps(made))
    assert again == made
    assert again.digest == made.digest
    other = Problem(ur5[0].robot, *ur5[0].instruments, constraints=BENT["twins"])
    assert other != made
    assert len({made.digest, other.digest, ur5[0].digest}) == 3
    kept = made.with_prior({"a": 0.5}).fix("d6").with_settings({"noise_std": 0.02})
    assert kept.constraints == made.constraints
    fresh = pickle.loads(pickle.dumps(bind(made, ur5[1])))
    assert lm(fresh).cost == lm(bind(made, ur5[1])).cost


def test_a_calibration_says_which_bound_binds_and_its_files_hold_it(ur5, tmp_path):
    problem, samples = ur5
    known = equal("twins", links, value=-32.35), between("base", lambda p: p.d[0], high=89.158)
    made = Problem(problem.robot, *problem.instruments, constraints=known)
    found, plain = calibrate(made, samples), calibrate(problem, samples)
    assert plain.verdict.level == "calibrated"
    assert found.verdict.level == "use with care"
    assert "'base' (89.158 mm)" in found.verdict.words
    assert found.reference.agrees
    assert found.tip_std[0] < plain.tip_std[0]
    document = found.to_dict()
    tie, base = document["constraints"]
    assert (tie["name"], tie["low"], tie["active"]) == ("twins", -32.35, False)
    assert tie["value"] == pytest.approx(-32.35, abs=1e-9)
    assert base["active"]
    assert base["low"] == -INF or base["low"] is None
    assert base["multiplier"] > 0
    assert "constraints" not in plain.to_dict()
    from casacal.deployment.as_data import problem_data, problem_from

    assert problem_from(problem_data(made)) == made
    loose = calibrate(Problem(problem.robot, *problem.instruments, constraints=known[:1]), samples)
    assert "twins" not in loose.verdict.words


def test_a_result_that_keeps_a_tie_is_no_prior_and_says_so(ur5):
    problem, samples = ur5
    made = Problem(problem.robot, *problem.instruments, constraints=[equal("twins", links, value=-32.35)])
    first = calibrate(made, samples, reference=False)
    with pytest.raises(CasacalError, match="keeps constraints exactly is no prior"):
        calibrate(problem, samples.take(np.arange(40)), prior=first)


def test_a_fit_is_not_worse_than_a_drawing_that_misses_the_tie(ur5):
    """The drawing may cost less than any arm that keeps a tie: that says nothing against the fit."""
    problem, samples = ur5
    held = problem.fix("plane", *(key for key in problem.robot.parameters if key != "a"), "tool")
    made = Problem(held.robot, *held.instruments, constraints=[equal("twins", links, value=-34.5)])
    found = estimate(method_of("lm"), "lm", bind(made, samples), 0, None, None)
    assert found.cost > bind(made, samples).cost(found.problem.x0)
    assert found.converged


class Shifted(LeastSquares):
    """The rows of a bound problem about another truth, with noise of their own."""

    def __init__(self, bound, truth, noise):
        self.bound, self.offset = bound, bound.residual(truth) - noise
        for name in ("names", "units", "x0", "prior_std", "start_std", "datum", "constraints"):
            setattr(self, name, getattr(bound, name))

    rows = property(lambda self: self.bound.rows)

    def residual(self, x):
        return self.bound.residual(x) - self.offset

    def jacobian(self, x):
        return self.bound.jacobian(x)

    def row(self, k, states):
        return self.bound.row(k, states) - self.offset[k]

    def row_jacobian(self, k, x):
        r, slope = self.bound.row_jacobian(k, x)
        return r - self.offset[k], slope


@pytest.mark.long
@pytest.mark.parametrize("method", [lm, sckf_lm])
def test_intervals_under_a_binding_tie_cover_the_truth(ur5, method):
    """300 arms drawn from the prior and the tie; 95 % intervals of the tip, per axis, over postures that no row had."""
    bound, rng = tied(ur5, equal("twins", links, value=-32.0)), np.random.default_rng(7)
    std = np.where(np.isfinite(bound.prior_std), bound.prior_std, 1e-3)
    w = np.array([{"a2": 1.0, "a3": -1.0}.get(name, 0.0) for name in bound.names])
    gain = std**2 * w / (w @ (std**2 * w))  # a2 - a3 is 0.75 mm more than drawn
    joints = rng.uniform(-2, 2, (20, 6))
    inside = total = 0
    for _ in range(300):
        drawn = std * rng.normal(size=bound.unknowns)
        truth = drawn + gain * (0.75 - w @ drawn)
        found = method(Shifted(bound, truth, rng.normal(size=bound.rows)))
        assert abs(w @ found.x - 0.75) < 1e-9
        off = (bound.tips(found.x, joints) - bound.tips(truth, joints)).ravel()
        slopes = bound.tip_jacobian(found.x, joints)
        spread = np.sqrt(np.einsum("ij,jk,ik->i", slopes, found.covariance, slopes))
        inside, total = inside + int((np.abs(off) < 1.96 * spread).sum()), total + off.size
    assert 0.93 < inside / total < 0.97

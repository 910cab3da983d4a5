"""Priors that belong together, stated with the problem: against dense algebra written out here, and IPOPT."""

import pickle

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from linear import Weighing, random_linear

from casacal import Parameter, Problem, Robot, bind, calibrate, ekf, ipopt, lm, load_problem, sckf, sckf_lm
from casacal.data.samples import Samples
from casacal.deployment.as_data import problem_data, problem_from
from casacal.errors import CasacalError, ProblemError
from casacal.model import certified, equal
from casacal.model.kinematics import translate_z
from casacal.uncertainty.evidence import NormalEquations, _objective

TOGETHER = {("b1", "b3"): [[0.5, -0.3], [-0.3, 0.4]], ("b4", "b2", "b5"): np.diag([1.0, 2.0, 3.0]) + 0.4}
SUM = certified("sum", lambda p: p.b[0] + 2 * p.b[1], 1.7, std=0.05)
DIFFERENCE = certified("difference", lambda p: p.b[4] - p.b[1], -0.4, std=0.2)


def weighing(seed, covariance=None, constraints=(), fixed=()):
    a, y, nominal, prior, noise = random_linear(seed)
    robot = Robot("slide", "P", lambda p, q: translate_z(q[0]), {})
    instrument = Weighing(Parameter(tuple(nominal), prior_std=tuple(prior)), noise)
    problem = Problem(robot, instrument, constraints=constraints).with_prior(covariance=covariance or {}).fix(*fixed)
    frame = pd.DataFrame(a, columns=[f"a{i + 1}" for i in range(a.shape[1])]).assign(y=y, q1_mm=0.0)
    return (a, y, nominal, prior, noise), bind(problem, Samples.from_frame(frame, problem.layout()))


def by_hand(a, y, nominal, prior, noise, covariance, rows):
    """Deviations, covariance and cost: all that is known as weighted rows of one dense system; a cost to compare."""
    whole = np.diag(prior**2)
    for names, matrix in (covariance or {}).items():
        places = [int(name[1:]) - 1 for name in names]
        whole[np.ix_(places, places)] = matrix
    information, toward = np.linalg.inv(whole), np.zeros(len(nominal))
    for w, value, std in rows:
        information = information + np.outer(w, w) / std**2
        toward = toward + np.array(w) * (value - w @ nominal) / std**2
    posterior = np.linalg.inv(information + a.T @ a / noise**2)
    x, mean = posterior @ (toward + a.T @ (y - a @ nominal) / noise**2), np.linalg.solve(information, toward)
    left = (y - a @ (nominal + x)) / noise
    return x, posterior, (left @ left + (x - mean) @ information @ (x - mean)) / 2, mean, np.linalg.inv(information)


ROWS = [(np.array([1.0, 2, 0, 0, 0]), 1.7, 0.05), (np.array([0.0, -1, 0, 0, 1]), -0.4, 0.2)]


@pytest.mark.parametrize(
    ("covariance", "constraints", "rows"),
    [
        (TOGETHER, (), []),
        (None, (SUM,), ROWS[:1]),
        (None, (SUM, DIFFERENCE), ROWS),
        (TOGETHER, (SUM, DIFFERENCE), ROWS),
    ],
)
def test_all_estimators_start_from_what_dense_algebra_says(covariance, constraints, rows):
    data, bound = weighing(5, covariance, constraints)
    x, posterior, cost, mean, prior = by_hand(*data, covariance, rows)
    for method in (lm, sckf, sckf_lm, ekf, ipopt):
        found = method(bound)
        np.testing.assert_allclose(found.x, x, atol=1e-10, err_msg=method.__name__)
        np.testing.assert_allclose(found.covariance, posterior, atol=1e-10, err_msg=method.__name__)
        assert found.cost == pytest.approx(cost, rel=1e-10), method
    places = [bound.names.index(name) for name in bound.known.names]
    np.testing.assert_allclose(bound.known.mean, mean[places], atol=1e-10)
    np.testing.assert_allclose(bound.prior_covariance, prior, atol=1e-10)


def test_a_tie_beside_them_holds_exactly():
    _, bound = weighing(5, TOGETHER, (SUM, equal("tie", lambda p: p.b[0] - p.b[3], value=0.1)))
    best = lm(bound)
    for method in (sckf, ekf, ipopt):
        np.testing.assert_allclose(method(bound).x, best.x, atol=1e-9)
    values = best.x + random_linear(5)[2]
    assert values[0] - values[3] == pytest.approx(0.1, abs=1e-12)


def test_an_unknown_that_is_held_leaves_the_others_their_own_errors():
    _, bound = weighing(5, TOGETHER, fixed=["b3"])
    assert bound.prior_std[bound.names.index("b1")] == pytest.approx(np.sqrt(0.5))
    np.testing.assert_allclose(lm(bound).x, ekf(bound).x, atol=1e-10)
    assert bound.names == ("b1", "b2", "b4", "b5")


def test_a_certificate_on_what_is_held_tells_of_the_other_alone():
    data, bound = weighing(5, None, (SUM,), fixed=["b2"])
    prior, nominal = data[3][0], data[2]
    gain = prior**2 / (prior**2 + 0.05**2)
    assert bound.x0[0] == pytest.approx(gain * (1.7 - nominal[0] - 2 * nominal[1]), abs=1e-12)


def test_a_standard_deviation_given_later_keeps_the_correlation():
    _, bound = weighing(5, TOGETHER)
    changed = bound.problem.with_prior({"b1": 2.0})
    known = bind(changed, *bound.samples).known
    k = [known.names.index(name) for name in ("b1", "b3")]
    own = known.covariance[np.ix_(k, k)]
    np.testing.assert_allclose(own, [[4.0, -0.3 * 2 / np.sqrt(0.5)], [-0.3 * 2 / np.sqrt(0.5), 0.4]], atol=1e-12)


@pytest.fixture(scope="module")
def ur5():
    source = load_problem(ROOT / "problems" / "ur5")
    return source.problem, source.problem.read(source.samples)


def test_a_calibration_with_a_certified_sum_and_its_reference_and_files(ur5):
    problem, samples = ur5
    sure = certified("arm", lambda p: p.a[1] + p.a[2], -816.53, std=0.02)
    made = Problem(problem.robot, *problem.instruments, constraints=[sure])
    made = made.with_prior(covariance={("d4", "d5"): [[0.5, 0.3], [0.3, 0.5]]})
    found, plain = calibrate(made, samples), calibrate(problem, samples)
    assert found.verdict.level == "calibrated"
    assert found.reference.agrees
    assert found.tip_std[0] < plain.tip_std[0]
    assert found.tip_std[1] <= plain.tip_std[1]
    a2, a3 = (found.fit.names.index(name) for name in ("a2", "a3"))
    before, after = (each[np.ix_([a2, a3], [a2, a3])] for each in (found.fit.prior_covariance, found.result.covariance))
    assert np.sqrt(before.sum()) == pytest.approx(0.02, rel=1e-3)
    assert np.sqrt(after.sum()) < 0.02
    document = found.to_dict()
    assert document["cost"] == pytest.approx(found.reference.cost, rel=1e-9)
    names = document.get("covariance_of") or found.fit.names
    held = np.array(document["covariance"])
    stds = {row["name"]: row["std"] for row in document["parameters"]}
    assert np.sqrt(held[names.index("a2"), names.index("a2")]) == pytest.approx(stds["a2"], rel=1e-9)
    assert found.effect_sizes
    again = problem_from(problem_data(made))
    assert again == made == pickle.loads(pickle.dumps(made))
    assert len({made.digest, problem.digest}) == 2


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda p: p.with_prior(covariance={("a2",): [[1.0]]}), "no covariance"),
        (lambda p: p.with_prior(covariance={"a2": [[1.0]]}), "no covariance"),
        (lambda p: p.with_prior(covariance={("a2", "a3"): [[1.0, 0.5], [0.4, 1.0]]}), "symmetric"),
        (lambda p: p.with_prior(covariance={("a2", "a3"): [[1.0, 1.0], [1.0, 1.0]]}), "positive eigenvalues"),
        (lambda p: p.with_prior(covariance={("a2", "a3"): np.eye(3)}), "a row for each name"),
        (lambda p: p.with_prior(covariance={("a2", "b3"): np.eye(2)}), "named 'b3'"),
        (lambda p: p.with_prior(covariance={("a", "d1"): np.eye(2)}), "named 'a'"),
        (
            lambda p: p.with_prior(covariance={("a2", "a3"): np.eye(2), ("a3", "d1"): np.eye(2)}),
            "'a3' is known together",
        ),
    ],
)
def test_what_is_no_covariance_is_refused(ur5, make, said):
    with pytest.raises(CasacalError, match=said):
        make(ur5[0])


@pytest.mark.parametrize(
    ("expression", "std", "prior", "said"),
    [
        (lambda p: p.a[1] ** 2, 0.1, {}, "not linear"),
        (lambda p: p.a[1] + p.a[2], 0.1, {"a2": np.inf}, "'a2'.*its prior is flat"),
        (lambda p: p.a[1] + p.a[2], -0.1, {}, "no negative error"),
        (lambda p: p.a[1] + p.a[2], np.nan, {}, "Give numbers"),
    ],
)
def test_what_cannot_be_certified_is_refused(ur5, expression, std, prior, said):
    def make():
        sure = certified("arm", expression, -817.25, std=std)
        return bind(Problem(ur5[0].robot, *ur5[0].instruments, constraints=[sure]).with_prior(prior), ur5[1])

    with pytest.raises(ProblemError, match=said):
        make()


def test_effect_sizes_count_a_joint_prior_as_it_is():
    """-2 log of the likelihood and its slopes: against determinants of the rows' whole covariance, and differences."""
    rng = np.random.default_rng(2)
    slopes, y = rng.normal(size=(12, 5)), rng.normal(size=12)
    root = rng.normal(size=(3, 3))
    prior = np.diag([0.0, 0.0, 0.0, 2.0, 3.0])
    prior[:3, :3] = root @ root.T + np.eye(3)
    diagonal, groups = np.diagonal(prior), [np.array([3, 4])]
    rest = (diagonal, prior - np.diag(diagonal), groups, np.zeros(2), np.ones(2))

    def value(logs):
        return _objective(np.array(logs), NormalEquations.of(slopes, y), 12, *rest)

    def by_rows(logs):
        whole = np.linalg.inv(prior) * np.exp(2 * logs[0] * (np.arange(5) > 2))
        rows = slopes @ whole @ slopes.T + np.exp(2 * logs[1]) * np.eye(12)
        wide = np.array([np.log(6.0) if logs[0] < 0 else 1.0, 1.0])
        return np.linalg.slogdet(rows)[1] + y @ np.linalg.solve(rows, y) + float(((np.array(logs) / wide) ** 2).sum())

    one, two = [0.3, 0.2], [0.8, -0.1]
    assert value(one)[0] - value(two)[0] == pytest.approx(by_rows(one) - by_rows(two), rel=1e-9)
    for k in range(2):
        step = 1e-5 * np.eye(2)[k]
        slope = (value(one + step)[0] - value(one - step)[0]) / 2e-5
        assert value(one)[1][k] == pytest.approx(slope, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("stds", "covariance", "words"),
    [
        ({"b1": 3.0}, TOGETHER, "'b1' has a standard deviation and a covariance. Give"),
        ({}, [("b1", "b2")], "Got a list as the covariance. Give a dict"),
        ({}, {("b1", "b2"): [["a", "b"], ["c", "d"]]}, "is no covariance"),
    ],
)
def test_what_is_given_twice_or_is_none_is_refused(stds, covariance, words):
    _, bound = weighing(0)
    with pytest.raises(ProblemError, match=words):
        bound.problem.with_prior(stds, covariance=covariance)

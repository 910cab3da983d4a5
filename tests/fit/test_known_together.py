"""Unknowns that are known together: a correlated prior, against one fit of all rows and against dense algebra."""

import pickle

import numpy as np
import pytest

from casacal import bind
from casacal.data.samples import joined
from casacal.effects import with_kit
from casacal.fit.arm_alone import ArmAlone
from casacal.fit.controls import scipy_least_squares
from casacal.fit.filters import ekf, sckf_lm
from casacal.fit.ipopt import ipopt
from casacal.fit.least_squares import Conditioned, Gaussian
from casacal.fit.lm import lm


@pytest.fixture(scope="module")
def problem(hsr):
    return hsr.problem


@pytest.fixture(scope="module")
def halves(hsr):
    rows = hsr.problem.read(hsr.samples)
    order = np.random.default_rng(4).permutation(len(rows))
    return rows.take(np.sort(order[: len(rows) // 2])), rows.take(np.sort(order[len(rows) // 2 :]))


def posterior(fit):
    return Gaussian(fit.problem.names, fit.x, fit.covariance)


@pytest.fixture(scope="module")
def second(problem, halves):
    """The second half of the rows, bound as the whole is, with what the first half told as the prior."""
    whole = bind(problem, *halves[:1])
    return whole.on(halves[1]).with_known(posterior(lm(whole)))


def test_what_one_half_told_and_the_other_half_are_one_fit_of_all(problem, halves, second):
    both = lm(bind(problem, halves[0]).on(joined(*halves)))
    found = lm(second)
    assert found.converged
    # the first half is kept as a Gaussian about its own minimum: what bends within it is all that may differ
    np.testing.assert_allclose((found.x - both.x) / both.std, 0.0, atol=4e-2)
    np.testing.assert_allclose(found.std, both.std, rtol=1e-2)


def test_all_estimators_find_the_same_minimum(second):
    best = lm(second)
    for method in (scipy_least_squares, sckf_lm, ipopt):
        found = method(second)
        assert found.converged
        assert found.cost == pytest.approx(best.cost, rel=1e-9), method
    filtered = ekf(second)
    assert np.abs((filtered.x - best.x) / best.std).max() < 0.5
    np.testing.assert_allclose(filtered.std, best.std, rtol=0.05)


def test_the_prior_is_that_of_the_dense_algebra(second):
    x = second.x0 + 0.3 * second.start_std * np.random.default_rng(0).normal(size=second.unknowns)
    away, known = x - second.x0, second.known
    told = np.linalg.solve(known.covariance, away)
    assert second.prior_cost(x) == pytest.approx(away @ told / 2, rel=1e-6)
    normal = second.normal(x)
    step = second.damped_step(x, normal, 1e-3)
    scale = np.diag(second.start_std)
    matrix = scale @ (normal.information + np.linalg.inv(known.covariance)) @ scale + 1e-3 * np.eye(x.size)
    expected = x - second.start_std * np.linalg.solve(matrix, scale @ (normal.gradient + told))
    np.testing.assert_allclose(step.x, expected, atol=1e-6 * second.start_std.max())
    symbolic = float(second.symbolic.prior(x))
    assert symbolic == pytest.approx(second.prior_cost(x), rel=1e-9)
    root = second.prior_root
    np.testing.assert_allclose(
        root @ root.T, known.covariance / np.outer(second.start_std, second.start_std), atol=1e-12
    )


def test_what_is_held_says_where_the_others_are_to_be_expected(second):
    """Minimising over some unknowns with the others held is minimising the whole objective there."""
    at = second.x0 + 2 * second.prior_std * np.random.default_rng(1).normal(size=second.unknowns)
    free = np.arange(second.unknowns) % 3 == 0
    part = Conditioned(second, free, at)
    found = lm(part)
    whole = part.expand(found.x)
    gradient = second.normal(whole).gradient + second.prior_information @ (whole - second.x0)
    assert np.abs((gradient * second.start_std)[free]).max() < 1e-4 * np.abs(gradient * second.start_std).max()


def test_what_is_taken_out_moves_freely(problem, halves):
    whole = bind(with_kit(problem), halves[0])
    first = lm(whole)
    second = whole.on(halves[1]).with_known(posterior(first))
    fit = lm(second)
    arm = ArmAlone(second, fit.x)
    kept = np.array([not key for key in second.beside])
    expected = fit.covariance[np.ix_(kept, kept)]
    told = np.linalg.inv(arm.information(fit.x[kept]) + arm.prior_information)
    np.testing.assert_allclose(told / np.sqrt(np.outer(np.diag(told), np.diag(told))), _scaled(expected), atol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(told)), np.sqrt(np.diag(expected)), rtol=1e-4)


def test_a_gaussian_is_conditioned_as_the_books_say():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(4, 4))
    known = Gaussian(("a", "b", "c", "d"), rng.normal(size=4), root @ root.T)
    draws = known.mean + rng.normal(size=(4, 400_000)).T @ root.T
    near = np.abs(draws[:, 1] - 0.3) < 0.02
    rest = known.given({"b": 0.3})
    assert rest.names == ("a", "c", "d")
    np.testing.assert_allclose(rest.mean, draws[near][:, [0, 2, 3]].mean(axis=0), atol=0.1)
    np.testing.assert_allclose(rest.covariance, np.cov(draws[near][:, [0, 2, 3]].T), rtol=0.1, atol=0.1)


def _scaled(covariance):
    stds = np.sqrt(np.diag(covariance))
    return covariance / np.outer(stds, stds)


def test_two_that_have_nothing_to_do_with_each_other_stand_beside_each_other():
    one = Gaussian(("a", "b"), np.array([1.0, 2.0]), np.array([[4.0, 1.0], [1.0, 9.0]]))
    two = Gaussian(("c",), np.array([3.0]), np.array([[0.25]]))
    both = one.beside(two)
    assert both.names == ("a", "b", "c")
    np.testing.assert_array_equal(both.mean, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(both.covariance, [[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 0.25]])
    assert both.of({"c", "a"}).names == ("a", "c")
    np.testing.assert_array_equal(both.of({"c", "a"}).covariance, [[4.0, 0.0], [0.0, 0.25]])


def test_what_is_known_together_is_part_of_a_bound_problem(second):
    """Compared, pickled, and taken along to other rows, other noise and other terms."""
    plain = second.on(*second.samples)
    assert plain == second
    again = pickle.loads(pickle.dumps(second))
    assert again == second
    x = second.x0 + second.start_std
    assert again.prior_cost(x) == second.prior_cost(x)
    other = second.with_known(Gaussian(second.names, second.x0 + 1e-3, second.known.covariance))
    assert other != second
    assert other.prior_cost(x) != second.prior_cost(x)
    for kept in (second.take(range(10)), second.with_noise({"": 2.0}), second.under(with_kit(second.problem))):
        assert kept.known == second.known
        means = dict(zip(kept.names, kept.x0, strict=True))
        assert [means[name] for name in second.names] == second.x0.tolist()

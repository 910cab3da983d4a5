"""Dense pieces against their definitions."""

import numpy as np
import pytest

from casacal.linalg import (
    correlation,
    damped_solution,
    downdated,
    freed_of,
    inverse_triangle,
    posterior_covariance,
    svd,
    tria,
)


def test_tria_is_lower_triangular_with_the_same_product():
    a = np.random.default_rng(0).normal(size=(5, 9))
    s = tria(a)
    assert np.array_equal(s, np.tril(s))
    assert (np.diagonal(s) > 0).all()
    np.testing.assert_allclose(s @ s.T, a @ a.T, atol=1e-12)


def test_damped_solution_solves_the_damped_system_or_says_it_cannot():
    rng = np.random.default_rng(1)
    j, g = rng.normal(size=(8, 4)), rng.normal(size=4)
    step = damped_solution(j.T @ j, g, 0.3)
    np.testing.assert_allclose((j.T @ j + 0.3 * np.eye(4)) @ step, -g, atol=1e-10)
    assert damped_solution(-np.eye(3), np.ones(3), 0.1) is None


def test_covariance_is_the_inverse_and_infinite_where_nothing_is_known():
    rng = np.random.default_rng(2)
    j = rng.normal(size=(9, 4))
    prior = np.diag([4.0, 0.25, 0.0, 0.0])
    expected = np.linalg.inv(j.T @ j + np.diag([4.0, 0.25, 0, 0]))
    np.testing.assert_allclose(posterior_covariance(j.T @ j, prior), expected, rtol=1e-10)
    j[:, 3] = 0.0
    unseen = posterior_covariance(j.T @ j, prior)
    assert np.isinf(unseen[3, 3])
    np.testing.assert_allclose(unseen[:3, :3], np.linalg.inv(j[:, :3].T @ j[:, :3] + np.diag([4, 0.25, 0])), rtol=1e-10)
    assert correlation(unseen)[3, 3] == 0
    np.testing.assert_allclose(np.diagonal(correlation(expected)), 1)


def test_a_direction_that_only_the_prior_holds_is_not_lost_beside_a_sharp_one():
    # x0 is known 1e8 times better than its prior; x1 (flat) and x2 are only seen in sum, so the prior of x2 holds both
    information = np.array([[1e16, 0, 0], [0, 1e9, 1e9], [0, 1e9, 1e9]])
    prior = np.diag([1.0, 0.0, 4.0])
    covariance = posterior_covariance(information, prior)
    expected = np.array([[1 / (1e16 + 1), 0, 0], [0, 0.25 + 1e-9, -0.25], [0, -0.25, 0.25]])
    np.testing.assert_allclose(covariance, expected, rtol=1e-5, atol=1e-18)


def test_a_triangle_is_inverted_whatever_stands_above_it():
    rng = np.random.default_rng(3)
    full = rng.normal(size=(9, 9)) + 4 * np.eye(9)
    np.testing.assert_allclose(inverse_triangle(full), np.linalg.inv(np.tril(full)), atol=1e-13)


@pytest.mark.parametrize("length", [0.1, 0.9, 0.999])
def test_a_downdate_is_the_qr_it_replaces(length):
    rng = np.random.default_rng(4)
    root = np.tril(rng.normal(size=(7, 7)))
    root[np.diag_indices(7)] = np.abs(root.diagonal()) + 0.1
    u = rng.normal(size=7)
    u *= length / np.linalg.norm(u)
    found = downdated(root, u)
    expected = root @ (np.eye(7) - np.outer(u, u)) @ root.T
    np.testing.assert_allclose(found @ found.T, expected, atol=1e-13)
    np.testing.assert_allclose(found, np.linalg.cholesky(expected), atol=1e-10)
    assert downdated(root, u / np.linalg.norm(u)) is None


@pytest.mark.parametrize(("shape", "full"), [((7, 4), False), ((4, 7), False), ((4, 7), True)])
def test_a_matrix_at_which_divide_and_conquer_gives_up_is_taken_apart_all_the_same(monkeypatch, shape, full):
    def gives_up(*_, **__):
        raise np.linalg.LinAlgError("SVD did not converge")

    matrix = np.random.default_rng(4).standard_normal(shape)
    matrix[:, 1] = 0.0
    expected = np.sqrt(np.maximum(np.linalg.eigvalsh(matrix @ matrix.T)[::-1][:4], 0.0))
    monkeypatch.setattr(np.linalg, "svd", gives_up)
    left, values, right = svd(matrix, full=full)
    np.testing.assert_allclose(values, expected, atol=1e-7)
    assert right.shape == (7 if full else 4, shape[1])
    np.testing.assert_allclose(left[:, :4] * values @ right[:4], matrix, atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        svd(np.full(shape, np.nan), full=full)


@pytest.mark.parametrize("unseen", [False, True])
def test_columns_taken_out_leave_the_schur_complement(unseen):
    """By pseudo-inverse; two of the others that rows see together only take away what both do, not more."""
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(20, 4)), rng.normal(size=(20, 3))
    if unseen:
        b[:, 1], b[:, 2] = b[:, 0], 0.0
    left = freed_of(a, b)
    np.testing.assert_allclose(left.T @ left, a.T @ (a - b @ np.linalg.pinv(b) @ a), atol=1e-12)

"""The data's information J'J, one matrix or an arrow: steps and spreads that do not care which."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.least_squares.arrow import Arrow, Index
from casacal.least_squares.linalg import damped_solution, information_of, unit_scale

Information: TypeAlias = Array | Arrow

UNSEEN = 1e-8  # part of an unknown, squared, in directions that nothing holds, from which it counts as not held
ROUNDING = 16 * float(np.finfo(float).eps)  # part of a unit diagonal that rounding leaves where groups are taken out


def with_diagonal(information: Information, scale: Array, diagonal: Array) -> Information:
    """D A D + E with diagonals D and E (n,)."""
    if isinstance(information, Arrow):
        return information.scaled(scale).plus(diagonal)
    found = scale[:, None] * information * scale
    found.flat[:: scale.size + 1] += diagonal
    return found


def damped_by(information: Information, gradient: Array, damping: float) -> Array | None:
    """Solve (A + damping I) s = -g as `damped_solution` does, whatever the form of A."""
    if isinstance(information, Arrow):
        return information.plus(np.full(gradient.size, damping)).solution(-gradient)
    return damped_solution(information, gradient, damping)


def diagonal_of(information: Information) -> Array:
    """Its diagonal (n,)."""
    return information.diagonal() if isinstance(information, Arrow) else np.diagonal(information)


def among(information: Information, free: Index) -> Information:
    """The part (m, m) of A that some unknowns (m,), in ascending order, have in it."""
    return information.among(free) if isinstance(information, Arrow) else information[np.ix_(free, free)]


def determined(information: Information, prior_std: Array) -> float:
    """How many unknowns the data determined: the trace of J (J'J + Lambda)^-1 J', to a few where priors are flat.

    It is the rank of J'J + Lambda less what the prior holds, sum_j (posterior variance / prior variance): no flat
    unknown enters the sum.
    """
    if not prior_std.size:
        return 0.0
    firm = np.isfinite(prior_std)
    if isinstance(information, Arrow):
        rank, variances = _taken_out(information, prior_std)[2:]
    else:
        matrix = with_diagonal(information, np.ones(prior_std.size), information_of(prior_std))
        assert not isinstance(matrix, Arrow)
        scale = unit_scale(np.diagonal(matrix))
        inverse, _, rank = _pseudo_inverse((scale[:, None] * matrix * scale)[None])
        variances = np.diagonal(inverse[0]) * scale**2
    return rank - float(np.clip(variances[firm] / prior_std[firm] ** 2, 0.0, 1.0).sum())


def posterior_spread(information: Arrow, prior_std: Array) -> tuple[Array, Array]:
    """Covariance (s, s) of the shared unknowns under (A + Lambda)^-1, and variances (n,) of all, as where A is dense.

    A is the data's. What neither data nor prior hold gets an infinite variance.
    """
    if not np.isfinite(information.diagonal()).all():
        return np.diag(np.full(information.groups.shared.size, np.inf)), np.full(prior_std.size, np.inf)
    covariance, lost, _, variances = _taken_out(information, prior_std)
    variances[lost] = np.inf
    gone = lost[information.groups.shared]
    covariance[gone, :] = 0.0
    covariance[:, gone] = 0.0
    covariance[gone, gone] = np.inf
    return covariance, variances


def _taken_out(information: Arrow, prior_std: Array) -> tuple[Array, NDArray[np.bool_], int, Array]:
    """Covariance (s, s) of the shared unknowns, which (n,) nothing holds, the rank, and variances (n,) of all."""
    groups, whole = information.groups, information.plus(information_of(prior_std))
    whole = whole.scaled(scale := unit_scale(whole.diagonal()))
    corner, gone, rank = whole.corner.copy(), [], 0
    for border, block in zip(whole.borders, whole.blocks, strict=True):
        inverse, lost, seen = _pseudo_inverse(block)
        along, rank = inverse @ border, rank + seen
        corner -= np.einsum("gks,gkt->st", border, along)
        gone.append((along, np.diagonal(inverse, axis1=1, axis2=2), lost))
    (covariance,), _, seen = _pseudo_inverse(corner[None])
    null = np.linalg.eigh(corner)[1][:, : len(corner) - seen]  # of all: beside it, each group's part is -along @ null
    follows = [along @ null for along, _, _ in gone]
    size = null.T @ null
    for part in follows:
        size += np.einsum("gka,gkb->ab", part, part)
    half = np.linalg.inv(np.linalg.cholesky(size)) if size.size else size
    variances, unheld = np.empty(groups.unknowns), np.zeros(groups.unknowns, dtype=bool)
    variances[groups.shared], unheld[groups.shared] = np.diagonal(covariance), _lost(null @ half.T)
    for own, part, (along, alone, lost) in zip(groups.own, follows, gone, strict=True):
        variances[own] = alone + np.einsum("gks,st,gkt->gk", along, covariance, along)
        unheld[own] = lost | _lost(part @ half.T)
    shared = scale[groups.shared]
    return shared[:, None] * covariance * shared, unheld, rank + seen, variances * scale**2


def _lost(null: Array) -> NDArray[np.bool_]:
    """Which unknowns (..., n) take part in orthonormal null vectors (..., n, a)."""
    return np.asarray((null**2).sum(axis=-1) > UNSEEN)


def _pseudo_inverse(matrices: Array) -> tuple[Array, NDArray[np.bool_], int]:
    """Inverses (b, k, k) of matrices with a unit diagonal or less, what rounding hides (b, k), and their ranks' sum."""
    values, vectors = np.linalg.eigh(matrices)
    held = values > ROUNDING * matrices.shape[1]
    inverse = (vectors * np.where(held, 1.0 / np.where(held, values, 1.0), 0.0)[:, None]) @ vectors.transpose(0, 2, 1)
    return inverse, _lost(vectors * ~held[:, None]), int(held.sum())

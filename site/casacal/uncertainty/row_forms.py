"""Tests of how rows err together, or err more than others: quadratic forms r'W r of what a geometry leaves of them.

For y of N(0, s^2 V), V^-1 = I - J C J' as in `casacal.uncertainty.scores`, the residual r = V^-1 y at the minimum has
the traces of (W V^-1)^k in J'W^k J and C alone, W sparse: the moments of r'W r / y'V^-1 y, exactly, whatever the noise.
With W of neighbours this is Moran's I of residuals (Cliff and Ord 1981), with a diagonal W it is the score of a
variance in proportion to it (Breusch and Pagan, Econometrica 47, 1979), studentised as Koenker did.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.spatial import cKDTree

from casacal.array_types import Array
from casacal.binding.all_rows import AllRows
from casacal.uncertainty.quadratic_forms import chance_of_ratio
from casacal.uncertainty.scores import Ground

NEIGHBOURS = 4  # nearest places on its face with which a touch is compared


@dataclass(frozen=True)
class RowForm:
    """A quadratic form of the residuals, observed: its chance, and the variance t^2 of errors of covariance t^2 W."""

    chance: float
    variance: float
    noise: float
    """Variance of what is left for noise, over that with which rows are weighted."""

    @property
    def size(self) -> float:
        """t."""
        return math.sqrt(self.variance)

    @staticmethod
    def of(ground: Ground, jacobian: Array, residual: Array, form: csr_matrix) -> RowForm | None:
        """Of rows J (N, n), r (N,) where J was taken, and W (N, N); None where they say nothing of it."""
        left = residual + jacobian @ ground.step
        powers, along = [], jacobian
        for _ in range(3):
            along = form @ along
            powers.append(ground.covariance @ (jacobian.T @ along))
        twice = form @ form
        one, two, three = powers
        whole = (form.trace(), twice.trace(), float(twice.multiply(form.T).sum()))
        traces = (
            whole[0] - float(np.trace(one)),
            whole[1] - 2 * float(np.trace(two)) + float((one * one.T).sum()),
            whole[2] - 3 * float(np.trace(three)) + 3 * float((two * one.T).sum()) - float(np.trace(one @ one @ one)),
        )
        observed, free = float(left @ (form @ left)), ground.freedom
        beyond = traces[1] - traces[0] ** 2 / free
        if not (ground.square > 0 and beyond > 0):
            return None
        excess = observed - ground.square * traces[0] / free
        variance = max(excess / beyond, 0.0)
        noise = max(ground.square - variance * traces[0], 0.0) / free
        return RowForm(chance_of_ratio(traces, observed / ground.square, free), variance, noise)


def near_on_faces(tips: Array, faces: NDArray[np.integer[Any]], places: NDArray[np.intp]) -> csr_matrix:
    """Which touches (N, N) are near one another on one face, but not in the same place: tips (N, 3; mm), codes (N,).

    A code below zero is of no face.
    """
    _, first = np.unique(places, return_index=True)
    pairs: list[NDArray[np.intp]] = []
    for face in np.unique(faces[faces >= 0]):
        rows = first[faces[first] == face]
        if len(rows) < 2:
            continue
        near = cKDTree(tips[rows]).query(tips[rows], k=list(range(2, 2 + min(NEIGHBOURS, len(rows) - 1))))[1]
        pairs.append(np.column_stack([np.repeat(places[rows], near.shape[1]), places[rows][near.ravel()]]))
    of_place = _membership(places)
    between = _pairs(np.vstack(pairs) if pairs else np.zeros((0, 2), dtype=np.intp), of_place.shape[1])
    return csr_matrix(of_place @ between @ of_place.T)


def following(
    lines: Sequence[int], places: NDArray[np.intp], instruments: NDArray[np.intp] | None = None
) -> csr_matrix:
    """Which touches (N, N) follow one another, by their lines (N,), but not in the same place, by codes (N,).

    Those of one instrument follow none of another's.
    """
    which = np.zeros(len(lines), dtype=np.intp) if instruments is None else instruments
    order = np.lexsort((np.asarray(lines), which))
    pairs = np.column_stack([order[:-1], order[1:]])
    apart = (places[pairs[:, 0]] != places[pairs[:, 1]]) & (which[pairs[:, 0]] == which[pairs[:, 1]])
    return _pairs(pairs[apart], len(lines))


def alike(places: NDArray[np.intp]) -> csr_matrix:
    """Which touches (N, N) are of the same place, by codes (N,), each of its own among them."""
    of_place = _membership(places)
    return csr_matrix(of_place @ of_place.T)


def whitened(form: csr_matrix, rows: AllRows) -> csr_matrix:
    """The same of samples (N, N), component by component, as residuals (rows,) over their noise see it."""
    scale, total = diags(1.0 / rows.noise), csr_matrix((rows.noise.size, rows.noise.size))
    for component in range(int(rows.components.max(initial=0))):
        mine = np.flatnonzero(rows.component_of == component)
        places = (np.ones(mine.size), (mine, rows.sample_of[mine]))
        of_samples = csr_matrix(places, shape=(rows.noise.size, len(rows.components)))
        total = total + of_samples @ form @ of_samples.T
    return csr_matrix(scale @ total @ scale)


def diagonal(values: Array) -> csr_matrix:
    """Rows (N,) that err more than others, in proportion to values."""
    return csr_matrix(diags(values))


def _membership(places: NDArray[np.intp]) -> csr_matrix:
    return csr_matrix((np.ones(len(places)), (np.arange(len(places)), places)))


def _pairs(pairs: NDArray[np.intp], count: int) -> csr_matrix:
    """One (count, count) where either is paired with the other."""
    both = np.unique(np.vstack([pairs, pairs[:, ::-1]]), axis=0)
    both = both[both[:, 0] != both[:, 1]]
    return csr_matrix(coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)))

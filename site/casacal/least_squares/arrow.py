"""Unknowns that single groups of rows have for themselves, and information of that form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.least_squares.linalg import LEAST_PIVOT, damped_solution

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Groups:
    """Which unknowns are shared (s,), and which belong to one group alone: an array (groups, k) for each size k."""

    shared: Index
    own: tuple[Index, ...]

    @cached_property
    def unknowns(self) -> int:
        """How many there are in all."""
        return self.shared.size + sum(each.size for each in self.own)

    @cached_property
    def place(self) -> tuple[Index, Index, Index]:
        """Of each unknown (n,): its size class (-1: shared), its group in it, its position there or in the corner."""
        kind, group, position = (np.full(self.unknowns, -1, dtype=np.intp) for _ in range(3))
        position[self.shared] = np.arange(self.shared.size)
        for c, own in enumerate(self.own):
            kind[own], group[own], position[own] = c, np.arange(len(own))[:, None], np.arange(own.shape[1])
        return kind, group, position

    def among(self, free: Index) -> Groups:
        """The same of some unknowns (m,), in ascending order, renumbered; those of a group stay together."""
        new = np.full(self.unknowns, -1, dtype=np.intp)
        new[free] = np.arange(free.size)
        kept: dict[int, list[Index]] = {}
        for own in self.own:
            for group in new[own]:
                left = group[group >= 0]
                if left.size:
                    kept.setdefault(left.size, []).append(left)
        shared = new[self.shared]
        return Groups(shared[shared >= 0], tuple(np.array(each) for _, each in sorted(kept.items())))


def grouped(columns: Sequence[Index], own: NDArray[np.bool_]) -> Groups:
    """Groups of the unknowns marked as own (n,): those that some rows see together, by kind of row, are of one group.

    All else is shared.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n, mine = own.size, [seen[own[seen]] for seen in columns]
    pairs = [(seen[:-1], seen[1:]) for seen in mine if seen.size > 1]
    nothing = np.zeros(0, dtype=np.intp)
    one, other = (np.concatenate([nothing, *(pair[i] for pair in pairs)]) for i in range(2))
    _, label = connected_components(coo_array((np.ones(len(one)), (one, other)), shape=(n, n)), directed=False)
    members = np.flatnonzero(own)
    members = members[np.argsort(label[members], kind="stable")]
    starts = np.flatnonzero(np.diff(label[members], prepend=-1))
    by_size: dict[int, list[Index]] = {}
    for group in np.split(members, starts[1:]):
        if group.size:
            by_size.setdefault(group.size, []).append(group)
    return Groups(np.flatnonzero(~own), tuple(np.array(each) for _, each in sorted(by_size.items())))


MOST_UNKNOWNS = 3_000  # unknowns whose matrices, of which a calibration holds about ten, fit into a gigabyte


@dataclass(frozen=True, eq=False)
class Arrow:
    """A symmetric matrix (n, n) over groups: corner (s, s), and for each size k borders (groups, k, s), blocks."""

    groups: Groups
    corner: Array
    borders: tuple[Array, ...]
    blocks: tuple[Array, ...]

    @staticmethod
    def zero(groups: Groups) -> Arrow:
        """One to add to."""
        s = groups.shared.size
        return Arrow(
            groups,
            np.zeros((s, s)),
            tuple(np.zeros((*own.shape, s)) for own in groups.own),
            tuple(np.zeros((*own.shape, own.shape[1])) for own in groups.own),
        )

    def add(self, columns: Index, matrix: Array) -> None:
        """Add a matrix (z, z) over some unknowns, of which at most one group has a part; while one is summed up."""
        kind, group, position = (each[columns] for each in self.groups.place)
        shared, own = np.flatnonzero(kind < 0), np.flatnonzero(kind >= 0)
        there, rows = position[shared], shared[:, None]
        self.corner[there[:, None], there] += matrix[rows, shared]
        if own.size:
            c, g, here = kind[own[0]], group[own[0]], position[own][:, None]
            self.borders[c][g][here, there] += matrix[own[:, None], shared]
            self.blocks[c][g][here, here[:, 0]] += matrix[own[:, None], own]

    def diagonal(self) -> Array:
        """Its diagonal (n,)."""
        found = np.empty(self.groups.unknowns)
        found[self.groups.shared] = np.diagonal(self.corner)
        for own, block in zip(self.groups.own, self.blocks, strict=True):
            found[own] = np.diagonal(block, axis1=1, axis2=2)
        return found

    def scaled(self, scale: Array) -> Arrow:
        """D A D with a diagonal D (n,)."""
        s = scale[self.groups.shared]
        own = [scale[each] for each in self.groups.own]
        return Arrow(
            self.groups,
            s[:, None] * self.corner * s,
            tuple(o[:, :, None] * border * s for o, border in zip(own, self.borders, strict=True)),
            tuple(o[:, :, None] * block * o[:, None] for o, block in zip(own, self.blocks, strict=True)),
        )

    def plus(self, diagonal: Array) -> Arrow:
        """A + D with a diagonal D (n,)."""
        blocks = []
        for own, block in zip(self.groups.own, self.blocks, strict=True):
            blocks.append(block + diagonal[own][:, :, None] * np.eye(own.shape[1]))
        corner = self.corner + np.diag(diagonal[self.groups.shared])
        return Arrow(self.groups, corner, self.borders, tuple(blocks))

    def __matmul__(self, v: Array) -> Array:
        """A v (n,)."""
        found, shared = np.empty(v.size), v[self.groups.shared]
        top = self.corner @ shared
        for own, border, block in zip(self.groups.own, self.borders, self.blocks, strict=True):
            top += np.einsum("gks,gk->s", border, v[own])
            found[own] = border @ shared + np.einsum("gkl,gl->gk", block, v[own])
        found[self.groups.shared] = top
        return found

    def solution(self, right: Array) -> Array | None:
        """A^-1 b (n,); None where A is not safely positive definite, as `damped_solution` judges."""
        diagonal, corner, below = np.diagonal(self.corner), self.corner.copy(), right[self.groups.shared].copy()
        halves = []
        for own, border, block in zip(self.groups.own, self.borders, self.blocks, strict=True):
            root = _root(block)
            if root is None:
                return None
            half = np.linalg.solve(root, np.concatenate([border, right[own][:, :, None]], axis=2))
            flat = half.reshape(-1, half.shape[2])
            corner -= flat[:, :-1].T @ flat[:, :-1]
            below -= flat[:, :-1].T @ flat[:, -1]
            halves.append((root, half))
        left = np.diagonal(corner)
        if not (left > LEAST_PIVOT * diagonal).all():
            return None
        shared = damped_solution(corner, -below, 0.0)
        if shared is None:
            return None
        found = np.empty(right.size)
        found[self.groups.shared] = shared
        for own, (root, half) in zip(self.groups.own, halves, strict=True):
            rest = half[:, :, -1] - half[:, :, :-1] @ shared
            found[own] = np.linalg.solve(root.transpose(0, 2, 1), rest[:, :, None])[:, :, 0]
        return found

    def among(self, free: Index) -> Arrow:
        """The part that some unknowns (m,), in ascending order, have in it."""
        found, new = Arrow.zero(self.groups.among(free)), np.full(self.groups.unknowns, -1, dtype=np.intp)
        new[free] = np.arange(free.size)
        shared = np.flatnonzero(new[self.groups.shared] >= 0)
        found.corner[:] = self.corner[np.ix_(shared, shared)]
        for own, border, block in zip(self.groups.own, self.borders, self.blocks, strict=True):
            for g, members in enumerate(new[own]):
                left = np.flatnonzero(members >= 0)
                if left.size:
                    kind, group, _ = (each[members[left[0]]] for each in found.groups.place)
                    found.borders[kind][group] = border[g][np.ix_(left, shared)]
                    found.blocks[kind][group] = block[g][np.ix_(left, left)]
        return found

    def dense(self) -> Array:
        """All of it (n, n); raises ProblemError where that is too large to be held."""
        check_size(self.groups.unknowns)
        n, shared = self.groups.unknowns, self.groups.shared
        found = np.zeros((n, n))
        found[np.ix_(shared, shared)] = self.corner
        for own, border, block in zip(self.groups.own, self.borders, self.blocks, strict=True):
            found[own[:, :, None], shared] = border
            found[shared[:, None], own[:, None]] = border.transpose(0, 2, 1)
            found[own[:, :, None], own[:, None]] = block
        return found


def check_size(unknowns: int) -> None:
    """Raise ProblemError where a matrix of so many unknowns cannot be held."""
    if unknowns > MOST_UNKNOWNS:
        raise ProblemError(
            f"{unknowns:,} unknowns came where a matrix of all has to be held, and it holds {MOST_UNKNOWNS:,} at most",
            "Use lm, which takes unknowns of one label out one by one, or the rows of fewer labels",
        )


def _root(block: Array) -> Array | None:
    """Cholesky factors (groups, k, k) of blocks; None where one is not safely positive definite."""
    if not np.isfinite(block).all():
        return None
    try:
        root = np.linalg.cholesky(block)
    except np.linalg.LinAlgError:
        return None
    pivots, diagonal = (np.diagonal(each, axis1=1, axis2=2) for each in (root, block))
    return np.asarray(root) if (pivots**2 > LEAST_PIVOT * diagonal).all() else None

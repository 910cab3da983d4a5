"""The search, met in the middle: readings of the first joints carry the shown position back, the others carry it up.

What the readings of the joints of a half do to a point does not depend on the other half, so thousands of halves are
compared as points of a k-d tree in place of hundreds of millions of wholes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from casacal.array_types import Array, Index
from casacal.doctor.axes import Axes, about
from casacal.doctor.family import Family, Products, joined, motions, readings

MATCHED_ROWS = 3  # rows, the most different ones, that are compared in the tree; the others are checked afterwards
MOST, MOST_LEFT = 20_000, 4_000
"""Readings, of the whole arm and of its first joints, beyond which rows are too poor to look at all of them."""
NEAREST, ALIKE = 50, 100  # readings of the first joints that are looked at when none fits, and of the others with each
NEARLY = 0.5
"""How much farther than the nearest a reading may be that is looked at; to find the nearest itself takes long."""


@dataclass(frozen=True)
class Halves:
    """All readings of the joints of each half, prepared once for an arm."""

    axes: Axes
    products: tuple[Products, Products]
    left: Family
    right: Family

    @staticmethod
    def of(axes: Axes, *, coupled: bool = True) -> Halves:
        """Split the joints of an arm in the middle; without couplings when `coupled` is false."""
        n = len(axes.turns)
        parts = (range(n // 2), range(n // 2, n))
        left, right = (readings(part, axes.turns, coupled=coupled) for part in parts)
        return Halves(axes, (left, right), left.family(), right.family())

    def fitting(
        self, q: Array, positions: Array, orientations: Iterable[Array], tolerance: float
    ) -> tuple[Family, bool]:
        """Readings that bring the flange within `tolerance` mm of positions (N, 3; mm) at q (N, n; rad, mm).

        And whether others were left aside. Where too many do, as when the last axes meet in the flange, only those are
        kept that also turn it within as many mrad of one of the orientations (N, 3, 3) that the rows may mean.
        """
        left, right, radius = self._trees(q, positions, tolerance)
        if left.count_neighbors(right, radius) <= MOST:
            return self._checked(_pairs(left, right, radius), q, positions, tolerance), False
        near = np.flatnonzero(np.isfinite(_distances(left, right, radius)))
        if len(near) <= MOST_LEFT:
            pairs = self._turned_alike(near, q, orientations, tolerance)
            if pairs is not None:
                return self._checked(pairs, q, positions, tolerance), False
        # the rows say next to nothing: the simplest of the readings that couple no joints
        halves = Halves.of(self.axes, coupled=False)
        left, right, radius = halves._trees(q, positions, tolerance)
        found = halves._checked(_pairs(left, right, radius), q, positions, tolerance)
        return found.take(np.argsort(found.changes, kind="stable")[:MOST]), True

    def nearest(self, q: Array, positions: Array) -> Family:
        """Readings that come about as near to the positions as any do."""
        left, right, _ = self._trees(q, positions, 0.0)
        best = np.argsort(_distances(left, right), kind="stable")[:NEAREST]
        # last joints that only turn the flange leave its position alone, so many stand at one point
        index = right.query(left.data[best], k=min(ALIKE, len(self.right)))[1].reshape(len(best), -1)
        return joined(self.left.take(np.repeat(best, index.shape[1])), self.right.take(index.ravel()))

    def _turned_alike(self, near: Index, q: Array, orientations: Iterable[Array], tolerance: float) -> Index | None:
        """Pairs of some left readings (by index) with right ones that turn the flange as shown; None when too many."""
        from scipy.spatial import KDTree

        rows, middle = most_different(q, MATCHED_ROWS), len(self.products[0].joints)
        radius = 1.5 * tolerance * 1e-3 * np.sqrt(len(rows))  # |R - R'| is sqrt(2) times a small angle
        turns = _turns(self.axes, self.right, middle, q[rows]) @ self.axes.turn
        tree, found = KDTree(turns.reshape(len(turns), -1)), np.zeros((0, 2), dtype=np.intp)
        back = _turns(self.axes, self.left.take(near), 0, q[rows]).swapaxes(-1, -2)
        for shown in orientations:
            wanted = KDTree((back @ shown[rows]).reshape(len(near), -1))
            if wanted.count_neighbors(tree, radius) > MOST:
                return None
            pairs = _pairs(wanted, tree, radius)
            found = np.unique(np.concatenate([found, np.column_stack([near[pairs[:, 0]], pairs[:, 1]])]), axis=0)
        return found

    def _trees(self, q: Array, positions: Array, tolerance: float) -> tuple[Any, Any, float]:
        """k-d trees of both halves' points, and the radius within which they meet."""
        from scipy.spatial import KDTree

        rows, (left, right) = most_different(q, MATCHED_ROWS), self.products
        back = left.carried(self.axes, q[rows], positions[rows], back=True)
        up = right.carried(self.axes, q[rows], np.tile(self.axes.place, (len(rows), 1)), back=False)
        trees = (KDTree(points.reshape(len(points), -1)) for points in (back, up))
        return *trees, tolerance * np.sqrt(len(rows))

    def _checked(self, pairs: Index, q: Array, positions: Array, tolerance: float) -> Family:
        """Those pairs that belong to the family and fit every row."""
        left, right = self.left.take(pairs[:, 0]), self.right.take(pairs[:, 1])
        # a coupling of joints that are not neighbours stands alone
        allowed = np.flatnonzero(~(left.distant & right.coupled) & ~(right.distant & left.coupled))
        whole = joined(left.take(allowed), right.take(allowed))
        _, places = poses_of(self.axes, whole, q)
        worst = np.linalg.norm(places - positions, axis=2).max(axis=1, initial=0.0)
        return whole.take(np.flatnonzero(worst <= tolerance))


def _distances(left: Any, right: Any, most: float = np.inf) -> Array:
    """Distance (H,) of each point of a tree to the nearest of another, which may hold many at one place.

    About the nearest, or, where a largest distance is given, the nearest and infinite beyond it.
    """
    from scipy.spatial import KDTree

    places = np.unique(np.round(right.data, 6), axis=0)
    eps = 0.0 if np.isfinite(most) else NEARLY
    return np.asarray(KDTree(places).query(left.data, eps=eps, distance_upper_bound=most)[0])


def _pairs(left: Any, right: Any, radius: float) -> Index:
    """Indices (P, 2) of points of two k-d trees that are within a radius of each other."""
    found = [(i, j) for i, some in enumerate(left.query_ball_tree(right, radius)) for j in some]
    return np.array(found, dtype=np.intp).reshape(-1, 2)


def _turns(axes: Axes, family: Family, first: int, q: Array) -> Array:
    """Rotations (H, N, 3, 3) of some consecutive joints, the first of them given, by every reading of a half."""
    product = np.broadcast_to(np.eye(3), (len(family), len(q), 3, 3))
    for k in range(family.options.shape[1]):
        if axes.turns[first + k]:
            product = product @ about(axes.directions[first + k], motions(family.options[:, k], first + k, q))
    return product


def poses_of(axes: Axes, family: Family, q: Array) -> tuple[Array, Array]:
    """Rotations (H, N, 3, 3) and positions (H, N, 3; mm) of each reading at the controller's values (N, n; rad, mm)."""
    n = len(axes.turns)
    return axes.poses(np.stack([motions(family.options[:, i], i, q) for i in range(n)], axis=-1))


def most_different(q: Array, count: int) -> Index:
    """Rows, at most `count`, each as far as can be from those before it."""
    chosen = [0]
    while len(chosen) < min(count, len(q)):
        apart = np.linalg.norm(q[:, None] - q[chosen], axis=2).min(axis=1)
        if apart.max() == 0:
            break
        chosen.append(int(np.argmax(apart)))
    return np.array(chosen, dtype=np.intp)

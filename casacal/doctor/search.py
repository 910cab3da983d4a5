"""The conventions that are searched, and the search, met in the middle.

Joint i of the model = sign * (q_i + factor * q_partner) + quarter turns. Every turning joint may have either sign and
any of the four quarter turns; a sliding joint has either sign and no offset. Either any joints are measured against the
joint before them (factor +-1), or one joint is measured against any other one.

Readings of the first joints carry the shown position back, the others carry it up. What the readings of the joints of a
half do to a point does not depend on the other half, so thousands of halves are compared as points of a k-d tree in
place of hundreds of millions of wholes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.model.axes import Axes, about
from casacal.values import Array, Index

Integers: TypeAlias = NDArray[np.int8]
"""Readings of consecutive joints (H, m, 4): of each its sign, quarter turns, partner (from 0; -1 for none), factor."""


def settings_changed(options: Integers) -> Index:
    """In how many settings each reading (H, m, 4) differs from plain (H,)."""
    sign, quarter, partner, _ = np.moveaxis(options, -1, 0)
    return np.asarray(((sign < 0).astype(int) + (quarter != 0) + (partner >= 0)).sum(axis=1))


@dataclass(frozen=True)
class Products:
    """All readings of some consecutive joints, as products: in each part, the options (k, 4) of every joint."""

    joints: range
    parts: tuple[tuple[Integers, ...], ...]

    @cached_property
    def options(self) -> Integers:
        """The readings one by one (H, m, 4), in the order of the products."""
        options = []
        for part in self.parts:
            index = np.indices([len(each) for each in part]).reshape(len(part), -1)
            listed = [each[rows] for each, rows in zip(part, index, strict=True)]
            options.append(np.stack(listed, axis=1) if part else np.zeros((1, 0, 4), dtype=np.int8))
        return np.concatenate(options)

    def carried(self, axes: Axes, q: Array, points: Array, *, back: bool) -> Array:
        """Points (N, 3; mm) carried by every reading, (H, N, 3): up through the joints, or back through their inverses.

        Positions that depend on some of the joints are computed once for all readings that share those.
        """
        carried = []
        for part in self.parts:
            places = points
            order = range(len(part)) if back else reversed(range(len(part)))
            for k in order:
                moved = motions(part[k], self.joints[k], q)
                shape = [1] * len(part)
                shape[k] = len(moved)
                moved = (-moved if back else moved).reshape(*shape, len(q))
                places = axes.carry(self.joints[k], moved, places)
            carried.append(np.broadcast_to(places, (*map(len, part), *points.shape)).reshape(-1, *points.shape))
        return np.concatenate(carried)


def motions(options: Integers, joint: int, q: Array) -> Array:
    """Motion (H, N; rad, mm) of a joint, read as each of (H, 4) options, at the controller's values (N, n; rad, mm)."""
    sign, quarter, partner, factor = options.T[..., None]
    other = np.where(partner >= 0, q.T[partner[:, 0]], 0.0)
    return np.asarray(sign * (q[:, joint] + factor * other) + quarter * (np.pi / 2))


def readings(joints: range, turns: Sequence[bool], *, coupled: bool) -> Products:
    """All readings of consecutive joints (counted from 0), with couplings or without.

    turns: which joints of the arm turn (n,). Only joints measured against the one before them are coupled together.
    """
    every = [_options(i, turns) for i in joints]
    plain = [each[each[:, 2] < 0] for each in every]
    if not coupled:
        return Products(joints, (tuple(plain),))
    near = [(each[:, 2] < 0) | (each[:, 2] == i - 1) for i, each in zip(joints, every, strict=True)]
    parts = [tuple(each[rows] for each, rows in zip(every, near, strict=True))]
    for k, each in enumerate(every):
        if not near[k].all():
            parts.append((*plain[:k], each[~near[k]], *plain[k + 1 :]))
    return Products(joints, tuple(parts))


def one_change_away(reading: Integers, turns: Sequence[bool]) -> Integers:
    """All readings (H, n, 4) of the whole arm that differ from one (n, 4) in one joint."""
    found = []
    for i in range(len(turns)):
        options = _options(i, turns)
        others = options[(options != reading[i]).any(axis=1)]
        changed = np.repeat(reading[None], len(others), axis=0)
        changed[:, i] = others
        found.append(changed)
    return np.concatenate(found)


def _options(joint: int, turns: Sequence[bool]) -> Integers:
    """Every way to read one joint (k, 4)."""
    if not turns[joint]:
        return np.array([(1, 0, -1, 0), (-1, 0, -1, 0)], dtype=np.int8)
    partners = [(-1, 0), *((j, f) for j in range(len(turns)) if j != joint and turns[j] for f in (-1, 1))]
    found = [(sign, quarter, *pair) for pair in partners for quarter in (0, 1, 2, -1) for sign in (1, -1)]
    return np.array(found, dtype=np.int8)


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
    left: Products
    right: Products

    @staticmethod
    def of(axes: Axes, *, coupled: bool = True) -> Halves:
        """Split the joints of an arm in the middle; without couplings when `coupled` is false."""
        n = len(axes.turns)
        left, right = (readings(part, axes.turns, coupled=coupled) for part in (range(n // 2), range(n // 2, n)))
        return Halves(axes, left, right)

    def fitting(
        self, q: Array, positions: Array, orientations: Iterable[Array], tolerance: float
    ) -> tuple[Integers, bool]:
        """Readings (H, n, 4) that bring the flange within `tolerance` mm of positions (N, 3; mm) at q (N, n; rad, mm).

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
        return found[np.argsort(settings_changed(found), kind="stable")[:MOST]], True

    def nearest(self, q: Array, positions: Array) -> Integers:
        """Readings (H, n, 4) that come about as near to the positions as any do."""
        left, right, _ = self._trees(q, positions, 0.0)
        best = np.argsort(_distances(left, right), kind="stable")[:NEAREST]
        # last joints that only turn the flange leave its position alone, so many stand at one point
        index = right.query(left.data[best], k=min(ALIKE, right.n))[1].reshape(len(best), -1)
        return self._whole(np.column_stack([np.repeat(best, index.shape[1]), index.ravel()]))

    def _turned_alike(self, near: Index, q: Array, orientations: Iterable[Array], tolerance: float) -> Index | None:
        """Pairs of some left readings (by index) with right ones that turn the flange as shown; None when too many."""
        from scipy.spatial import KDTree

        rows, middle = most_different(q, MATCHED_ROWS), len(self.left.joints)
        radius = 1.5 * tolerance * 1e-3 * np.sqrt(len(rows))  # |R - R'| is sqrt(2) times a small angle
        turns = _turns(self.axes, self.right.options, middle, q[rows]) @ self.axes.turn
        tree, found = KDTree(turns.reshape(len(turns), -1)), np.zeros((0, 2), dtype=np.intp)
        back = _turns(self.axes, self.left.options[near], 0, q[rows]).swapaxes(-1, -2)
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

        rows = most_different(q, MATCHED_ROWS)
        back = self.left.carried(self.axes, q[rows], positions[rows], back=True)
        up = self.right.carried(self.axes, q[rows], np.tile(self.axes.place, (len(rows), 1)), back=False)
        trees = (KDTree(points.reshape(len(points), -1)) for points in (back, up))
        return *trees, tolerance * np.sqrt(len(rows))

    def _whole(self, pairs: Index) -> Integers:
        """Readings (P, n, 4) of all joints from pairs (P, 2) of a left and a right one."""
        return np.concatenate([self.left.options[pairs[:, 0]], self.right.options[pairs[:, 1]]], axis=1)

    def _checked(self, pairs: Index, q: Array, positions: Array, tolerance: float) -> Integers:
        """Those pairs that belong to the family and fit every row."""
        whole = self._whole(pairs)
        coupled = whole[..., 2] >= 0
        distant = coupled & (whole[..., 2] != np.arange(whole.shape[1]) - 1)
        # a coupling of joints that are not neighbours stands alone
        whole = whole[~distant.any(axis=1) | (coupled.sum(axis=1) == 1)]
        _, places = poses_of(self.axes, whole, q)
        worst = np.linalg.norm(places - positions, axis=2).max(axis=1, initial=0.0)
        return np.asarray(whole[worst <= tolerance], dtype=np.int8)


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


def _turns(axes: Axes, options: Integers, first: int, q: Array) -> Array:
    """Rotations (H, N, 3, 3) of some consecutive joints, the first of them given, by every reading of a half."""
    product = np.broadcast_to(np.eye(3), (len(options), len(q), 3, 3))
    for k in range(options.shape[1]):
        if axes.turns[first + k]:
            product = product @ about(axes.directions[first + k], motions(options[:, k], first + k, q))
    return product


def poses_of(axes: Axes, options: Integers, q: Array) -> tuple[Array, Array]:
    """Rotations (H, N, 3, 3) and positions (H, N, 3; mm) of each reading at the controller's values (N, n; rad, mm)."""
    return axes.poses(np.stack([motions(options[:, i], i, q) for i in range(len(axes.turns))], axis=-1))


def most_different(q: Array, count: int) -> Index:
    """Rows, at most `count`, each as far as can be from those before it."""
    chosen = [0]
    while len(chosen) < min(count, len(q)):
        apart = np.linalg.norm(q[:, None] - q[chosen], axis=2).min(axis=1)
        if apart.max() == 0:
            break
        chosen.append(int(np.argmax(apart)))
    return np.array(chosen, dtype=np.intp)

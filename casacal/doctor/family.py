"""The conventions that are searched: what each joint of a controller may mean to the model.

Joint i of the model = sign * (q_i + factor * q_partner) + quarter turns. Every turning joint may have either sign and
any of the four quarter turns; a sliding joint has either sign and no offset. Either any joints are measured against the
joint before them (factor +-1), or one joint is measured against any other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array, Index
from casacal.doctor.axes import Axes

Integers: TypeAlias = NDArray[np.int8]

Option: TypeAlias = tuple[int, int, int, int]
"""Sign, quarter turns, partner (counted from 0; -1 for none), factor: one way to read one joint."""


@dataclass(frozen=True)
class Family:
    """Readings of consecutive joints, one per row.

    options: (H, m, 4), an `Option` for each joint. distant: rows (H,) that couple a joint with one not before it.
    """

    options: Integers
    distant: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.options)

    def take(self, rows: Index) -> Family:
        """Some of the readings."""
        return Family(self.options[rows], self.distant[rows])

    @property
    def coupled(self) -> NDArray[np.bool_]:
        """Readings (H,) that couple joints."""
        return np.asarray((self.options[..., 2] >= 0).any(axis=1))

    @property
    def changes(self) -> NDArray[np.intp]:
        """In how many settings a reading differs from plain (H,)."""
        sign, quarter, partner, _ = np.moveaxis(self.options, -1, 0)
        return np.asarray(((sign < 0).astype(int) + (quarter != 0) + (partner >= 0)).sum(axis=1))


@dataclass(frozen=True)
class Products:
    """All readings of some consecutive joints, as products of what each joint may be.

    parts: for each product the options of each joint, (k, 4) each. distant: which products couple a joint with one not
    before it.
    """

    joints: tuple[int, ...]
    parts: tuple[tuple[Integers, ...], ...]
    distant: tuple[bool, ...]

    def family(self) -> Family:
        """The readings one by one, in the order of the products."""
        options, marks = [], []
        for part, mark in zip(self.parts, self.distant, strict=True):
            index = np.indices([len(each) for each in part]).reshape(len(part), -1)
            listed = [each[rows] for each, rows in zip(part, index, strict=True)]
            options.append(np.stack(listed, axis=1) if part else np.zeros((1, 0, 4), dtype=np.int8))
            marks.append(np.full(len(options[-1]), mark))
        return Family(np.concatenate(options), np.concatenate(marks))

    def carried(self, axes: Axes, q: Array, points: Array, *, back: bool) -> Array:
        """Points (N, 3; mm) carried by every reading, (H, N, 3): up through the joints, or back through their inverses.

        What only some joints decide is computed once for all readings that share it.
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


def readings(joints: Sequence[int], turns: Sequence[bool], *, coupled: bool = True) -> Products:
    """All readings of consecutive joints (counted from 0) of an arm whose joints turn or slide as `turns` says.

    Without couplings when `coupled` is false.
    """
    every = [np.array(_options(i, turns), dtype=np.int8) for i in joints]
    plain = [each[each[:, 2] < 0] for each in every]
    if not coupled:
        return Products(tuple(joints), (tuple(plain),), (False,))
    near = [(each[:, 2] < 0) | (each[:, 2] == i - 1) for i, each in zip(joints, every, strict=True)]
    parts, distant = [tuple(each[rows] for each, rows in zip(every, near, strict=True))], [False]
    for k in range(len(every)):
        if not near[k].all():
            parts.append((*plain[:k], every[k][~near[k]], *plain[k + 1 :]))
            distant.append(True)
    return Products(tuple(joints), tuple(parts), tuple(distant))


def joined(left: Family, right: Family) -> Family:
    """Readings of all joints from as many of the left and of the right ones."""
    return Family(np.concatenate([left.options, right.options], axis=1), left.distant | right.distant)


def one_change_away(reading: Integers, turns: Sequence[bool]) -> Family:
    """All readings of the whole arm that differ from one (n, 4) in one joint."""
    rows = []
    for i in range(len(turns)):
        for option in _options(i, turns):
            if option != tuple(reading[i]):
                rows.append(np.concatenate([reading[:i], [np.array(option, dtype=np.int8)], reading[i + 1 :]]))
    return Family(np.array(rows, dtype=np.int8), np.zeros(len(rows), dtype=bool))


def _options(joint: int, turns: Sequence[bool]) -> list[Option]:
    """Every way to read one joint."""
    if not turns[joint]:
        return [(1, 0, -1, 0), (-1, 0, -1, 0)]
    partners = [(-1, 0), *((j, f) for j in range(len(turns)) if j != joint and turns[j] for f in (-1, 1))]
    return [(sign, quarter, *pair) for pair in partners for quarter in (0, 1, 2, -1) for sign in (1, -1)]

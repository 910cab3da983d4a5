"""One number copied wrongly: which cell of a row, changed, would let the convention of all other rows explain it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.doctor.axes import Axes
from casacal.doctor.pendant_rows import ANGLES, LENGTHS, PendantRows, rotations_as
from casacal.doctor.same_arm import Meaning
from casacal.doctor.search import poses_of

TRIED, REFINED, STEPS = 72, 3, 6
"""Values of an angle that are tried, those among them that are refined, and the most steps to refine one."""
AS_WELL = 2.0
"""Multiples of what the other rows miss by, within which a changed number explains its row as well as they are."""
ROUNDING = 0.1  # part of the tolerance that a row may always miss by: numbers are rounded


@dataclass(frozen=True)
class PendantSlip:
    """A number that does not fit, and the one in its place with which its row would.

    line: of the file (counted from 1, or the row where there is no file). column: its name. shown, fitting: in the unit
    of the column. miss: of the row with it, the larger of mm and mrad.
    """

    line: int
    column: str
    shown: float
    fitting: float
    miss: float


def slips_in(
    axes: Axes, base: Array, rows: PendantRows, row: int, meanings: Iterable[Meaning], tolerance: float
) -> tuple[PendantSlip, ...]:
    """Every single number of a row that could be the one copied wrongly, if the others mean what all other rows mean.

    meanings: of the other rows. A number counts when, changed, its row fits as well as the others do, within
    `tolerance` mm and mrad. Of several meanings each number keeps the value with which its row fits best.
    """
    found: dict[str, PendantSlip] = {}
    shown = rows.numbers
    for meaning in meanings:
        for name in meaning.rotations:
            miss = _misses(axes, base, rows, meaning, name)
            others = np.delete(shown, row, axis=0)
            limit = min(tolerance, max(AS_WELL * _size(miss(others)).max(), ROUNDING * tolerance))
            for k, (column, starts) in enumerate(_cells(axes, rows, meaning, name)):
                value, size = _best(miss, shown[row], k, starts)
                if size <= limit and (column not in found or size < found[column].miss):
                    if k < rows.joints.shape[1] and axes.turns[k]:  # within half a turn of zero
                        turn = 2 * np.pi / ANGLES[meaning.joint_unit]
                        value -= turn * round(value / turn)
                    found[column] = PendantSlip(rows.line(row), column, float(shown[row, k]), value, size)
    return tuple(sorted(found.values(), key=lambda slip: slip.miss))


def _misses(
    axes: Axes, base: Array, rows: PendantRows, meaning: Meaning, name: tuple[str, str]
) -> Callable[[Array], Array]:
    """What rows of numbers (N, columns) miss by under one meaning: (N, 12), 3 in mm and 9 whose norm is mrad."""
    n, length = rows.joints.shape[1], LENGTHS[meaning.length_unit]
    scale = np.where(axes.turns, ANGLES[meaning.joint_unit], length)

    def miss(numbers: Array) -> Array:
        turn, place = poses_of(axes, meaning.family, numbers[:, :n] * scale)
        apart = place[0] @ base[:3, :3].T + base[:3, 3] - numbers[:, n : n + 3] * length
        turned = base[:3, :3] @ turn[0] - rotations_as(numbers[:, n + 3 :], *name)
        # the norm of a difference of rotations is sqrt(2) times a small angle
        return np.hstack([apart, turned.reshape(len(numbers), 9) * (1e3 / np.sqrt(2))])

    return miss


def _size(misses: Array) -> Array:
    """The larger of mm and mrad (N,)."""
    return np.asarray(np.maximum(np.linalg.norm(misses[:, :3], axis=1), np.linalg.norm(misses[:, 3:], axis=1)))


def _cells(axes: Axes, rows: PendantRows, meaning: Meaning, name: tuple[str, str]) -> Iterator[tuple[str, Array]]:
    """Each column, with values to start from: one where poses are linear in it, else all round."""
    kind, unit = name
    n, around = rows.joints.shape[1], np.linspace(-np.pi, np.pi, TRIED, endpoint=False)
    angles = {"quaternion": around / np.pi, "rotation-vector": 2 * around}.get(kind, around) / ANGLES.get(unit, 1.0)
    for k, column in enumerate(rows.names):
        if k < n:
            yield column, around / ANGLES[meaning.joint_unit] if axes.turns[k] else np.zeros(1)
        else:
            yield column, np.zeros(1) if k < n + 3 else angles


def _best(miss: Callable[[Array], Array], numbers: Array, column: int, starts: Array) -> tuple[float, float]:
    """The value of one number with which its row misses least, by Gauss-Newton from the best starts; and that miss."""

    def at(values: Array) -> Array:
        tried = np.tile(numbers, (len(values), 1))
        tried[:, column] = values
        return miss(tried)

    values = starts[np.argsort(np.linalg.norm(at(starts), axis=1), kind="stable")[:REFINED]]
    near = 1e-6 * (1 + np.ptp(starts))
    for _ in range(STEPS):
        here, after, before = np.split(at(np.concatenate([values, values + near, values - near])), 3)
        slope = (after - before) / (2 * near)
        steep = np.maximum((slope**2).sum(axis=1), np.finfo(float).tiny)  # a number that moves nothing stays
        values = values - (slope * here).sum(axis=1) / steep
    sizes = _size(at(values))
    chosen = int(np.argmin(sizes))
    return float(values[chosen]), float(sizes[chosen])

"""Touches of the same place in the same posture: repeats, which tell pure error from what the model leaves out.

Copies of a row, the same to the last digit, are no repeats: whether somebody pasted them or a coarse dial read the same
twice, they say nothing of the scatter of touches.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.samples.measurements import Measurements
from casacal.samples.samples import Samples

SAME = 1e-4
"""Joint values (rad, mm) that round to the same multiple of this are those of one posture."""

MIX = np.int64(0x2545F4914F6CDD1D)
"""An odd number of 64 bits whose products look random (Vigna, xorshift*, 2016)."""


@dataclass(frozen=True, eq=False)
class Repeats:
    """Which rows repeat one another: the group of each row (N,), and the rows of each group (G,)."""

    codes: NDArray[np.intp]
    sizes: NDArray[np.intp]

    @property
    def any(self) -> bool:
        """Whether any row repeats another."""
        return len(self.sizes) < len(self.codes)

    def summed(self, values: Array) -> Array:
        """Sums (G,) of values (N,) over each group."""
        return np.bincount(self.codes, values, len(self.sizes)).astype(np.float64)

    def condensed(self, values: Array) -> Array:
        """Group sums over the root of the group's size (G,): what a group of equal weights tells, of the same scale."""
        return np.asarray(self.summed(values) / np.sqrt(self.sizes))


def repeats_of(samples: Samples, groups: str | None) -> Repeats:
    """Rows of the same joint values, to 1e-4 rad or mm, on the same face."""
    places = np.column_stack([np.round(samples.joints / SAME), samples.faces(groups).codes]).astype(np.int64)
    _, codes, sizes = np.unique(_keys(len(samples), places.T), return_inverse=True, return_counts=True)
    return Repeats(np.asarray(codes, dtype=np.intp).ravel(), np.asarray(sizes, dtype=np.intp))


def repeats_in(measured: Measurements, groups: Sequence[str | None]) -> Repeats:
    """The same of several instruments, whose rows never repeat one another."""
    each = [repeats_of(some, column) for some, column in zip(measured.sets, groups, strict=True)]
    before = np.cumsum([0, *(len(again.sizes) for again in each)])
    codes = [again.codes + first for again, first in zip(each, before, strict=False)]
    return Repeats(np.concatenate(codes), np.concatenate([again.sizes for again in each]))


def copies_of(samples: Samples) -> NDArray[np.bool_]:
    """Which rows (N,) hold the same joints, columns and labels as an earlier one, to the last digit."""
    numbers = [np.asarray(values) + 0.0 for values in (*samples.joints.T, *samples.columns.values())]  # no -0.0
    codes = [labels.codes for labels in samples.labels.values()]
    bits = [*(values.view(np.int64) for values in numbers), *(code.astype(np.int64) for code in codes)]
    _, first, groups = np.unique(_keys(len(samples), bits), return_index=True, return_inverse=True)
    earlier = first[groups.ravel()]
    again = earlier < np.arange(len(samples))
    columns: list[NDArray[Any]] = [*numbers, *codes]
    for values in columns:
        again &= values == values[earlier]
    return np.asarray(again)


def without_copies(samples: Samples) -> Samples:
    """The same rows of one instrument, each once."""
    again = copies_of(samples)
    return samples.take(np.flatnonzero(~again)) if again.any() else samples


def _keys(count: int, columns: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    """One number for each row (N,), by which a million sort at once; two rows share one by a chance of 1e-7."""
    keys = np.zeros(count, dtype=np.int64)
    with np.errstate(over="ignore"):
        for column in columns:
            keys = (keys + column) * MIX
            keys ^= keys >> 29
    return keys

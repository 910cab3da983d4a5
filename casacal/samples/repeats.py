"""Touches of the same place in the same posture: repeats, which tell pure error from what the model leaves out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
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
    # one number for each row, by which a million sort at once; two different rows share one by a chance of 1e-7
    keys = np.zeros(len(samples), dtype=np.int64)
    with np.errstate(over="ignore"):
        for column in places.T:
            keys = (keys + column) * MIX
            keys ^= keys >> 29
    _, codes, sizes = np.unique(keys, return_inverse=True, return_counts=True)
    return Repeats(np.asarray(codes, dtype=np.intp).ravel(), np.asarray(sizes, dtype=np.intp))

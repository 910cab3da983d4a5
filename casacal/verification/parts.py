"""Parts of the rows that are told by themselves: faces, and blocks of the volume that the tip was in."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array

FEWEST = 12
"""Rows of a part that are told with an interval of their own."""

NARROW = 0.25
"""Part of the longest side of the volume below which another side is not divided."""

ROUND = 10.0
"""Multiple of mm at which the volume is divided."""


def blocks(tips: Array) -> dict[str, NDArray[np.intp]]:
    """Rows of each block of the volume of some tips (N, 3; mm in the base frame), by its name.

    The two longest sides are halved at a round number near the median, or the longest alone; nothing where a half has
    too few rows.
    """
    sides = np.quantile(tips, 0.95, axis=0) - np.quantile(tips, 0.05, axis=0)
    longest = [int(k) for k in np.argsort(-sides, kind="stable")[:2] if sides[k] > max(NARROW * sides.max(), ROUND)]
    for axes in (longest, longest[:1]):
        found = _halved(tips, axes)
        if len(found) > 1 and all(len(rows) >= FEWEST for rows in found.values()):
            return found
    return {}


def _halved(tips: Array, axes: list[int]) -> dict[str, NDArray[np.intp]]:
    at = {k: ROUND * round(float(np.median(tips[:, k])) / ROUND) for k in axes}
    found = {}
    for sides in product((False, True), repeat=len(axes)):
        inside = np.ones(len(tips), dtype=bool)
        for k, far in zip(axes, sides, strict=True):
            inside &= (tips[:, k] > at[k]) == far
        words = (f"{'xyz'[k]} {'above' if far else 'up to'} {at[k]:.0f} mm" for k, far in zip(axes, sides, strict=True))
        found[", ".join(words)] = np.flatnonzero(inside)
    return found

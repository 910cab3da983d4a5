"""Means of values over small squares of a plane: maps of many points that stay small."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array


@dataclass(frozen=True)
class Squares:
    """Lower left corners (k,) of squares that hold a point, their side, and the mean of the values in each (k,)."""

    x: Array
    y: Array
    side: float
    values: Array


def in_squares(points: Array, values: Array, most: int) -> Squares:
    """Means of values (N,) over squares that points (N, 2) fall into, `most` of them along the longer side."""
    low = points.min(axis=0)
    side = max(float(np.ptp(points, axis=0).max()) / most, 1e-9) * (1 + 1e-9)
    place = np.floor((points - low) / side).astype(np.int64)
    distinct, which = np.unique(place, axis=0, return_inverse=True)
    which = which.ravel()
    mean = np.bincount(which, weights=values) / np.bincount(which)
    return Squares(low[0] + side * distinct[:, 0], low[1] + side * distinct[:, 1], side, mean)

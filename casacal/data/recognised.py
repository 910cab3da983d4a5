"""Fitted rows recognised among others by their listing, and copies among fresh ones: neither tells anything new."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from casacal.data.columns import Dimension
from casacal.data.repeats import GRID, on_grid
from casacal.data.samples import Layout, Samples
from casacal.values import Array, Rows

WHOLE = re.compile("-?[0-9]{1,17}")

NEAR_JOINT: Mapping[Dimension, float] = {"angle": math.radians(0.02), "length": 0.02, "number": 0.02}
"""Joint values (rad, mm) nearer than this are those of one posture: decimals cut, another unit, a pendant read off."""

PASTED = 0.5
"""Part of the rows in fitted postures that read the same, below which they were touched again, and agree by chance."""

NEAR_READING = 2  # steps of the grid within which two readings are one: 0.002 mm, a fraction of any dial's noise


def is_listing(listed: Mapping[str, Any]) -> bool:
    """Whether a mapping has the form that `listing` gives it."""
    rows, columns, values = (listed.get(key) for key in ("rows", "columns", "values"))
    if not isinstance(rows, int) or isinstance(rows, bool) or not isinstance(columns, list):
        return False
    if not isinstance(values, list) or not values or not all(isinstance(each, str) for each in (*columns, *values)):
        return False
    if not len(values) <= rows < 2**53 or len({len(line.split()) for line in values}) != 1:
        return False
    return all(WHOLE.fullmatch(word) for line in values for word in line.split())


def fitted_among(samples: Samples, layout: Layout, listed: Mapping[str, Any]) -> tuple[Rows, float]:
    """Mask (N,) of rows that are listed, and the fraction of the N that were fitted: larger where not all are listed.

    Rows of an instrument with other columns are never those that were fitted.
    """
    nobody = np.zeros(len(samples), dtype=bool), 0.0
    known = np.array([line.split() for line in listed["values"]], dtype=np.float64)
    near = np.full(len(layout.joints) + len(layout.columns), float(NEAR_READING))  # without readings, joints are
    if layout.columns:
        near[: len(layout.joints)] = _near_joints(layout)
    if sorted(layout.columns) != sorted(listed["columns"]) or known.shape[1] != near.size:
        return nobody
    same = _near_any(known, on_grid(samples, layout), near)
    if layout.columns and same.sum() < PASTED * in_fitted_postures(samples, layout, listed).sum():
        return nobody
    return same, float(same.mean()) * listed["rows"] / len(known)


def in_fitted_postures(samples: Samples, layout: Layout, listed: Mapping[str, Any]) -> Rows:
    """Which rows (N,) are in a posture of listed ones, whatever was read there."""
    known, n = np.array([line.split() for line in listed["values"]], dtype=np.float64), len(layout.joints)
    if known.shape[1] < n:
        return np.zeros(len(samples), dtype=bool)
    return _near_any(known[:, :n], on_grid(samples, layout)[:, :n], np.array(_near_joints(layout), dtype=np.float64))


def _near_joints(layout: Layout) -> list[int]:
    """Steps of the grid within which joint values are those of one posture."""
    return [round(NEAR_JOINT[kind] / GRID[kind]) for kind in layout.joints]


def _near_any(known: Array, rows: Array, near: Array) -> Rows:
    """Mask (N,) of rows (N, m) within `near` (m,) of some known row (M, m) in every column."""
    from scipy.spatial import cKDTree  # takes its time, and few ask

    scale = near + 0.5  # half a step more is rounding
    distance, _ = cKDTree(known / scale).query(rows / scale, p=np.inf, distance_upper_bound=1.0)
    return np.asarray(np.isfinite(distance))


def copies(samples: Samples) -> Rows:
    """Which rows (N,) say once more, to the last digit of joints and readings, what an earlier one says.

    Rows that were pasted are copies; touches that were made again may agree by chance where a dial is coarse, and then
    count. So all rows are taken to be pasted as often as all of them stand there; what repeats beyond that are copies
    unless touches of some posture differ, which shows that postures were touched again.
    """
    joints = np.unique(samples.joints, axis=0, return_inverse=True)[1].ravel()
    values = np.column_stack([joints, *samples.columns.values()])
    _, codes, sizes = np.unique(values, axis=0, return_inverse=True, return_counts=True)
    codes, before = codes.ravel(), np.empty(len(samples), dtype=np.intp)  # how many earlier rows are the same
    before[np.argsort(codes, kind="stable")] = np.arange(len(codes)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    if len(sizes) > joints.max(initial=-1) + 1:  # some posture has two readings
        times = int(np.gcd.reduce(sizes))
        return before >= (sizes // times)[codes]
    return before > 0

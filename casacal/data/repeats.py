"""Rows that come back: repeated touches of one place, copies of whole rows, and fitted rows known by their listing."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.data.columns import Dimension
from casacal.data.samples import Layout, Measurements, Samples
from casacal.values import Array, Index, Rows

SAME = 1e-4  # joint values (rad, mm) that round to the same multiple of this are those of one posture
MIX = np.int64(0x2545F4914F6CDD1D)  # an odd number of 64 bits whose products look random (Vigna, xorshift*, 2016)


@dataclass(frozen=True, eq=False)
class Repeats:
    """Repeated rows: the group of each row (N,), and the number of rows in each group (G,)."""

    codes: Index
    sizes: Index

    @property
    def any(self) -> bool:
        """Whether any row repeats another."""
        return len(self.sizes) < len(self.codes)

    def summed(self, values: Array) -> Array:
        """Sums (G,) of values (N,) over each group."""
        return np.bincount(self.codes, values, len(self.sizes)).astype(np.float64)


def repeats_in(measured: Measurements, groups: Sequence[str | None]) -> Repeats:
    """Rows of the same joint values, to 1e-4 rad or mm, on the same face of the same instrument."""
    codes, sizes, before = [], [], 0
    for some, column in zip(measured.sets, groups, strict=True):
        places = np.column_stack([np.round(some.joints / SAME), some.faces(column).codes]).astype(np.int64)
        _, own, counts = np.unique(_keys(len(some), places.T), return_inverse=True, return_counts=True)
        codes.append(own.ravel().astype(np.intp) + before)
        sizes.append(counts.astype(np.intp))
        before += len(counts)
    return Repeats(np.concatenate(codes), np.concatenate(sizes))


def copies_of(samples: Samples) -> Rows:
    """Which rows (N,) equal an earlier one to the last digit; a touch whose purpose is "again" is no copy."""
    told = _numbers_of(samples).values()
    numbers = [np.asarray(values) + 0.0 for values in (*samples.joints.T, *samples.columns.values(), *told)]  # no -0.0
    codes = [labels.codes for labels in samples.labels.values()]
    purposes = samples.extra.get("purpose", ("",) * len(samples))
    repeated = np.array([cell == "again" for cell in purposes], dtype=bool)
    bits = [*(values.view(np.int64) for values in numbers), *(code.astype(np.int64) for code in codes)]
    _, first, groups = np.unique(_keys(len(samples), bits), return_index=True, return_inverse=True)
    earlier = first[groups.ravel()]
    again = earlier < np.arange(len(samples))
    columns: list[NDArray[Any]] = [*numbers, *codes]
    for values in columns:
        again &= values == values[earlier]
    return np.asarray(again & ~repeated)


RECORDED, AT_REST = 8, 3e-4  # lines in a row that only a recorder writes at a standstill; noise of its joints (rad, mm)
LEAP = 0.25  # part of the range of such a column by which it changes where somebody changed it
ALIKE = 0.1  # range (mm, rad, number) of a column over a standstill within which its mean is meant even near zero


def standstills(samples: Samples) -> Index:
    """Which standstill (N,) each line is of, as a recorder writes them; each of its own where most are not so."""
    count = len(samples)
    codes = np.column_stack([np.zeros(count), *(labels.codes for labels in samples.labels.values())])
    begins = [0]
    moved = (np.abs(np.diff(samples.joints, axis=0)) > AT_REST).any(axis=1) | (np.diff(codes, axis=0) != 0).any(axis=1)
    purposes = samples.extra.get("purpose", ("",) * count)
    moved |= np.array([one != two for one, two in itertools.pairwise(purposes)], dtype=bool)
    for values in _numbers_of(samples).values():  # such as a load that is changed while the arm stands
        if len(np.unique(values)) * RECORDED <= count:  # not measured ones, which are all a little different
            moved |= np.abs(np.diff(values)) > LEAP * np.ptp(values)
    begins += (np.flatnonzero(moved) + 1).tolist()
    sizes = np.diff([*begins, count])
    recorded = set(purposes) != {"again"} and 2 * sizes[sizes >= RECORDED].sum() > count
    return np.repeat(np.arange(len(sizes)), sizes) if recorded else np.arange(count)


def once_each(samples: Samples) -> Samples:
    """A row for each standstill of a recording: the mean of its lines, or the middle one where signs or turns jump."""
    codes = standstills(samples)
    sizes = np.bincount(codes)
    if len(sizes) == len(samples):
        return samples
    first = np.cumsum(sizes) - sizes
    middle, columns = samples.take(first + sizes // 2), dict[str, Array]()
    jumps = np.zeros(len(sizes), dtype=bool)
    for values in samples.columns.values():
        span = np.maximum.reduceat(values, first) - np.minimum.reduceat(values, first)
        jumps |= (span > ALIKE) & (span > np.maximum.reduceat(np.abs(values), first))
    for name, values in samples.columns.items():
        columns[name] = np.where(jumps, middle.columns[name], np.add.reduceat(values, first) / sizes)
    joints = np.add.reduceat(samples.joints, first, axis=0) / sizes[:, None]
    told = {name: np.add.reduceat(values, first) / sizes for name, values in _numbers_of(samples).items()}
    return replace(middle, joints=joints, columns=columns, extra={**middle.extra, **told})


def _numbers_of(samples: Samples) -> dict[str, Array]:
    """Further columns (N,) of numbers, which terms ask for; somebody's own column of purposes is none."""
    found = {name: values for name, values in samples.extra.items() if isinstance(values, np.ndarray)}
    return {name: values for name, values in found.items() if name != "purpose"}


def without_copies(samples: Samples) -> Samples:
    """The rows of one instrument without copies, and each standstill of a recording once."""
    samples = once_each(samples)
    again = copies_of(samples)
    return samples.take(np.flatnonzero(~again)) if again.any() else samples


def _keys(count: int, columns: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Hash of each row (N,), for fast sorting; the chance that two different rows share one is 1e-7."""
    keys = np.zeros(count, dtype=np.int64)
    with np.errstate(over="ignore"):
        for column in columns:
            keys = (keys + column) * MIX
            keys ^= keys >> 29
    return keys


MOST = 2000  # rows that are listed; of more, so many evenly spread ones

GRID: Mapping[Dimension, float] = {"angle": 1e-6, "length": 1e-3, "number": 1e-3}  # steps (rad, mm) of listed values

LARGEST = 2.0**53  # steps beyond which numbers are no whole ones


def listing(samples: Samples, layout: Layout) -> dict[str, Any]:
    """Fingerprint of fitted rows in result.json, by which they are recognised later.

    Number of rows, the instrument's columns, and a line of integers a row, joints first, in 1e-6 rad and 0.001 mm.
    """
    spread = np.unique(np.linspace(0, len(samples) - 1, min(len(samples), MOST)).round().astype(np.intp))
    lines = [" ".join(map(str, map(int, row))) for row in on_grid(samples.take(spread), layout).tolist()]
    return {"rows": len(samples), "columns": sorted(layout.columns), "values": lines}


def on_grid(samples: Samples, layout: Layout) -> Array:
    """Joint values and readings (N, n + c) as whole numbers of steps."""
    names = sorted(layout.columns)
    values = [*samples.joints.T, *(samples.columns[name] for name in names)]
    kinds = [*layout.joints, *(layout.columns[name] for name in names)]
    whole = np.column_stack([np.round(value / GRID[kind]) for value, kind in zip(values, kinds, strict=True)])
    return np.asarray(np.clip(whole, -LARGEST, LARGEST))


WHOLE = re.compile("-?[0-9]{1,17}")

NEAR_JOINT: Mapping[Dimension, float] = {"angle": math.radians(0.02), "length": 0.02, "number": 0.02}
"""Joint values (rad, mm) nearer than this are those of one posture: decimals cut, another unit, a pendant read off."""

PASTED = 0.5  # part of the rows in fitted postures that read the same, below which they were touched again

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

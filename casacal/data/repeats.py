"""Rows that come back: repeated touches of one place, copies of whole rows, and a listing to know them by later."""

from __future__ import annotations

import itertools
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
    numbers = [np.asarray(values) + 0.0 for values in (*samples.joints.T, *samples.columns.values())]  # no -0.0
    codes = [labels.codes for labels in samples.labels.values()]
    if "purpose" in samples.extra:
        codes.append(np.array([cell == "again" for cell in samples.extra["purpose"]], dtype=np.intp))
    bits = [*(values.view(np.int64) for values in numbers), *(code.astype(np.int64) for code in codes)]
    _, first, groups = np.unique(_keys(len(samples), bits), return_index=True, return_inverse=True)
    earlier = first[groups.ravel()]
    again = earlier < np.arange(len(samples))
    columns: list[NDArray[Any]] = [*numbers, *codes]
    for values in columns:
        again &= values == values[earlier]
    return np.asarray(again)


RECORDED, AT_REST = 8, 3e-4
"""Lines one after another that a recorder, and no hand, writes of one standstill; noise of its joints (rad, mm)."""
ALIKE = 0.1  # range (mm, rad, number) of a column over a standstill within which its mean is meant even near zero


def standstills(samples: Samples) -> Index:
    """Which standstill (N,) each line is of, as a recorder writes them; each of its own where most are not so."""
    count = len(samples)
    codes = np.column_stack([np.zeros(count), *(labels.codes for labels in samples.labels.values())])
    begins = [0]
    moved = (np.abs(np.diff(samples.joints, axis=0)) > AT_REST).any(axis=1) | (np.diff(codes, axis=0) != 0).any(axis=1)
    purposes = samples.extra.get("purpose", ("",) * count)
    moved |= np.array([one != two for one, two in itertools.pairwise(purposes)], dtype=bool)
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
    return replace(middle, joints=joints, columns=columns)


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

GRID: Mapping[Dimension, float] = {"angle": 1e-6, "length": 1e-3, "number": 1e-3}
"""Steps (rad, mm) to which listed values are rounded."""

LARGEST = 2.0**53  # steps beyond which numbers are no whole ones


def listing(samples: Samples, layout: Layout) -> dict[str, Any]:
    """Fingerprint of fitted rows in result.json, by which they are recognised later.

    Number of rows, names of the instrument's columns, and a line of integers for each row, joints first, in steps of
    1e-6 rad and 0.001 mm.
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

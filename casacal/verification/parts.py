"""Parts of the rows that are judged by themselves: faces, and blocks of the volume; the arm's error in each."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.verification.arm_error import Seen
from casacal.verification.decision import Scatter
from casacal.verification.figures import INTERVAL, ErrorInterval, PartError

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


def errors_by_part(seen: Seen, drawn: Array) -> tuple[PartError, ...]:
    """Errors of all rows, then of faces and of regions where there are several with rows enough.

    Args:
        seen: what the rows see.
        drawn: unknowns (n,) of the arm as drawn, those of the rows fitted.

    """
    bound, x = seen.fresh.bound, seen.fresh.x
    pair = seen.residual(drawn), seen.residual(x)
    faces = bound.block.samples.faces(bound.problem.instrument.groups)
    everything: NDArray[np.intp] = np.arange(len(faces))
    asked = [("all", "all rows", everything)]
    if len(faces.names) > 1:
        asked += [("face", label, rows) for label, rows in faces.rows().items() if len(rows) >= FEWEST]
    asked += [("region", label, rows) for label, rows in blocks(bound.tips(x, bound.block.samples.joints)).items()]
    found = []
    for kind, label, rows in asked:
        before, after = (seen.scatter(residual, rows) for residual in pair)
        if before is not None and after is not None:
            here = interval(before), interval(after)
            found.append(PartError(kind, label, len(rows), *here, seen.promised_mm(rows)))
    return tuple(found)


def interval(scatter: Scatter) -> ErrorInterval:
    """The error that rows show, and the interval that holds it with a chance of 95 %."""
    beyond = (1 - INTERVAL) / 2
    return ErrorInterval(scatter.measured_mm, scatter.lower_mm(beyond), scatter.upper_mm(beyond))

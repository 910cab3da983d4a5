"""Conventions that mean the same: equal poses at all joint values, as the twin of every spherical wrist has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.doctor.axes import Axes
from casacal.doctor.family import Family, Integers
from casacal.doctor.search import poses_of
from casacal.robots.conventions import Conventions

SAME = 1e-6
"""Difference (mm; rad) at random joint values below which two conventions are one."""
COMPARED = 24
"""Random joint values at which they are compared."""
MOST_MEANINGS = 48
"""Different meanings that are told apart; when more fit, the rows say next to nothing."""


@dataclass(frozen=True)
class Meaning:
    """One meaning of the controller's joint values, and all ways to write it that fit the rows.

    conventions: the simplest first. reading: the same as an entry of the family (n, 4). joint_unit, length_unit: of the
    numbers shown. rotations: which conventions of orientation fit the rows, with the worst miss in rad. miss_mm: worst
    of the positions.
    """

    conventions: tuple[Conventions, ...]
    reading: Integers
    joint_unit: str
    length_unit: str
    rotations: Mapping[tuple[str, str], float]
    miss_mm: float

    @property
    def simplest(self) -> Conventions:
        """The way to write it with the fewest changes from plain."""
        return self.conventions[0]

    @property
    def family(self) -> Family:
        """The reading alone, as a family of one."""
        return Family(self.reading[None], np.zeros(1, dtype=bool))


def distinct(axes: Axes, family: Family, seed: int = 0) -> list[NDArray[np.intp]]:
    """Indices of the readings of each meaning, at most `MOST_MEANINGS` of them; decided at random joint values."""
    if not len(family):
        return []
    n = len(axes.turns)
    spread = np.where(axes.turns, np.pi, 500.0)
    q = np.random.default_rng(seed).uniform(-spread, spread, (COMPARED, n))
    turn, place = poses_of(axes, family, q)
    told = np.concatenate([turn.reshape(len(family), -1), place.reshape(len(family), -1)], axis=1)
    groups: list[NDArray[np.intp]] = []
    left = np.arange(len(family))
    while left.size and len(groups) < MOST_MEANINGS:
        same = np.abs(told[left] - told[left[0]]).max(axis=1) < SAME
        groups.append(left[same])
        left = left[~same]
    return groups


def conventions_of(reading: Integers, mixing: Array) -> Conventions | None:
    """A reading (n, 4) as `Conventions` of the robot's own joint values; None when they cannot say it.

    mixing: what the robot's pose does to its joint values (n, n), the identity but for a pose that couples joints.
    """
    sign, quarter, partner, factor = reading.astype(int).T
    n = len(reading)
    matrix = np.diag(sign).astype(np.float64)
    for i in np.flatnonzero(partner >= 0):
        matrix[i, partner[i]] = sign[i] * factor[i]
    matrix = np.round(np.linalg.solve(mixing, matrix))
    if (np.abs(np.diagonal(matrix)) != 1).any():
        return None
    signs = np.diagonal(matrix).astype(int)
    turned = np.round(np.linalg.solve(mixing, quarter.astype(np.float64)))
    quarters = 2 - (2 - turned) % 4  # of all that mean the same, -1, 0, 1 or 2
    couplings = [(i, j) for i in range(n) for j in range(n) if i != j and matrix[i, j]]
    return Conventions(
        tuple(int(s) for s in signs),
        tuple(float(k) * np.pi / 2 for k in quarters),
        tuple((i + 1, j + 1, float(matrix[i, j] * signs[i])) for i, j in couplings),
    )


def changes(conventions: Conventions) -> tuple[int, int, float, tuple[float, ...]]:
    """How far from plain conventions are, to sort by: settings changed, couplings, size of offsets, their order."""
    shifted = [offset for offset in conventions.offsets if abs(offset) > 1e-9]
    changed = sum(sign < 0 for sign in conventions.signs) + len(shifted) + len(conventions.coupling)
    size = float(sum(abs(offset) for offset in shifted))
    return changed, len(conventions.coupling), size, (*(-s for s in conventions.signs), *conventions.offsets)

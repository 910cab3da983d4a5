"""Conventions that mean the same, and which further pose would tell apart those that do not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.doctor.axes import Axes
from casacal.doctor.family import Family, Integers, one_change_away
from casacal.doctor.pendant_rows import ANGLES, LENGTHS, angle_between
from casacal.doctor.search import poses_of
from casacal.robots.joint_space import inside_limits, random_joints
from casacal.robots.joints import Conventions
from casacal.robots.robot import Robot

SAME = 1e-6  # difference (mm; rad) at random joint values below which two conventions are one
COMPARED = 24  # random joint values at which they are compared
MOST_MEANINGS = 48  # different meanings that are told apart; when more fit, the rows say next to nothing


@dataclass(frozen=True)
class Meaning:
    """One meaning of the controller's joint values, and all ways to write it that fit the rows.

    conventions: the simplest first. reading: the same as an entry of the family (n, 4). joint_unit, length_unit: of the
    numbers shown. rotations: which conventions of the orientation do the rows, with the worst miss, rad. miss_mm: of
    the positions, the worst.
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


def distinct(axes: Axes, family: Family) -> list[NDArray[np.intp]]:
    """Indices of the readings of each meaning, at most `MOST_MEANINGS` of them; decided at random joint values."""
    if not len(family):
        return []
    n = len(axes.turns)
    spread = np.where(axes.turns, np.pi, 500.0)
    q = np.random.default_rng(0).uniform(-spread, spread, (COMPARED, n))
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


TRIED = 300  # random postures among which the most telling one is chosen
TOLD = 5.0  # multiples of the tolerance by which a posture must separate two conventions


@dataclass(frozen=True)
class FurtherPose:
    """Joint values to move to, as the controller shows them (n,), in the joint unit of the simplest meaning.

    separates: part of the pairs of conventions that it tells apart. least_mm, least_rad: what its least different pair
    differs by, the larger of the two in units of the tolerance.
    """

    joints: Array
    separates: float
    least_mm: float
    least_rad: float


def further_pose(
    axes: Axes, robot: Robot, meanings: Sequence[Meaning], tolerance: float, *, seed: int = 0
) -> FurtherPose:
    """The random posture, inside the joint limits as far as they are known, that separates the meanings most.

    A single meaning, held by too few rows, is set against all that differ from it in one joint. Another seed draws
    other postures, so that a pose that is on record already is not proposed again.
    """
    best = meanings[0]
    scale = _scale(axes, best)
    sampled = random_joints(robot, TRIED, np.random.default_rng(seed))
    step = np.where(axes.turns, 1.0 if best.joint_unit == "deg" else 0.01, 1.0 if best.length_unit == "mm" else 0.01)
    shown = np.round(best.simplest.to_controller(sampled) / scale / step) * step
    inside = np.array([inside_limits(robot, m.simplest.to_model(shown * _scale(axes, m))) for m in meanings])
    counts = inside.sum(axis=0)
    shown = shown[counts == counts.max()]
    if len(meanings) == 1:
        family = one_change_away(best.reading, axes.turns)
        rivals = Family(np.concatenate([best.reading[None], family.options]), np.zeros(len(family) + 1, dtype=bool))
        turn, place = poses_of(axes, rivals, shown * scale)
    else:
        told = [poses_of(axes, m.family, shown * _scale(axes, m)) for m in meanings]
        turn = np.concatenate([each[0] for each in told])
        # as the controller shows it: a metre and a millimetre that read alike cannot be told apart
        place = np.concatenate(
            [
                each[1] * LENGTHS[best.length_unit] / LENGTHS[m.length_unit]
                for each, m in zip(told, meanings, strict=True)
            ]
        )
    one, other = np.triu_indices(len(turn), k=1)
    if len(meanings) == 1:
        one, other = one[one == 0], other[one == 0]
    apart = np.linalg.norm(place[one] - place[other], axis=-1), angle_between(turn[one], turn[other])
    size = np.maximum(apart[0] / tolerance, apart[1] / (tolerance * 1e-3))
    twins = size.max(axis=1) < 1e-3
    size, apart = size[~twins], (apart[0][~twins], apart[1][~twins])
    chosen = int(np.lexsort((size.min(axis=0), (size > TOLD).sum(axis=0)))[-1])
    least = int(np.argmin(size[:, chosen]))
    return FurtherPose(
        shown[chosen],
        float((size[:, chosen] > TOLD).mean()),
        float(apart[0][least, chosen]),
        float(apart[1][least, chosen]),
    )


def _scale(axes: Axes, meaning: Meaning) -> Array:
    """From joint values as shown to rad and mm (n,)."""
    return np.where(axes.turns, ANGLES[meaning.joint_unit], LENGTHS[meaning.length_unit])

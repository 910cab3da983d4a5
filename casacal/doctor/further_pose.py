"""Which further pose would tell the conventions apart that still fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.doctor.axes import Axes
from casacal.doctor.family import Family, one_change_away
from casacal.doctor.pendant_rows import ANGLES, LENGTHS
from casacal.doctor.rotations import angle_between
from casacal.doctor.same_arm import Meaning
from casacal.doctor.search import poses_of
from casacal.robots.joint_space import random_joints
from casacal.robots.robot import Robot

TRIED = 300
"""Random postures among which the most telling one is chosen."""
TOLD = 5.0
"""Multiples of the tolerance by which a posture must separate two conventions."""


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
    inside = np.array([_inside(robot, meaning, shown * _scale(axes, meaning)) for meaning in meanings])
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


def _inside(robot: Robot, meaning: Meaning, q: Array) -> NDArray[np.bool_]:
    """Which postures (N, n; rad, mm) a meaning puts inside the joint limits."""
    model = meaning.simplest.to_model(q)
    lower, upper = (np.array([getattr(joint, side) for joint in robot.axes]) for side in ("lower", "upper"))
    return np.asarray(((model >= lower) & (model <= upper)).all(axis=1))

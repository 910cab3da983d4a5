"""Corrected targets as values: joint values, how each row ended, and the proof."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np

from casacal.array_types import Array, Rows
from casacal.compensation.inverse_kinematics import PosedArm
from casacal.compensation.targets import Targets
from casacal.values import Value, frozen


class Outcome(Enum):
    """How a target ended: a closed set of words."""

    REACHED = "reached"
    LIMIT = "at a joint limit"
    SINGULAR = "singular"
    UNREACHABLE = "unreachable"
    OUTSIDE = "outside the joint limits"
    NOT_FINITE = "not finite"

    @property
    def meaning(self) -> str:
        """The word in a sentence."""
        return _MEANINGS[self]


_MEANINGS = {
    Outcome.REACHED: "the calibrated robot takes the pose",
    Outcome.LIMIT: "a joint would have to pass its limit",
    Outcome.SINGULAR: "near a singularity: no small joint motion takes the pose",
    Outcome.UNREACHABLE: "no posture takes the pose",
    Outcome.OUTSIDE: "the target's own joint values are outside the limits",
    Outcome.NOT_FINITE: "the model gives values that are not finite",
}


@dataclass(frozen=True)
class Rounding:
    """How joint values are written: in degrees (else radians; sliding joints in mm), with so many decimals."""

    degrees: bool = True
    decimals: int = 7

    def factors(self, arm: PosedArm) -> Array:
        """From rad and mm to what is written (n,)."""
        return np.where(arm.robot.revolute, 180 / math.pi if self.degrees else 1.0, 1.0)

    def __call__(self, arm: PosedArm, joints: Array) -> Array:
        """Joint values as a reader of the file gets them; inside the limits where they were."""
        factors, unit = self.factors(arm), 10.0**-self.decimals
        lower, upper = (limit * factors for limit in arm.robot.limits)
        written = np.round(joints * factors, self.decimals)
        written = np.where((written > upper + 1e-9 * unit) & (joints * factors <= upper), written - unit, written)
        written = np.where((written < lower - 1e-9 * unit) & (joints * factors >= lower), written + unit, written)
        return np.asarray(np.round(written, self.decimals) / factors)


@dataclass(frozen=True, eq=False, repr=False)
class Compensation(Value):
    """Corrected targets and their proof, one entry per target (N) in each field.

    joints: corrected (N, n; rad, mm), as written. start: nominal joint values (N, n) they began from. outcomes: how
    each ended. residual_mm, residual_rad: miss of the calibrated robot at `joints`, recomputed by `predict`.
    correction_mm: miss at `start`, which the correction removes. correction: largest joint motion from `start`, rad, a
    sliding joint in mm over 300. A row that is not reached holds the nearest joint values within that motion, or its
    start where that would be a jump; NaN for a pose that no start was found for. expected_mm: standard deviation of the
    position that is left, apart from the position of the base.
    """

    targets: Targets
    frame: Literal["flange", "tip"]
    rounding: Rounding
    joints: Array
    start: Array
    outcomes: tuple[Outcome, ...]
    residual_mm: Array
    residual_rad: Array
    correction_mm: Array
    correction: Array
    expected_mm: Array

    def __post_init__(self) -> None:
        frozen(tuple(value for value in vars(self).values() if isinstance(value, np.ndarray)))

    def __repr__(self) -> str:
        return f"<Compensation of {len(self.outcomes)} targets: {int(self.reached.sum())} reached>"

    @property
    def reached(self) -> Rows:
        """Which rows the calibrated robot reaches."""
        return np.array([outcome is Outcome.REACHED for outcome in self.outcomes])

"""What moves the tip of a simulated arm beside its geometry: gears, gravity, warmth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.simulation.joint_errors import GearWave, waved, yielding
from casacal.simulation.reach import Touch

SOON = 3.0
"""Time constants of warming up in one session."""

SETTLED = 10
"""Rounds in which an arm settles under its weight: each leaves a thousandth of the last."""


@dataclass(frozen=True)
class ArmErrors:
    """Errors of one arm.

    waves: of its gears. compliance: sag over the samples, mm RMS. pull: move of the tip, mm RMS over the samples, of
    joints that yield by J' of its height. thermal: growth from the first row of a session to the last, parts of one.
    """

    waves: tuple[GearWave, ...] = ()
    compliance: float = 0.0
    pull: float = 1.0
    thermal: float = 0.0

    def sag(self, touch: Touch, joints: Array, readings: Array) -> Array:
        """Deflections (N, n) under gravity of joints that stand at `joints`."""
        if self.compliance == 0:
            return np.zeros_like(joints)
        return np.asarray(yielding(touch, joints, readings)[0] * self.compliance / self.pull)

    def growth(self, when: Array) -> Array:
        """Times (N,) by which the tip is further from the base at places 0 ... 1 of a session."""
        return np.asarray(1 + self.thermal * (1 - np.exp(-SOON * when)) / (1 - math.exp(-SOON)))

    def tips(self, touch: Touch, joints: Array, readings: Array, when: Array) -> Array:
        """True tips (N, 3; mm) where the controller says `joints` (N, n)."""
        unladen = waved(self.waves, joints)
        standing = unladen
        for _ in range(SETTLED if self.compliance else 0):
            standing = unladen + self.sag(touch, standing, readings)
        tips, _ = touch.place(touch.local, standing, readings[:, None])
        return tips * self.growth(when)[:, None]

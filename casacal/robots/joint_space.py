"""The space of joint values: random ones between the limits, and what a radian weighs against lengths."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.robots.robot import Robot

AXIS_WEIGHT = 300.0
"""Millimetres at the tip that weigh as much as one radian of plunger direction."""


def random_joints(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Joint values (count, n; rad, mm), uniform between the limits."""
    return rng.uniform(*robot.limits, size=(count, len(robot.axes)))

"""The space of joint values: random ones between the limits, and what a radian weighs against lengths."""

from __future__ import annotations

from typing import Any

import numpy as np

from casacal.array_types import Array, Rows
from casacal.errors import CasacalError, came
from casacal.robots.robot import Robot

AXIS_WEIGHT = 300.0  # millimetres at the tip that weigh as much as one radian of plunger direction


def joint_values(q: Any, robot: Robot) -> Array:
    """Joint values (N, n; rad, mm) of an arm from numbers, one row (n,) or several (N, n).

    Raises CasacalError for anything else.
    """
    wanted = f"Give {len(robot.axes)} numbers per row, in rad (sliding joints in mm)"
    try:
        values = np.array(q, dtype=np.float64)
    except (TypeError, ValueError):
        raise CasacalError(f"Got {came(q)} as joint values of '{robot.name}'", wanted) from None
    values = values[None] if values.ndim == 1 else values
    if values.ndim != 2 or values.shape[1] != len(robot.axes):
        raise CasacalError(f"Joint values of '{robot.name}' came with the shape {np.shape(q)}", wanted)
    if not np.isfinite(values).all():
        raise CasacalError(f"A joint value of '{robot.name}' is not finite", wanted)
    return values


def random_joints(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Joint values (count, n; rad, mm), uniform between the limits."""
    return rng.uniform(*robot.limits, size=(count, len(robot.axes)))


def inside_limits(robot: Robot, joints: Array) -> Rows:
    """Which postures (N, n; rad, mm) are inside the limits of all joints (N,)."""
    lower, upper = robot.limits
    return np.asarray(((joints >= lower) & (joints <= upper)).all(axis=1))


def joint_units(robot: Robot) -> Array:
    """What counts as one unit of motion of each joint (n,): a radian, or as many mm as weigh as much."""
    return np.where(robot.revolute, 1.0, AXIS_WEIGHT)

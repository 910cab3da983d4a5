"""Roll, pitch and yaw of a rotation, as URDF and ur_description mean them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from casacal.array_types import Array


def roll_pitch_yaw(matrix: Array, near: Sequence[float] = (0.0, 0.0, 0.0)) -> tuple[float, float, float]:
    """Angles (rad) with RotZ(yaw) RotY(pitch) RotX(roll) = matrix (3, 3), of all such the nearest to `near`.

    Where the pitch is a quarter turn, only the sum or difference of roll and yaw is known: the yaw stays as it is.
    """
    upright = math.hypot(matrix[0, 0], matrix[1, 0])
    yaw = math.atan2(matrix[1, 0], matrix[0, 0]) if upright > 1e-10 else near[2]
    pitch = math.atan2(-matrix[2, 0], upright)
    c, s = math.cos(yaw), math.sin(yaw)
    roll = math.atan2(s * matrix[0, 2] - c * matrix[1, 2], c * matrix[1, 1] - s * matrix[0, 1])
    twins = ((roll, pitch, yaw), (roll + math.pi, math.pi - pitch, yaw + math.pi))
    turned = [_wrapped(twin, near) for twin in twins]
    return min(turned, key=lambda angles: sum((a - b) ** 2 for a, b in zip(angles, near, strict=True)))


def _wrapped(angles: Sequence[float], near: Sequence[float]) -> tuple[float, float, float]:
    """Angles less whole turns, each within half a turn of `near`."""
    x, y, z = (a - 2 * math.pi * round((a - b) / (2 * math.pi)) for a, b in zip(angles, near, strict=True))
    return x, y, z

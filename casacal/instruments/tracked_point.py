"""A point on the flange, read by a laser tracker or another device that sees three coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.dial_parts import tool_point
from casacal.instruments.instrument import Dimension, Instrument, Sight, Words
from casacal.kinematics import Expression, transform_point
from casacal.unknowns import Frame, Parameter, Unknown
from casacal.unknowns.fits import rotation_between


@dataclass(frozen=True, kw_only=True)
class TrackedPoint(Instrument):
    """A reflector on the flange whose x, y, z are read in the tracker's own frame; three residuals per row.

    Args:
        noise_std: standard deviation of each coordinate, mm.
        tool: the reflector in the flange frame, mm.
        station: transform from the robot's base to the tracker's frame; proposed from the data when not given.

    """

    noise_std: float
    tool: Parameter = tool_point()
    station: Frame = Frame()

    def __post_init__(self) -> None:
        if not 0 < self.noise_std < math.inf:
            raise ProblemError(f"noise_std of the tracker is {self.noise_std!r}", "Give a positive number of mm")

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """x, y, z in the tracker's frame."""
        return {"x": "length", "y": "length", "z": "length"}

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Reflector and station."""
        return {"tool": self.tool, "station": self.station}

    @property
    def datum(self) -> tuple[str, ...]:
        """The station."""
        return ("station",)

    @property
    def residual_std(self) -> float:
        """Noise of each coordinate, mm."""
        return self.noise_std

    @property
    def words(self) -> Words:
        """Coordinates of points."""
        return Words("residual of each coordinate", "mm", "points", "station fitted alone", accuracy=True)

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Return the reflector in the base frame (3, mm)."""
        del row
        return transform_point(pose, p.tool)

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Predicted minus read coordinates (3, mm)."""
        return transform_point(p.station, self.tip(pose, p, row)) - ca.vertcat(row.x, row.y, row.z)

    def propose(self, key: str, sight: Sight) -> Array:
        """Rigid fit of the nominal tips to the read points (Arun, Huang and Blostein 1987)."""
        if key != "station":
            return super().propose(key, sight)
        read = np.column_stack([sight.columns[name] for name in ("x", "y", "z")])
        turn, fixed = rotation_between(sight.tips - sight.tips.mean(axis=0), read - read.mean(axis=0))
        if len(read) < 3 or not fixed:
            raise ProblemError(
                "The tracked points lie on a line", "Track at least three points that do not lie on one line"
            )
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        matrix[:3, 3] = read.mean(axis=0) - turn @ sight.tips.mean(axis=0)
        return Frame.encode(matrix)

"""A point on the flange, read by a laser tracker or another device that sees three coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.instrument import Dimension, Sight, Suspect, Words
from casacal.instruments.tool_tip import ToolTip
from casacal.kinematics import Expression, transform_point
from casacal.unknowns import Frame, Unknown
from casacal.unknowns.fits import rigid_fit


@dataclass(frozen=True, kw_only=True)
class TrackedPoint(ToolTip):
    """A reflector on the flange whose x, y, z are read in the tracker's own frame; three residuals per row.

    Args:
        noise_std: standard deviation of each coordinate, mm.
        tool: the reflector in the flange frame, mm.
        station: transform from the robot's base to the tracker's frame; proposed from the data when not given.

    """

    station: Frame = Frame()

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
    def suspects(self) -> tuple[Suspect, ...]:
        """Units, and a mirrored frame."""
        cause = "the points seem to come in a left-handed frame: one axis counted the other way, or two exchanged"
        fix = "Export them in a right-handed frame, or correct the column that is wrong"
        return (*super().suspects, Suspect("left-handed frame", cause, fix, ("z",), -1.0))

    @property
    def words(self) -> Words:
        """Coordinates of points."""
        return Words("residual of each coordinate", "mm", "points", "station fitted alone", accuracy=True)

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Predicted minus read coordinates (3, mm)."""
        return transform_point(p.station, self.tip(pose, p, row)) - ca.vertcat(row.x, row.y, row.z)

    def propose(self, key: str, sight: Sight) -> Array:
        """Rigid fit of the nominal tips to the read points (Arun, Huang and Blostein 1987)."""
        if key != "station":
            return super().propose(key, sight)
        matrix = rigid_fit(sight.tips, np.column_stack([sight.columns[name] for name in ("x", "y", "z")]))
        if matrix is None:
            raise ProblemError(
                "The tracked points lie on a line", "Track at least three points that do not lie on one line"
            )
        return Frame.encode(matrix)

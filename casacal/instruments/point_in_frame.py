"""What instruments share that compare a tip with a point whose x, y, z are given in a frame of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.instrument import Sight
from casacal.instruments.tool_tip import ToolTip
from casacal.kinematics import Expression, transform_point
from casacal.unknowns import Frame, Unknown
from casacal.unknowns.fits import rigid_fit

AXES = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class PointInFrame(ToolTip):
    """A tip and the coordinates x, y, z (mm) of where it stands in another frame; three residuals per row.

    station: transform from the robot's base to that frame; proposed from the data when not given.
    """

    station: Frame = Frame()

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Tip and frame."""
        return {"tool": self.tool, "station": self.station}

    @property
    def datum(self) -> tuple[str, ...]:
        """The frame."""
        return ("station",)

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Predicted minus given coordinates (3, mm)."""
        return transform_point(p.station, self.tip(pose, p, row)) - ca.vertcat(row.x, row.y, row.z)

    def propose(self, key: str, sight: Sight) -> Array:
        """Rigid fit of the nominal tips to the points (Arun, Huang and Blostein 1987); ProblemError on a line."""
        if key != "station":
            return super().propose(key, sight)
        matrix = rigid_fit(sight.tips, np.column_stack([sight.columns[axis] for axis in AXES]))
        if matrix is None:
            raise ProblemError(
                f"The points of {type(self).__name__} lie on a line",
                "Measure at least three points that do not lie on one line",
            )
        return Frame.encode(matrix)

"""Points whose three coordinates are read by a tracker, or known on a plate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.description import Dimension, Sight, Suspect, Words
from casacal.instruments.tool_tip import ToolTip
from casacal.kinematics import Expression, transform_point
from casacal.unknowns import Frame, Unknown
from casacal.unknowns.fits import rigid_fit
from casacal.values import FrozenMapping, is_real

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


@dataclass(frozen=True, kw_only=True)
class TrackedPoint(PointInFrame):
    """A reflector on the flange whose x, y, z are read in the tracker's own frame; three residuals per row.

    Args:
        noise_std: standard deviation of each coordinate, mm.
        tool: the reflector in the flange frame, mm.
        station: transform from the robot's base to the tracker's frame; proposed from the data when not given.

    """

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """x, y, z in the tracker's frame."""
        return {"x": "length", "y": "length", "z": "length"}

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Units, and a mirrored frame."""
        cause = "the points seem to come in a left-handed frame: one axis counted the other way, or two exchanged"
        fix = "Export them in a right-handed frame, or correct the column that is wrong"
        return (*super().suspects, Suspect("left-handed frame", cause, fix, ("z",), -1.0))

    @property
    def words(self) -> Words:
        """Coordinates of points."""
        by = self.station.per or Words.group
        return Words("residual of each coordinate", "mm", "points", "station fitted alone", group=by, accuracy=True)


@dataclass(frozen=True, kw_only=True)
class KnownPoint(PointInFrame):
    """A tip brought to points of a plate, which the column "point" names; three residuals per row.

    Args:
        noise_std: how well the tip is brought to a point, each coordinate, mm.
        points: where each point stands on the plate (3, mm), by its label; three that do not lie on one line at least.
        tool: the tip in the flange frame, mm.
        station: transform from the robot's base to the plate's frame; proposed from the data when not given. Its
            inverse is the plate as a work object.

    Raises ProblemError for points that do not fix where the plate is.

    """

    points: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.points.items() if isinstance(self.points, Mapping) else [("", self.points)]
        for label, point in given:
            if not isinstance(point, (tuple, list, np.ndarray)) or len(point) != 3 or not all(map(_is_finite, point)):
                raise ProblemError(
                    f"Point '{label}' of the plate is {point!r}", "Give x, y and z of each point in mm, by its label"
                )
        triples = {str(label): tuple(float(value) for value in point) for label, point in given}
        object.__setattr__(self, "points", FrozenMapping(triples))
        known = np.array(list(triples.values())).reshape(-1, 3)
        if len(known) < 3 or np.linalg.matrix_rank(known - known.mean(axis=0), tol=1e-6) < 2:
            raise ProblemError(
                f"The plate has {len(known)} points, and they do not say how it lies",
                "Give three or more that do not lie on one line",
            )

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Coordinates of the row's point on the plate, mm."""
        return {axis: {label: point[i] for label, point in self.points.items()} for i, axis in enumerate(AXES)}

    @property
    def known_by(self) -> str:
        """The point."""
        return "point"

    @property
    def knows_every_label(self) -> bool:
        """True: a point that is not listed stands nowhere."""
        return True

    @property
    def groups(self) -> str:
        """The point."""
        return "point"

    @property
    def words(self) -> Words:
        """Coordinates of points."""
        return Words("residual of each coordinate", "mm", "points", "plate fitted alone", group="point", accuracy=True)


def _is_finite(value: object) -> bool:
    return is_real(value) and bool(np.isfinite(value))  # type: ignore[call-overload]

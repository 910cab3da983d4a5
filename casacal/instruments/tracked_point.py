"""A point on the flange, read by a laser tracker or another device that sees three coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from casacal.instruments.instrument import Dimension, Words
from casacal.instruments.point_in_frame import PointInFrame
from casacal.instruments.suspect import Suspect


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

"""A tool's tip brought to the same place from many sides: a spike, or a ball in sockets a known way apart."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.description import Sight, Words
from casacal.instruments.tool_tip import ToolTip, proposed_point
from casacal.kinematics import Expression
from casacal.unknowns import Direction, Parameter, Unknown
from casacal.values import FrozenMapping, is_real


@dataclass(frozen=True, kw_only=True)
class FixedPoint(ToolTip):
    """A tip that comes to one point for each value of the column "point", in many postures; three residuals per row.

    Without that column there is one point. With the arm held (`Problem.fix`), four touches of a spike give the tool.
    Points have no size: how large the arm is comes from its prior, unless something beside it is a known length.

    Args:
        noise_std: how well the tip is brought to the point, each coordinate, mm.
        tool: the tip in the flange frame, mm.
        point: the point in the base frame, mm; proposed from the data when not given.

    """

    point: Parameter = proposed_point("point")

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Tip and points."""
        return {"tool": self.tool, "point": self.point}

    @property
    def datum(self) -> tuple[str, ...]:
        """The points."""
        return ("point",)

    @property
    def words(self) -> Words:
        """Coordinates about a point."""
        return Words("distance from the points", "mm", "touches", "points fitted alone", group="point")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """From the point to the tip (3, mm)."""
        return self.tip(pose, p, row) - p.point

    def propose(self, key: str, sight: Sight) -> Array:
        """Return the mean of the nominal tips."""
        return np.asarray(sight.tips.mean(axis=0)) if key == "point" else super().propose(key, sight)


@dataclass(frozen=True, kw_only=True)
class Sockets(ToolTip):
    """A ball put by hand into sockets along a bar, which stands at one or several places; three residuals per row.

    The way between two sockets is known, which makes the size of the arm known. Columns "socket" and "place" say which
    socket of which place a row is of; without the latter there is one place.

    Args:
        noise_std: how well the ball comes to rest, each coordinate, mm.
        along: where each socket stands along the bar, mm, by its label; two at least.
        tool: the centre of the ball in the flange frame, mm.
        start: the bar's zero at each place in the base frame, mm; proposed from the data when not given.
        bar: the bar's direction at each place; proposed from the data when not given.

    Raises ProblemError for fewer than two sockets, and for two at the same place.

    """

    along: Mapping[str, float] = field(default_factory=dict)
    start: Parameter = proposed_point("place")
    bar: Direction = Direction(None, per="place")

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.along if isinstance(self.along, Mapping) else {}
        along = {str(label): float(value) for label, value in given.items() if is_real(value) and math.isfinite(value)}
        object.__setattr__(self, "along", FrozenMapping(along))
        if len(set(along.values())) < max(len(given), 2):
            raise ProblemError(
                f"The sockets stand at {dict(given) or self.along} along the bar",
                'Give two places or more, such as {"0": 0, "1": 50}',
            )

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Ball, and where the bar stands and points."""
        return {"tool": self.tool, "start": self.start, "bar": self.bar}

    @property
    def datum(self) -> tuple[str, ...]:
        """The bar."""
        return ("start", "bar")

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """How far along the bar the row's socket stands, mm."""
        return {"along": self.along}

    @property
    def known_by(self) -> str:
        """The socket."""
        return "socket"

    @property
    def knows_every_label(self) -> bool:
        """True: a socket that is not listed stands nowhere."""
        return True

    @property
    def words(self) -> Words:
        """Coordinates about a socket."""
        return Words("distance from the sockets", "mm", "rests", "sockets fitted alone", group="place")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """From the socket to the ball's centre (3, mm)."""
        return self.tip(pose, p, row) - (p.start + row.along * p.bar)

    def propose(self, key: str, sight: Sight) -> Array:
        """Line through the nominal tips by their sockets; raises ProblemError where a place has one socket alone."""
        if key not in self.datum:
            return super().propose(key, sight)
        along = sight.columns["along"]
        apart = along - along.mean()
        towards = apart @ sight.tips
        if not np.ptp(along) or not np.linalg.norm(towards) > 1e-9:
            raise ProblemError(
                "Some place of the bar has rows of one socket alone", "Put the ball into two sockets at every place"
            )
        way = towards / np.linalg.norm(towards)
        return Direction.encode(way) if key == "bar" else np.asarray(sight.tips.mean(axis=0) - along.mean() * way)

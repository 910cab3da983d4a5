"""Lengths from anchors to a point on the flange: a draw wire, a ball bar, a telescoping bar."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.description import Dimension, Sight, Suspect, Words
from casacal.instruments.tool_tip import ToolTip, centre_of, proposed_point
from casacal.kinematics import Expression
from casacal.unknowns import Parameter, Unknown

FEWEST = 5
"""Rows of an anchor that propose where it is: three coordinates, their square, and the zero."""


@dataclass(frozen=True, kw_only=True)
class Distance(ToolTip):
    """The length from an anchor to a point on the flange, read in the column "length"; one residual per row.

    The column "anchor" tells anchors apart; without it there is one.

    Args:
        noise_std: standard deviation of a length, mm.
        tool: the end of the wire or bar in the flange frame, mm.
        anchor: the other end in the base frame, mm; proposed from the data when not given.
        zero: what must be added to all lengths' model, mm: a wire that does not start at zero; flat unless given.

    """

    anchor: Parameter = proposed_point("anchor")
    zero: Parameter = Parameter(0.0, unit="mm", prior_std=float("inf"))

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """The length."""
        return {"length": "length"}

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """End of the wire, anchors, zero."""
        return {"tool": self.tool, "zero": self.zero, "anchor": self.anchor}

    @property
    def datum(self) -> tuple[str, ...]:
        """Anchors and zero."""
        return ("anchor", "zero")

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Units, and a wire that counts down."""
        fix = "Reverse the sign of the lengths; the zero takes up the rest"
        cause = "a longer way seems to be read as a shorter one"
        return (*super().suspects, Suspect("sign of the lengths", cause, fix, ("length",), -1.0))

    @property
    def words(self) -> Words:
        """Lengths."""
        return Words("residual of the length", "mm", "lengths", "anchors and zero fitted alone", group="anchor")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Predicted minus read length, mm."""
        return ca.norm_2(self.tip(pose, p, row) - p.anchor) + p.zero - row.length

    def propose(self, key: str, sight: Sight) -> Array:
        """Point from which the nominal tips lie at the lengths read, but for the zero where that is unknown."""
        if key != "anchor":
            return super().propose(key, sight)
        if len(sight.tips) < FEWEST:
            raise ProblemError(
                f"An anchor has {len(sight.tips)} lengths",
                f"Take {FEWEST} or more from every anchor, or say where it is",
            )
        return centre_of(sight.tips, sight.columns["length"], zero=bool(self.zero.size))

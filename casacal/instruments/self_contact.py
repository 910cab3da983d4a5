"""Two balls on two arms that touch each other: no instrument but the arms themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from casacal.instruments.dial_parts import tool_point
from casacal.instruments.instrument import Words
from casacal.instruments.tool_tip import ToolTip
from casacal.kinematics import Expression
from casacal.unknowns import Parameter, Unknown


@dataclass(frozen=True, kw_only=True)
class SelfContact(ToolTip):
    """A ball on each of two arms, as far apart as both radii; one residual per row. For robots that `facing` makes.

    It sees the two arms against each other and nothing of the room: what both get wrong alike, it cannot know.

    Args:
        noise_std: standard deviation of a contact, mm.
        tool: centre of the ball on the first arm, in its flange frame, mm.
        other: centre of the ball on the other arm, in that one's flange frame, mm.
        apart: sum of both radii, mm, with the prior of what is known of it.

    """

    apart: Parameter
    other: Parameter = tool_point()

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Both balls, and how far apart they are."""
        return {"tool": self.tool, "other": self.other, "apart": self.apart}

    @property
    def words(self) -> Words:
        """Distances of balls."""
        return Words("distance between the balls", "mm", "touches", "nothing fitted")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """How far the balls stand off each other, mm."""
        return ca.norm_2(self.tip(pose, p, row) - p.other) - p.apart

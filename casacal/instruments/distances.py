"""Distances from a point on the flange: of a ball from spheres or another ball, along a draw wire or a ball bar."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.description import Sight, Words
from casacal.instruments.tool_tip import ToolTip, centre_of, proposed_point, tool_point
from casacal.kinematics import Expression
from casacal.unknowns import Parameter
from casacal.values import FrozenMapping

FEWEST = 5  # rows of an anchor that propose where it is: three coordinates, their square, and the zero


@dataclass(frozen=True, kw_only=True)
class SphereTouch(ToolTip):
    """A ball that touches a sphere for each value of the column "sphere" all around; one residual per row.

    Without that column there is one sphere. Spheres of known size make the size of the arm known.

    Args:
        noise_std: standard deviation of a contact, mm.
        tool: the centre of the ball in the flange frame, mm.
        radii: radius of the sphere and of the ball together, mm, with the prior of its certificate.
        centre: centre of each sphere in the base frame, mm; proposed from the data when not given.

    """

    radii: Parameter
    centre: Parameter = proposed_point("sphere")

    datum = ("centre",)
    words = Words(
        "distance from the spheres",
        "mm",
        "touches",
        "spheres fitted alone",
        "the radius and form of spheres and probe",
        group="sphere",
    )

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """How far the ball stands off the sphere, mm."""
        return ca.norm_2(self.tip(pose, p, row) - p.centre) - p.radii

    def propose(self, key: str, sight: Sight) -> Array:
        """Centre of the sphere through the nominal tips."""
        if key != "centre":
            return super().propose(key, sight)
        return centre_of(sight.tips, np.zeros(len(sight.tips)))  # all alike, however large: |c|^2 takes them in


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

    other: Parameter = tool_point()
    apart: Parameter

    words = Words("distance between the balls", "mm", "touches", "nothing fitted")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """How far the balls stand off each other, mm."""
        return ca.norm_2(self.tip(pose, p, row) - p.other) - p.apart


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

    zero: Parameter = Parameter(0.0, unit="mm", prior_std=float("inf"))
    anchor: Parameter = proposed_point("anchor")

    columns = FrozenMapping({"length": "length"})
    datum = ("anchor", "zero")
    words = Words(
        "residual of the length",
        "mm",
        "lengths",
        "anchors and zero fitted alone",
        "the scale of the lengths",
        group="anchor",
    )

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

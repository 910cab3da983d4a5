"""A ball on the flange that touches spheres of known size, or the ball on another arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.instruments.description import Sight, Words
from casacal.instruments.dial_parts import tool_point
from casacal.instruments.tool_tip import ToolTip, centre_of, proposed_point
from casacal.kinematics import Expression
from casacal.unknowns import Parameter, Unknown


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

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Ball, radii, spheres."""
        return {"tool": self.tool, "radii": self.radii, "centre": self.centre}

    @property
    def datum(self) -> tuple[str, ...]:
        """The spheres."""
        return ("centre",)

    @property
    def words(self) -> Words:
        """Distances from spheres."""
        return Words("distance from the spheres", "mm", "touches", "spheres fitted alone", group="sphere")

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

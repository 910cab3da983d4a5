"""A dial indicator on a flat face, or a tool that simply touches it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from casacal.errors import ProblemError
from casacal.instruments.instrument import Dimension, Instrument, Sight
from casacal.kinematics import Expression, transform_point
from casacal.unknowns import Direction, Parameter, Plane, Unknown
from casacal.unknowns.unknown import Array, unit_vector


def tool_point(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, *, prior_std: float = math.inf, free: bool = True
) -> Parameter:
    """Tool point (3, mm) in the flange frame, with components tool_x, tool_y, tool_z."""
    return Parameter((x, y, z), unit="mm", prior_std=prior_std, free=free, labels=("_x", "_y", "_z"))


@dataclass(frozen=True, kw_only=True)
class DialOnPlane(Instrument):
    """The paper's instrument: the tip of a plunger on a plane, residual n . (p - gamma), eq (6) with a unit normal.

    Args:
        noise_std: standard deviation of one measurement, mm: of the reading along the plunger, or, without a
            reading, of the touch along the normal.
        reading: True when the samples carry a `reading` column; False for contact only. Samples that do not match
            are refused.
        sign: +1 when a larger reading means a longer tool (the paper's d6 + reading), -1 when the plunger is pushed
            in. Never guessed.
        contact_std: standard deviation of touch and form of the face along the normal, mm, beside the reading's.
        travel: range of the plunger, mm; readings lie in 0 ... travel.
        tool: point of the plunger at reading zero, in the flange frame, mm.
        plunger: direction of the plunger, out of the tool, in the flange frame.
        plane: the face, or one for each label.

    """

    noise_std: float
    reading: bool = True
    sign: Literal[1, -1] = 1
    contact_std: float = 0.0
    travel: float = 10.0
    tool: Parameter = tool_point(free=False)
    plunger: Direction = Direction((0.0, 0.0, 1.0), free=False)
    plane: Plane = Plane(per="plane")

    def __post_init__(self) -> None:
        if not 0 < self.noise_std < math.inf:
            raise ProblemError(f"noise_std of the dial is {self.noise_std!r}", "Give a positive number of mm")
        if not 0 <= self.contact_std < math.inf:
            raise ProblemError(f"contact_std of the dial is {self.contact_std!r}", "Give zero or more mm")
        if self.sign not in (1, -1):
            raise ProblemError(f"sign of the dial is {self.sign!r}", "Give +1 (extends the tool) or -1 (shortens it)")
        if not 0 < self.travel < math.inf:
            raise ProblemError(f"travel of the dial is {self.travel!r}", "Give a positive number of mm")

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """The reading, where there is one."""
        return {"reading": "length"} if self.reading else {}

    @property
    def refused_columns(self) -> Mapping[str, str]:
        """A reading, where the instrument is declared as contact only."""
        return {} if self.reading else {"reading": "the problem declares contact without a dial (reading=False)"}

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Tool point, plunger direction, plane."""
        return {"tool": self.tool, "plunger": self.plunger, "plane": self.plane}

    @property
    def datum(self) -> tuple[str, ...]:
        """The plane."""
        return ("plane",)

    @property
    def column_stds(self) -> Mapping[str, float]:
        """Noise of the reading, mm."""
        return {"reading": self.noise_std} if self.reading else {}

    @property
    def residual_std(self) -> float:
        """Noise along the normal, mm."""
        return self.contact_std if self.reading else math.hypot(self.noise_std, self.contact_std)

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Tip of the plunger (3, mm): the tool point, plus sign * reading along the plunger."""
        reach = self.sign * getattr(row, "reading", 0.0)
        return transform_point(pose, p.tool + reach * p.plunger)

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Signed distance of the tip from the plane, mm."""
        return p.plane.distance(self.tip(pose, p, row))

    def propose(self, key: str, sight: Sight) -> Array:
        """Total-least-squares plane through the nominal tips, its normal towards the tool.

        Raises ProblemError when the tips lie on a line, so that no plane is seen.
        """
        if key != "plane":
            return super().propose(key, sight)
        centre = sight.tips.mean(axis=0)
        _, sizes, axes = np.linalg.svd(sight.tips - centre, full_matrices=False)
        if len(sight.tips) < 3 or sizes[1] <= 1e-9 * max(sizes[0], 1.0):
            raise ProblemError(
                f"A plane was touched at {len(sight.tips)} tips that lie on a line", "Spread the touches over the face"
            )
        plunger = sight.poses[:, :3, :3] @ unit_vector(self.plunger.vector, "The plunger")
        towards = float((plunger @ axes[2]).mean())
        return Plane.encode(-axes[2] if towards > 0 else axes[2], centre)

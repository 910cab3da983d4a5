"""The joints of an arm: kind, limits, repeatability."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from casacal.errors import ProblemError
from casacal.values import is_real

MOST_JOINTS = 100

MOST_RATIO = 1000.0
"""Largest gear ratio of a robot's joint."""


@dataclass(frozen=True)
class Joint:
    """One joint: its kind, its limits and its repeatability, in rad (revolute) or mm (prismatic).

    gear_ratio: turns of the motor for one of a revolute joint; zero where it is not known.
    """

    kind: Literal["revolute", "prismatic"] = "revolute"
    lower: float = -math.pi
    upper: float = math.pi
    repeatability_std: float = 0.0
    gear_ratio: float = 0.0

    @property
    def turns(self) -> bool:
        """Whether it turns; otherwise it slides."""
        return self.kind == "revolute"

    def __post_init__(self) -> None:
        if self.kind not in ("revolute", "prismatic"):
            raise ProblemError(f"A joint is '{self.kind}'", "Joints are 'revolute' or 'prismatic'")
        if not self.lower < self.upper or not math.isfinite(self.upper - self.lower):
            raise ProblemError(
                f"A joint has the limits {self.lower!r} to {self.upper!r}", "Give finite limits, lower below upper"
            )
        if not (is_real(self.repeatability_std) and 0 <= self.repeatability_std < math.inf):
            raise ProblemError(f"A joint has repeatability_std {self.repeatability_std!r}", "Give zero or more")
        if not (is_real(self.gear_ratio) and (self.gear_ratio == 0 or 1 <= self.gear_ratio <= MOST_RATIO)):
            fix = f"Give the motor's turns for one of the joint, 1 to {MOST_RATIO:g}, or leave it out"
            raise ProblemError(f"A joint has the gear ratio {self.gear_ratio!r}", fix)
        if self.gear_ratio and not self.turns:
            raise ProblemError(f"A sliding joint has the gear ratio {self.gear_ratio!r}", "Give zero, or leave it out")


def joints_of(joints: int | str | Sequence[Joint]) -> tuple[Joint, ...]:
    """Joints from a count (all revolute), a word like "RRPR", or a sequence of `Joint`.

    Limits that are not given are +-pi rad and +-1000 mm.
    """
    if isinstance(joints, int):
        if not 0 <= joints <= MOST_JOINTS:
            raise ProblemError(f"{joints:.6g} joints were asked for", f"Give 1 to {MOST_JOINTS}")
        joints = "R" * joints
    if isinstance(joints, str):
        if set(joints) - set("RP"):
            raise ProblemError(f"joints is '{joints}'", "Use R for revolute and P for prismatic, such as 'RRPR'")
        return tuple(Joint() if letter == "R" else Joint("prismatic", -1000.0, 1000.0) for letter in joints)
    return tuple(joints)


def geared(joints: Sequence[Joint], ratios: Sequence[float]) -> tuple[Joint, ...]:
    """The same joints with known gear ratios, zero where one is not; raises ProblemError."""
    if len(ratios) != len(joints):
        fix = "Give one for each joint, 0 where it is not known"
        raise ProblemError(f"Got {len(ratios)} gear ratios for {len(joints)} joints", fix)
    return tuple(replace(joint, gear_ratio=ratio) for joint, ratio in zip(joints, ratios, strict=True))

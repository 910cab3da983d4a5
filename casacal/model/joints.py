"""Joints, and a controller's conventions for their values: signs, offsets and coupling."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.values import Array, as_given, is_finite, is_real

MOST_JOINTS = 100
MOST_TURNED = 8 * math.pi  # limits of a joint beyond it, in rad, were given in degrees
MOST_RATIO = 1000.0  # largest gear ratio of a robot's joint


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
        if not (is_finite(self.lower) and is_finite(self.upper)):
            what = f"A joint has the limits {as_given(self.lower)} to {as_given(self.upper)}"
            raise ProblemError(what, "Give finite limits, lower below upper")
        if not self.lower < self.upper:
            fix = "Give finite limits, lower below upper"
            factor, unit = (math.degrees(1), "degrees") if self.turns else (1.0, "mm")
            what = f"A joint has the limits {self.lower * factor:g} to {self.upper * factor:g} {unit}"
            raise ProblemError(what, fix)
        if self.turns and max(-self.lower, self.upper) > MOST_TURNED:
            what = f"A joint has the limits {self.lower:g} to {self.upper:g} rad, which are many turns"
            raise ProblemError(what, f"Give rad, such as deg({self.lower:g}, {self.upper:g}) for degrees")
        if not (is_real(self.repeatability_std) and 0 <= self.repeatability_std < math.inf):
            raise ProblemError(f"A joint has repeatability_std {self.repeatability_std!r}", "Give zero or more")
        if not (is_real(self.gear_ratio) and (self.gear_ratio == 0 or 1 <= self.gear_ratio <= MOST_RATIO)):
            fix = f"Give the motor's turns for one of the joint, 1 to {MOST_RATIO:g}, or leave it out"
            raise ProblemError(f"A joint has the gear ratio {self.gear_ratio!r}", fix)
        if self.gear_ratio and not self.turns:
            raise ProblemError(f"A sliding joint has the gear ratio {self.gear_ratio!r}", "Give zero, or leave it out")


def joints_of(joints: int | str | Sequence[Joint]) -> tuple[Joint, ...]:
    """Joints from a count (all revolute), a word like "RRPR" (limits +-pi rad, +-1000 mm), or a sequence of `Joint`."""
    if isinstance(joints, int):
        if not 0 <= joints <= MOST_JOINTS:
            raise ProblemError(f"{joints:.6g} joints were asked for", f"Give 1 to {MOST_JOINTS}")
        joints = "R" * joints
    if isinstance(joints, str):
        if set(joints) - set("RP"):
            raise ProblemError(f"joints is '{joints}'", "Use R for revolute and P for prismatic, such as 'RRPR'")
        return tuple(Joint() if letter == "R" else Joint("prismatic", -1000.0, 1000.0) for letter in joints)
    return tuple(joints)


@dataclass(frozen=True)
class Conventions:
    """q of the model = signs * (q of the controller + coupling) + offsets.

    signs: +1 or -1 per joint. offsets: rad, or mm where a joint slides; none by default. coupling: (i, j, factor),
    joints counted from 1: factor * q_j is added to q_i, both as the controller shows them; (3, 2, -1.0) where joint 3
    is measured against the ground and joint 2 turns the same way. Raises ProblemError for anything else.
    """

    signs: tuple[int, ...]
    offsets: tuple[float, ...] = ()
    coupling: tuple[tuple[int, int, float], ...] = ()

    def __post_init__(self) -> None:
        joints = len(self.signs)
        if any(sign not in (1, -1) for sign in self.signs):
            raise ProblemError(f"The joint signs are {self.signs}", "Use 1 or -1 for each joint")
        if not self.offsets:
            object.__setattr__(self, "offsets", (0.0,) * joints)
        if len(self.offsets) != joints or not all(map(is_finite, self.offsets)):
            fix = "Give one finite offset for each joint"
            raise ProblemError(f"Got {len(self.offsets)} joint offsets for {joints} signs", fix)
        for each in self.coupling:
            two = set(each[:2]) if isinstance(each, (tuple, list)) and len(each) == 3 else set()
            whole = all(isinstance(k, (int, np.integer)) and 1 <= k <= joints for k in two)
            if not whole or len(two) < 2 or not is_finite(each[2]):
                fix = f"Give two different joints of 1 to {joints} and a factor"
                raise ProblemError(f"A coupling is {each}", fix)
        if abs(np.linalg.det(self.matrix)) < 1e-9:
            raise ProblemError(f"The coupling {self.coupling} makes joints depend on one another", "Leave one out")

    @staticmethod
    def plain(joints: int) -> Conventions:
        """Conventions of a controller that counts joints as the model does."""
        return Conventions((1,) * joints, (0.0,) * joints)

    def flipped(self, joint: int) -> Conventions:
        """A copy with the direction of one joint, counted from 1, reversed."""
        signs = tuple(-sign if k == joint else sign for k, sign in enumerate(self.signs, 1))
        coupling = tuple((i, j, -factor if joint in (i, j) else factor) for i, j, factor in self.coupling)
        return Conventions(signs, self.offsets, coupling)

    def check_joints(self, count: int, name: str) -> None:
        """Raise ProblemError unless these are conventions of `count` joints."""
        if len(self.signs) != count:
            fix = "Give one sign and one offset per joint"
            raise ProblemError(f"'{name}' has {count} joints and conventions for {len(self.signs)}", fix)

    @property
    def matrix(self) -> Array:
        """M (n, n) of q_model = M q_controller + offsets."""
        mixing = np.eye(len(self.signs))
        for i, j, factor in self.coupling:
            mixing[i - 1, j - 1] += factor
        return np.array(self.signs, dtype=np.float64)[:, None] * mixing

    def to_model(self, q: Any) -> Any:
        """Joint values of the model: from an expression or a column (n,), or from rows (N, n) of numbers."""
        if isinstance(q, (ca.SX, ca.MX, ca.DM)):
            return ca.mtimes(ca.sparsify(ca.DM(self.matrix)), q) + ca.DM(self.offsets)
        return np.asarray(q) @ self.matrix.T + np.array(self.offsets)

    def to_controller(self, q: Sequence[float] | Array) -> Array:
        """Joint values as the controller shows them, from those of the model: (n,) or rows (N, n)."""
        return np.asarray(np.linalg.solve(self.matrix, (np.asarray(q) - np.array(self.offsets)).T).T)

"""What a controller's joint values mean to a model: signs, offsets, axes measured against another one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError


@dataclass(frozen=True)
class Conventions:
    """q of the model = signs * (q of the controller + coupling) + offsets.

    signs: +1 or -1 per joint. offsets: rad, or mm where a joint slides. coupling: (i, j, factor), joints counted from
    1: factor * q_j is added to q_i, both as the controller shows them; (3, 2, -1.0) where joint 3 is measured against
    the ground and joint 2 turns the same way. Raises ProblemError for anything else.
    """

    signs: tuple[int, ...]
    offsets: tuple[float, ...]
    coupling: tuple[tuple[int, int, float], ...] = ()

    def __post_init__(self) -> None:
        joints = len(self.signs)
        if any(sign not in (1, -1) for sign in self.signs):
            raise ProblemError(f"The joint signs are {self.signs}", "Use 1 or -1 for each joint")
        if len(self.offsets) != joints or not all(math.isfinite(offset) for offset in self.offsets):
            raise ProblemError(
                f"Got {len(self.offsets)} joint offsets for {joints} signs", "Give one finite offset for each joint"
            )
        for i, j, factor in self.coupling:
            if not (1 <= i <= joints and 1 <= j <= joints) or i == j or not math.isfinite(factor):
                raise ProblemError(
                    f"A coupling is ({i}, {j}, {factor})", f"Give two different joints of 1 to {joints} and a factor"
                )
        if abs(np.linalg.det(self.matrix)) < 1e-9:
            raise ProblemError(f"The coupling {self.coupling} makes joints depend on one another", "Leave one out")

    @staticmethod
    def plain(joints: int) -> Conventions:
        """Of a controller that means what the model means."""
        return Conventions((1,) * joints, (0.0,) * joints)

    def check_joints(self, count: int, name: str) -> None:
        """Raise ProblemError unless these are conventions of `count` joints."""
        if len(self.signs) != count:
            raise ProblemError(
                f"'{name}' has {count} joints and conventions for {len(self.signs)}",
                "Give one sign and one offset per joint",
            )

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

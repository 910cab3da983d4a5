"""A rigid transform: where an instrument stands, how a tool is mounted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.kinematics import Expression, rigid, rotation_of_quaternion
from casacal.unknowns.unknown import check_stds, spread, start_stds
from casacal.unknowns.whole import Whole, shared_std, stereographic, stereographic_local
from casacal.values import plain


@dataclass(frozen=True)
class Frame(Whole):
    """A 4x4 rigid transform with six local coordinates: three rotations (rad), three translations (mm).

    The local rotation acts on the right of the nominal one, the translation is added in the outer frame.

    Args:
        matrix: nominal 4x4 transform, mm; None when the data are to propose it.
        prior_std: (rotation in rad, translation in mm) standard deviations; `math.inf` is flat.
        start_std: the same, where filters and populations start when the prior is flat.
        turns_only: True when only the three rotations are unknown.
        free: False holds the frame where it is declared.
        per: name of a label column; one frame for each of its values.
        held_as_proposed: True holds it where the data propose it, as `Problem.fix` does.

    """

    matrix: Sequence[Sequence[float]] | None = None
    prior_std: float | tuple[float, float] = math.inf
    start_std: tuple[float, float] = (0.01, 10.0)
    turns_only: bool = False
    free: bool = True
    per: str | None = None
    held_as_proposed: bool = False

    nominal_size = 12
    parts = (("rx", "rad"), ("ry", "rad"), ("rz", "rad"), ("x", "mm"), ("y", "mm"), ("z", "mm"))

    def __post_init__(self) -> None:
        for name in ("matrix", "prior_std", "start_std"):
            object.__setattr__(self, name, plain(getattr(self, name)))
        if self.matrix is None and not self.free and not self.held_as_proposed:
            raise ProblemError("A frame is held but has no matrix", "Say where it is, or leave it free")
        check_stds(spread(self.prior_std, 2, "prior_std of a frame"), "prior_std of a frame")
        _ = self.nominal  # or a sentence

    @property
    def size(self) -> int:
        """Six, three when only it turns, or none when held."""
        return (3 if self.turns_only else 6) if self.free else 0

    @property
    def prior_stds(self) -> Array:
        """Prior standard deviations: three rotations, three translations."""
        return np.repeat(spread(self.prior_std, 2, "prior_std of a frame"), 3)[: self.size]

    @property
    def start_stds(self) -> Array:
        """Prior or start standard deviations."""
        start = np.repeat(np.array(self.start_std), 3)[: self.size]
        return start_stds(self.prior_stds, start, self.units, "a frame")

    @property
    def nominal(self) -> Array | None:
        """Rotation (9, column by column) and translation (3, mm); None when the data must propose them."""
        return None if self.matrix is None else self.encode(np.asarray(self.matrix, dtype=np.float64))

    @staticmethod
    def encode(matrix: Array) -> Array:
        """Numbers (12,) that fix a nominal frame.

        Raises ProblemError when the matrix is not a rigid transform.
        """
        good = matrix.shape == (4, 4) and np.isfinite(matrix).all()
        if not good or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6):
            raise ProblemError("A frame is not a rigid 4x4 transform", "Give a rotation matrix and a translation in mm")
        if np.linalg.det(matrix[:3, :3]) < 0:
            raise ProblemError("A frame mirrors (its determinant is -1)", "Give a right-handed rotation matrix")
        return np.concatenate([matrix[:3, :3].T.ravel(), matrix[:3, 3]])

    def at(self, nominal: Expression, local: Expression) -> Expression:
        """4x4 transform at six local coordinates."""
        if not self.free:
            return self._assemble(nominal, ca.DM.eye(3), ca.DM.zeros(3, 1))
        # a rotation by angle phi is the unit quaternion at phi / 2 from the pole
        w, xyz = stereographic(local[:3] / 2)
        return self._assemble(nominal, rotation_of_quaternion(ca.vertcat(w, xyz)), self._shift(local[3:]))

    def shown(self, nominal: Array, local: Array) -> tuple[str, Any]:
        """4x4, mm."""
        return "frames", np.asarray(ca.DM(self.at(nominal, local)))

    def placed(self, near: Array, normal: Array) -> Array:
        """The base frame, its zero moved to the place; itself where nothing is said of places."""
        del normal
        matrix = np.eye(4)
        matrix[:3, 3] = 0.0 if self.turns_only else -np.asarray(near)  # from the base to what stands there
        return self.encode(matrix)

    def recentred(self, nominal: Array, local: Array) -> Array:
        """Numbers of the frame there."""
        return self.encode(self.shown(nominal, local)[1])

    def raw_start(self, nominal: Array) -> Array:
        """Return the unit quaternion of no rotation, and no translation."""
        del nominal
        return np.eye(self.raw_size)[0] if self.free else np.zeros(0)

    def raw_value(self, nominal: Expression, raw: Expression) -> Expression:
        """4x4 transform of a raw quaternion, rigid only where the constraint holds."""
        if not self.free:
            return self.at(nominal, raw)
        return self._assemble(nominal, rotation_of_quaternion(raw[:4]), self._shift(raw[4:]))

    def raw_local(self, nominal: Expression, raw: Expression) -> Expression:
        """Six local coordinates of a raw frame with unit quaternion."""
        del nominal
        if not self.free:
            return ca.DM.zeros(0, 1)
        return ca.vertcat(2 * stereographic_local(raw[0], raw[1:4]), raw[4:])

    def raw_constraints(self, raw: Expression) -> list[Expression]:
        """q'q - 1."""
        return [ca.dot(raw[:4], raw[:4]) - 1] if self.free else []

    def with_prior(self, stds: Sequence[float]) -> Frame:
        """Copy with another prior; rotations share one standard deviation, translations another."""
        present, shift = self.prior_stds, float(spread(self.prior_std, 2, "prior_std of a frame")[1])
        turn = shared_std(stds[:3], present[:3])
        shift = shift if self.turns_only else shared_std(stds[3:], present[3:])
        return replace(self, prior_std=(turn, shift))

    def _shift(self, local: Expression) -> Expression:
        return ca.DM.zeros(3, 1) if self.turns_only else local

    @staticmethod
    def _assemble(nominal: Expression, turn: Expression, shift: Expression) -> Expression:
        columns = ca.horzcat(nominal[0:3], nominal[3:6], nominal[6:9])
        return rigid(ca.mtimes(columns, turn), nominal[9:12] + shift)

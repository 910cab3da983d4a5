"""A plane: unit normal and a point, of which the data can see three numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.kinematics import Expression
from casacal.unknowns.unknown import check_stds, spread, start_stds, tangent_basis, unit_vector
from casacal.unknowns.whole import Whole, shared_std, tilted, tilts_of
from casacal.values import plain


@dataclass(frozen=True)
class PlaneValue:
    """A plane at given coordinates: the points at `offset` mm from `base` along `normal`."""

    normal: Expression
    base: Expression
    offset: Expression

    @property
    def point(self) -> Expression:
        """A point on the plane (3, mm): gamma of eq (6), arXiv:2208.02652."""
        return self.base + self.offset * self.normal

    def distance(self, point: Expression) -> Expression:
        """Signed distance (mm) of a point (3, mm): eq (6) with a unit normal, n . (p - gamma)."""
        return ca.dot(self.normal, point - self.base) - self.offset


@dataclass(frozen=True)
class Plane(Whole):
    """A plane with three local coordinates: two tilts of its normal (rad) and an offset along it (mm).

    Three, not six: of a normal and a point only the unit normal and n . gamma can be seen (erratum E7).

    Args:
        normal, point: nominal plane, mm; both None when the data are to propose it (total least squares).
        prior_std: (tilt in rad, offset in mm) standard deviations; `math.inf` is flat.
        start_std: the same, where filters and populations start when the prior is flat.
        free: False holds the plane where it is declared.
        per: name of a label column; one plane for each of its values.
        held_as_proposed: True holds it where the data propose it, as `Problem.fix` does.

    """

    normal: Sequence[float] | None = None
    point: Sequence[float] | None = None
    prior_std: float | tuple[float, float] = math.inf
    start_std: tuple[float, float] = (0.01, 10.0)
    free: bool = True
    per: str | None = None
    held_as_proposed: bool = False

    nominal_size = 12
    parts = (("tilt1", "rad"), ("tilt2", "rad"), ("offset", "mm"))

    def __post_init__(self) -> None:
        for name in ("normal", "point", "prior_std", "start_std"):
            object.__setattr__(self, name, plain(getattr(self, name)))
        if (self.normal is None) != (self.point is None):
            raise ProblemError("A plane has a normal or a point but not both", "Give both, or neither")
        if self.normal is None and not self.free and not self.held_as_proposed:
            raise ProblemError("A plane is held but has no normal and no point", "Say where it is, or leave it free")
        check_stds(spread(self.prior_std, 2, "prior_std of a plane"), "prior_std of a plane")
        _ = self.nominal  # or a sentence

    @property
    def prior_stds(self) -> Array:
        """Prior standard deviations: tilt, tilt, offset."""
        tilt, offset = spread(self.prior_std, 2, "prior_std of a plane")
        return np.array([tilt, tilt, offset][: self.size])

    @property
    def start_stds(self) -> Array:
        """Prior or start standard deviations: tilt, tilt, offset."""
        tilt, offset = self.start_std
        return start_stds(self.prior_stds, np.array([tilt, tilt, offset][: self.size]), self.units, "a plane")

    @property
    def nominal(self) -> Array | None:
        """Normal (3), two vectors across it (6), base point (3, mm); None when the data must propose them."""
        return None if self.normal is None or self.point is None else self.encode(self.normal, self.point)

    @staticmethod
    def encode(normal: Sequence[float] | Array, point: Sequence[float] | Array) -> Array:
        """Numbers (12,) that fix a nominal plane through `point` (3, mm)."""
        unit = unit_vector(list(normal), "The normal of a plane")
        base = np.asarray(point, dtype=np.float64)
        if base.shape != (3,) or not np.isfinite(base).all():
            raise ProblemError(f"The point of a plane is {point!r}", "Give three finite numbers in mm")
        return np.concatenate([unit, tangent_basis(unit).T.ravel(), base])

    def at(self, nominal: Expression, local: Expression) -> PlaneValue:
        """Plane at (tilt1, tilt2, offset)."""
        if not self.free:
            return PlaneValue(nominal[:3], nominal[9:12], 0.0)
        return PlaneValue(tilted(nominal, local[:2]), nominal[9:12], local[2])

    def nominal_plane(self, nominal: Array) -> tuple[Array, Array]:
        """Its normal and base point."""
        return nominal[:3], nominal[9:12]

    def growth(self, nominal: Array) -> Array:
        """The offset grows with the distance from the origin; tilts stay."""
        return np.array([0.0, 0.0, nominal[:3] @ nominal[9:12]][: self.size])

    def packed(self, value: PlaneValue) -> Expression:
        """Normal, base and offset of a plane, one below the other (7)."""
        return ca.vertcat(value.normal, value.base, value.offset)

    def unpacked(self, matrix: Expression) -> PlaneValue:
        """The plane of such a column."""
        return PlaneValue(matrix[:3], matrix[3:6], matrix[6])

    def shown(self, nominal: Array, local: Array) -> tuple[str, Any]:
        """Unit normal (3,), and the foot of the samples' centroid on the plane (3, mm)."""
        value = self.at(nominal, local)
        normal = np.asarray(ca.DM(value.normal)).ravel()
        return "planes", {"normal": normal, "point_mm": nominal[9:12] - normal * float(value.distance(nominal[9:12]))}

    def placed(self, near: Array, normal: Array) -> Array:
        """The plane through the point with that normal."""
        return self.encode(normal, near)

    def recentred(self, nominal: Array, local: Array) -> Array:
        """Numbers of the plane there."""
        there = self.shown(nominal, local)[1]
        return self.encode(there["normal"], there["point_mm"])

    def raw_start(self, nominal: Array) -> Array:
        """Return the normal's three components, and offset 0."""
        return np.concatenate([np.asarray(nominal)[:3], [0.0]]) if self.free else np.zeros(0)

    def raw_value(self, nominal: Expression, raw: Expression) -> PlaneValue:
        """Plane of a raw normal, unit only where the constraint holds."""
        return PlaneValue(raw[:3], nominal[9:12], raw[3]) if self.free else self.at(nominal, raw)

    def raw_local(self, nominal: Expression, raw: Expression) -> Expression:
        """Tilts and offset of a raw plane with unit normal."""
        return ca.vertcat(tilts_of(nominal, raw[:3]), raw[3]) if self.free else ca.DM.zeros(0, 1)

    def raw_constraints(self, raw: Expression) -> list[Expression]:
        """n'n - 1."""
        return [ca.dot(raw[:3], raw[:3]) - 1] if self.free else []

    def with_prior(self, stds: Sequence[float]) -> Plane:
        """Copy with another prior; both tilts share one standard deviation, so changing either changes both."""
        return replace(self, prior_std=(shared_std(stds[:2], self.prior_stds[:2]), float(stds[2])))

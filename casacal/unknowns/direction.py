"""A unit vector: the axis of a plunger, the direction of gravity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError, came
from casacal.kinematics import Expression
from casacal.unknowns.unknown import check_stds, start_stds, tangent_basis, unit_vector
from casacal.unknowns.whole import Whole, shared_std, tilted, tilts_of
from casacal.values import is_real, plain


@dataclass(frozen=True)
class Direction(Whole):
    """A unit vector (3,) with two local coordinates, both angles in rad.

    Args:
        vector: nominal direction, normalised here; None when the data are to propose it.
        prior_std: standard deviation of each of the two tilts, rad; `math.inf` is flat.
        start_std: where filters start them when the prior is flat, rad.
        free: False holds the direction.
        per: name of a label column; one instance for each of its values.
        held_as_proposed: True holds it where the data propose it, as `Problem.fix` does.

    """

    vector: Sequence[float] | None
    prior_std: float = math.inf
    start_std: float | None = None
    free: bool = True
    per: str | None = None
    held_as_proposed: bool = False

    nominal_size = 9
    parts = (("tilt1", "rad"), ("tilt2", "rad"))

    def __post_init__(self) -> None:
        for name in ("vector", "prior_std", "start_std"):
            object.__setattr__(self, name, plain(getattr(self, name)))
        if self.vector is not None:
            unit_vector(self.vector, "A direction")
        elif not self.free and not self.held_as_proposed:
            raise ProblemError("A direction is held but has no vector", "Say where it points, or leave it free")
        if not is_real(self.prior_std):
            raise ProblemError(f"Got {came(self.prior_std)} as the prior_std of a direction", "Give one number of rad")
        check_stds(np.array([self.prior_std]), "prior_std of a direction")

    @property
    def prior_stds(self) -> Array:
        """Prior standard deviations of the two tilts, rad."""
        return np.full(self.size, self.prior_std)

    @property
    def start_stds(self) -> Array:
        """Prior or start standard deviations, rad."""
        start = None if self.start_std is None else np.full(self.size, self.start_std)
        return start_stds(self.prior_stds, start, self.units, "a direction")

    @property
    def nominal(self) -> Array | None:
        """Unit vector (3) and two vectors across it (6); None when the data must propose it."""
        return None if self.vector is None else self.encode(self.vector)

    @staticmethod
    def encode(vector: Sequence[float] | Array) -> Array:
        """Numbers (9,) that fix a nominal direction; raises ProblemError for no vector (3,) that points anywhere."""
        unit = unit_vector(vector, "A direction")
        return np.concatenate([unit, tangent_basis(unit).T.ravel()])

    def at(self, nominal: Expression, local: Expression) -> Expression:
        """Unit vector (3,) at two tilts."""
        return tilted(nominal, local) if self.free else nominal[:3]

    def shown(self, nominal: Array, local: Array) -> tuple[str, Any]:
        """Unit vector (3,)."""
        return "directions", np.asarray(ca.DM(self.at(nominal, local))).ravel()

    def placed(self, near: Array, normal: Array) -> Array:
        """The way a face would look."""
        del near
        return self.encode(normal)

    def recentred(self, nominal: Array, local: Array) -> Array:
        """Numbers of the direction there."""
        return self.encode(self.shown(nominal, local)[1])

    def raw_start(self, nominal: Array) -> Array:
        """Return the three components themselves."""
        return np.asarray(nominal)[:3] if self.free else np.zeros(0)

    def raw_value(self, nominal: Expression, raw: Expression) -> Expression:
        """Return the raw vector, unit only where the constraint holds."""
        return raw if self.free else nominal[:3]

    def raw_local(self, nominal: Expression, raw: Expression) -> Expression:
        """Two tilts of a raw unit vector."""
        return tilts_of(nominal, raw) if self.free else ca.DM.zeros(0, 1)

    def raw_constraints(self, raw: Expression) -> list[Expression]:
        """n'n - 1."""
        return [ca.dot(raw, raw) - 1] if self.free else []

    def with_prior(self, stds: Sequence[float]) -> Direction:
        """Copy with another prior; both tilts share one standard deviation, so changing either changes both."""
        return replace(self, prior_std=shared_std(stds, self.prior_stds))

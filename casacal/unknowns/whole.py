"""Unknowns that are free or held as a whole: directions, planes, frames; and tilts, which all of them have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import is_dataclass, replace
from typing import Any, ClassVar

import casadi as ca

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.kinematics import Expression
from casacal.unknowns.unknown import Unknown


class Whole(Unknown):
    """An unknown that is free or held as a whole; raw, it has one number more and one constraint of unit length."""

    free: bool
    parts: ClassVar[tuple[tuple[str, str], ...]]
    """What the name of each local coordinate ends in, and its unit."""

    @property
    def size(self) -> int:
        """One for each part, or none when held."""
        return len(self.parts) if self.free else 0

    @property
    def units(self) -> tuple[str, ...]:
        """Those of the parts."""
        return tuple(unit for _, unit in self.parts)[: self.size]

    @property
    def raw_size(self) -> int:
        """One more than there are tilts or turns and shifts, or none when held."""
        return self.size + 1 if self.free else 0

    def names(self, key: str) -> tuple[str, ...]:
        """Such as key.tilt1, key.tilt2."""
        return tuple(f"{key}.{part}" for part, _ in self.parts)[: self.size]

    def with_free(self, free: Sequence[bool]) -> Any:
        """Copy, free or held as a whole; raises ProblemError for a part of it."""
        if len(set(free)) > 1:
            what = f"a {type(self).__name__.lower()}"
            raise ProblemError(f"Only a part of {what} would be held", f"Hold or free {what} as a whole")
        assert is_dataclass(self)
        return replace(self, free=any(free), held_as_proposed=True)


def shared_std(stds: Sequence[float], present: Array) -> float:
    """One standard deviation for coordinates that share it: that of a changed one, so that naming any sets them all."""
    changed = [float(new) for new, old in zip(stds, present, strict=True) if new != old]
    return max(changed) if changed else float(present[0])


def stereographic(local: Expression) -> tuple[Expression, Expression]:
    """Point of the unit sphere at local coordinates u: (along the pole, across it).

    Inverse stereographic projection, smooth without square roots: ((1 - s), u) / (1 + s) with s = |u|^2 / 4.
    To second order |u| is the angle in rad (|u| = 2 tan(angle / 2)).
    """
    s = ca.dot(local, local) / 4
    return (1 - s) / (1 + s), local / (1 + s)


def stereographic_local(along: Expression, across: Expression) -> Expression:
    """Local coordinates of a point of the unit sphere: 2 across / (1 + along), the inverse of `stereographic`."""
    return 2 * across / (1 + along)


def tilted(nominal: Expression, tilts: Expression) -> Expression:
    """Unit vector (3) at two tilts, rad, about a nominal one, with which two vectors across it stand (9)."""
    along, across = stereographic(tilts)
    return along * nominal[:3] + across[0] * nominal[3:6] + across[1] * nominal[6:9]


def tilts_of(nominal: Expression, vector: Expression) -> Expression:
    """The two tilts of a unit vector (3), the inverse of `tilted`."""
    across = ca.vertcat(ca.dot(nominal[3:6], vector), ca.dot(nominal[6:9], vector))
    return stereographic_local(ca.dot(nominal[:3], vector), across)

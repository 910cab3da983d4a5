"""Errors of gears: transmission error, ripple, coupling, backlash."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casacal.data.samples import Samples
from casacal.effects.effect import ByColumns, Effect, read_columns_of, refuse_unless, weighted
from casacal.model.kinematics import Expression
from casacal.model.robot import Robot
from casacal.model.term import Here, Site, SurveyedRows
from casacal.model.trace import per_radian
from casacal.model.unknown import Parameter
from casacal.values import Array


class Waves(Effect, ABC):
    """An effect of waves, each a cosine and a sine of a turning joint's value."""

    moves = True

    @abstractmethod
    def waves(self, robot: Robot) -> list[tuple[int, float]]:
        """Joint and number of waves per turn of it, for each wave."""

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Cosine and sine of each wave, rad."""
        count = 2 * len(self.waves(site.robot))
        return {self.key: weighted(np.ones(count), self.size, "rad")} if count else {}

    def joints(self, here: Here) -> Expression:
        """The sum of u_c cos(k q) + u_s sin(k q) over the waves."""
        u, off = getattr(here.p, self.key), [ca.SX(0)] * len(here.robot.axes)
        for k, (j, order) in enumerate(self.waves(here.robot)):
            off[j] += u[2 * k] * ca.cos(order * here.q[j]) + u[2 * k + 1] * ca.sin(order * here.q[j])
        return ca.vertcat(*off)


@dataclass(frozen=True, kw_only=True)
class TransmissionError(Waves):
    """A wave of each turning joint, once or more often per turn: eccentric encoders, run-out of wheels.

    Args:
        order: waves per turn of the joint; a gear's own where its ratio is given.
        size: of sine and cosine, rad.

    """

    order: int = 1
    size: float = 40e-6
    doubt: float = 2.5

    @property
    def key(self) -> str:
        """Key, one for each order."""
        return f"wave{self.order}"

    @property
    def words(self) -> str:
        """Name for people."""
        named = {1: "first", 2: "second", 3: "third"}.get(self.order, f"{self.order}th")
        return f"{named}-harmonic transmission error"

    def waves(self, robot: Robot) -> list[tuple[int, float]]:
        """One wave of `order` per turn of each turning joint."""
        return [(j, self.order) for j in np.flatnonzero(robot.revolute).tolist()]


@dataclass(frozen=True, kw_only=True)
class GearRipple(Waves):
    """Transmission ripple once and twice per motor turn: wave generators, pinions, motor encoders.

    Of turning joints whose gear ratio is known, `Joint(..., gear_ratio=...)`.

    Args:
        size: of sine and cosine, rad at the joint.

    """

    size: float = 40e-6
    doubt: float = 2.5

    key = "ripple"
    words = "gear ripple"

    def waves(self, robot: Robot) -> list[tuple[int, float]]:
        """Waves once and twice per turn of each motor."""
        geared = [(j, axis.gear_ratio) for j, axis in enumerate(robot.axes) if axis.turns and axis.gear_ratio > 0]
        return [(j, order * ratio) for j, ratio in geared for order in (1, 2)]


@dataclass(frozen=True, kw_only=True)
class JointCoupling(Effect):
    """Joint coupling: a joint turns by a small part of what the joint before it moves, as through belts of a wrist.

    Args:
        size: radians per radian; `PER_RAD` mm of a sliding joint count as one.

    """

    size: float = 40e-6
    doubt: float = 2.5

    moves = True
    most = 25.0  # beyond a thousandth a coupling was left out of the controller, or of the problem
    key = "coupling"
    words = "joint coupling"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """The part by which each joint but the first follows the one before it."""
        count = len(site.robot.axes) - 1
        return {self.key: weighted(np.ones(count), self.size, "rad")} if count else {}

    def joints(self, here: Here) -> Expression:
        """Deflections u_j q_(j-1) of all joints but the first."""
        u, units = getattr(here.p, self.key), per_radian(here.robot)
        parts = (u[j - 1] * here.q[j - 1] * units[j] / units[j - 1] for j in range(1, len(units)))
        return ca.vertcat(ca.SX(0), *parts)


@dataclass(frozen=True, kw_only=True)
class Backlash(ByColumns):
    """Backlash: joints lag by half of their play behind the direction of approach, from row to row in line order.

    Nobody knows how the joints came to the first row, so that each stands there where it likes within its play. Who
    lets every joint come from one side at each row, and writes down which, knows it of all rows.

    Args:
        size: of half the play, rad.
        columns_of: the column of the samples that says how each joint came, 1 where it grew, -1 where it fell, 0 where
            that is not known; one for each joint. None takes the row before for where it came from.

    """

    size: float = 20e-6
    doubt: float = 2.5
    columns_of: tuple[str, ...] = ()

    moves = True
    key = "play"
    words = "backlash"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Half the backlash of each joint, then its initial offset, rad; `PER_RAD` mm of a sliding joint count as 1."""
        return {self.key: weighted(np.ones(2 * len(site.robot.axes)), self.size, "rad")}

    def columns(self, site: Site) -> tuple[str, ...]:
        """Sign of each joint's approach: -1, 0 or 1; and whether it is the first row."""
        return (*(f"came{j + 1}" for j in range(len(site.robot.axes))), "first")

    def told(self, site: Site, samples: Samples) -> Mapping[str, Array]:
        """Signs of approach (N,) by joint; raises ProblemError, SamplesError where rows do not hold them."""
        signs = read_columns_of(samples, self.columns_of, len(site.robot.axes), "ways of approach")
        said, fix = "is no way of approach", "Write 1 where the joint's value grew, -1 where it fell, 0 where not known"
        refuse_unless(np.isin(signs, (-1, 0, 1)), samples, self.columns_of, signs, said, fix)
        return dict(zip(self.columns(site), (*signs.T, np.zeros(len(signs))), strict=True))

    def amounts(self, site: Site, samples: Samples) -> Mapping[str, Array]:
        """None: a way of approach is no amount."""
        del site, samples
        return {}

    def values(self, site: Site, rows: SurveyedRows) -> Mapping[str, Array]:
        """Signs of the steps from row to row, none known of the first; or what the samples say."""
        if self.columns_of:
            return self.told(site, rows.samples)
        ways = rows.samples.ways
        first = (ways == 0).all(axis=1)  # nothing has moved yet
        return dict(zip(self.columns(site), (*ways.T.astype(np.float64), first.astype(np.float64)), strict=True))

    def joints(self, here: Here) -> Expression:
        """Joint deflections -u sign(approach), or anything within the backlash where that is not known."""
        u, n = getattr(here.p, self.key), len(here.robot.axes)
        lags = [u[j] * getattr(here.row, f"came{j + 1}") + u[n + j] * here.row.first for j in range(n)]
        return ca.vertcat(*(-scale * lag for scale, lag in zip(per_radian(here.robot), lags, strict=True)))

"""What gears, gravity and warmth do to an arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.discrepancy.effect import Effect, Here, Site, weighted
from casacal.discrepancy.over_time import OverTime
from casacal.discrepancy.survey import Rows
from casacal.kinematics import Expression, Product, position
from casacal.robots.joint_space import random_joints
from casacal.unknowns import Parameter

PER_RAD = 100.0
"""Millimetres of a sliding joint that count as a radian: ten micrometres where a turning one errs by 0.1 mrad."""


@dataclass(frozen=True, kw_only=True)
class GearWaves(Effect):
    """A wave of each turning joint, once or more often per turn: eccentric encoders, run-out of wheels.

    Args:
        order: waves per turn of the joint; a gear's own where its ratio is given.
        size: of sine and cosine, rad.
        doubt: times by which that may be off.

    """

    order: int = 1
    size: float = 40e-6
    doubt: float = 2.5

    moves = True

    @property
    def key(self) -> str:
        """One for each order."""
        return f"wave{self.order}"

    @property
    def words(self) -> str:
        """As people call it."""
        return "gear waves once per turn" if self.order == 1 else f"gear waves {self.order} times per turn"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Cosine and sine of each turning joint, rad."""
        count = 2 * int(site.robot.revolute.sum())
        return {self.key: weighted(np.ones(count), self.size, "rad")} if count else {}

    def joints(self, here: Here) -> Expression:
        """u_c cos(k q) + u_s sin(k q)."""
        u, found = getattr(here.p, self.key), []
        turning = iter(range(u.numel() // 2))
        for j, turns in enumerate(here.robot.revolute):
            if not turns:
                found.append(0)
                continue
            k = 2 * next(turning)
            found.append(u[k] * ca.cos(self.order * here.q[j]) + u[k + 1] * ca.sin(self.order * here.q[j]))
        return ca.vertcat(*found)


@dataclass(frozen=True, kw_only=True)
class GravityGive(Effect):
    """Joints that give under a weight: each in proportion to the lever of that weight about it.

    The weight hangs at the flange or at the tip, or between; all joints give alike, and each a little differently.

    Args:
        size: by how much the flange sags where all give alike, mm, RMS over the joints' ranges.
        doubt: times by which that may be off.
        down: direction of gravity in the base frame.

    """

    size: float = 0.15
    doubt: float = 2.5
    down: tuple[float, float, float] = (0.0, 0.0, -1.0)

    moves = True
    elastic = True
    unit = "mm"
    key = "give"
    words = "giving under gravity"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """What all turning joints give to a weight at flange and tip, then each beside it, rad per metre of lever."""
        turns = site.robot.revolute
        if not turns.any() or not (pull := self._sag_of_one(site)) > LEAST_SAG:
            return {}
        weights = np.concatenate([[1.0, 1.0], np.full(int(turns.sum()), APART)]) / pull
        return {self.key: weighted(weights, self.size, "rad")}

    def joints(self, here: Here) -> Expression:
        """u dh/dq, h the way of flange and tip along gravity, in metres."""
        u, each = getattr(here.p, self.key), iter(range(2, getattr(here.p, self.key).numel()))
        at_zero = SimpleNamespace(**{**vars(here.row), **dict.fromkeys(here.instrument.columns, 0.0)})  # of readings
        places = (position(here.pose), here.instrument.tip(here.pose, here.p, at_zero))
        flange, tip = (ca.gradient(ca.dot(ca.DM(self.down), place) / 1000, here.q) for place in places)
        given = [
            u[0] * flange[j] + (u[1] + u[next(each)]) * tip[j] if turns else 0
            for j, turns in enumerate(here.robot.revolute)
        ]
        return ca.vertcat(*given)

    def _sag_of_one(self, site: Site) -> float:
        """By how much the flange sags (mm RMS) where every joint gives one radian per metre."""
        postures = random_joints(site.robot, POSTURES, np.random.default_rng(0))
        levers = np.array(site.robot.traced.levers.map(POSTURES)(postures.T)).reshape(3, POSTURES, -1)
        along = np.einsum("a,akj->kj", np.array(self.down), levers)[:, site.robot.revolute]
        return float(np.sqrt(((along**2).sum(axis=1) ** 2).mean()) / 1000)


APART = 0.5
"""By how much of what all give one joint gives more or less than the others."""

LEAST_SAG = 1.0
"""Sag (mm) below which joints that give by a radian per metre carry no weight, as those of an upright SCARA."""

POSTURES = 64
"""Joint values over which an arm's sag is averaged."""


@dataclass(frozen=True, kw_only=True)
class Backlash(Effect):
    """Joints that lag half of their play behind the way by which they came: from the row before, in order of the lines.

    Nobody knows how the joints came to the first row, so that each stands there where it likes within its play.

    Args:
        size: of half the play, rad.
        doubt: times by which that may be off.

    """

    size: float = 20e-6
    doubt: float = 2.5

    moves = True
    key = "play"
    words = "backlash"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Half the play of each joint, then where it stood at first, rad; `PER_RAD` mm of a sliding one are one."""
        return {self.key: weighted(np.ones(2 * len(site.robot.axes)), self.size, "rad")}

    def columns(self, site: Site) -> tuple[str, ...]:
        """Which way each joint came: -1, 0 or 1; and whether it is the first row."""
        return (*(f"came{j + 1}" for j in range(len(site.robot.axes))), "first")

    def away(self, site: Site) -> Mapping[str, float]:
        """Either way: what the tip may stand off is the same for both; never the first row."""
        return {**dict.fromkeys(self.columns(site), 1.0), "first": 0.0}

    def values(self, site: Site, rows: Rows) -> Mapping[str, Array]:
        """Signs of the steps from row to row; none is known of the first."""
        order = np.argsort(np.asarray(rows.samples.lines), kind="stable")
        ways = np.zeros((len(order), rows.samples.joints.shape[1] + 1))
        ways[order[1:], :-1] = np.sign(np.diff(rows.samples.joints[order], axis=0))
        ways[order[:1], -1] = 1.0
        return dict(zip(self.columns(site), ways.T, strict=True))

    def joints(self, here: Here) -> Expression:
        """-u sign(way), and anything within the play where that is not known."""
        u, n = getattr(here.p, self.key), len(here.robot.axes)
        scales = [1.0 if turns else PER_RAD for turns in here.robot.revolute]
        return ca.vertcat(
            *(
                -scale * (u[j] * getattr(here.row, f"came{j + 1}") + u[n + j] * here.row.first)
                for j, scale in enumerate(scales)
            )
        )


@dataclass(frozen=True, kw_only=True)
class ThermalGrowth(OverTime):
    """An arm that grows as it warms up, over the order of the lines: evenly, and soon and then no more.

    Args:
        size: of the growth from the first row to the last, parts of one; steel and aluminium grow by 1.2e-5 and
            2.4e-5 for each kelvin.
        doubt: times by which that may be off.

    """

    size: float = 2e-5
    doubt: float = 2.5

    moves = True
    elsewhere = 0.5  # some time in a session
    key = "growth"
    words = "thermal growth"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Even growth, and growth that ends soon."""
        del site
        return {self.key: weighted(np.ones(2), self.size, "1")}

    def pose(self, here: Here) -> Expression:
        """The flange, its place stretched."""
        u, t = getattr(here.p, self.key), here.row.when
        grown = 1 + u[0] * t + u[1] * (1 - ca.exp(-SOON * t))
        matrix = here.pose.matrix if isinstance(here.pose, Product) else ca.SX(here.pose)
        return ca.vertcat(ca.horzcat(matrix[:3, :3], matrix[:3, 3] * grown), matrix[3, :])


SOON = 5.0
"""Time constants of early growth in one session."""

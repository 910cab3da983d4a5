"""What gravity and warmth do to an arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import casadi as ca
import numpy as np

from casacal.discrepancy.effect import Here, Site, weighted
from casacal.discrepancy.further import LOAD, MASS, Loaded
from casacal.discrepancy.smooth import OverTime
from casacal.kinematics import Expression, Product, position
from casacal.robots.robot import random_joints
from casacal.unknowns import Parameter


@dataclass(frozen=True, kw_only=True)
class GravitySag(Loaded):
    """Joints that give under a weight: each in proportion to the lever of that weight about it.

    The weight hangs at the flange or at the tip, or between; all joints give alike, and each a little differently.

    Args:
        size: by how much the flange sags where all give alike, mm, RMS over the joints' ranges.
        down: direction of gravity in the base frame.
        payload: column of the samples that says what hangs at the tip in each row, kg, such as "payload_kg": each joint
            then gives to it as well, in proportion. `predict` and `compensate` correct the sag where their file has
            that column; where it lacks it, as with the payload of the fitted rows on average.

    """

    words = "gravity sag"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """What all turning joints give to a weight at flange and tip, then each beside it, rad per metre of lever.

        With a payload then what all give to `LOAD` kilograms at the tip, and each beside it.
        """
        turns = site.robot.revolute
        if not turns.any() or not (pull := self._sag_of_one(site)) > LEAST_SAG:
            return {}
        each = np.full(int(turns.sum()), APART)
        loaded = [[1.0], each] if self.payload else []
        weights = np.concatenate([[1.0, 1.0], each, *loaded]) / pull
        return {self.key: weighted(weights, self.size, "rad")}

    def joints(self, here: Here) -> Expression:
        """u dh/dq, h the way of flange and tip along gravity, in metres."""
        u, count = getattr(here.p, self.key), int(here.robot.revolute.sum())
        at_zero = SimpleNamespace(**{**vars(here.row), **dict.fromkeys(here.instrument.columns, 0.0)})  # of readings
        places = (position(here.pose), here.instrument.tip(here.pose, here.p, at_zero))
        flange, tip = (ca.gradient(ca.dot(ca.DM(self.down), place) / 1000, here.q) for place in places)
        at_tip = [u[1] + u[k] for k in range(2, 2 + count)]
        if self.payload:
            load = getattr(here.row, MASS) / LOAD
            at_tip = [own + load * (u[2 + count] + u[3 + count + k]) for k, own in enumerate(at_tip)]
        pulls = iter(at_tip)
        given = [u[0] * flange[j] + next(pulls) * tip[j] if turns else 0 for j, turns in enumerate(here.robot.revolute)]
        return ca.vertcat(*given)

    def _sag_of_one(self, site: Site) -> float:
        """By how much the flange sags (mm RMS) where every joint gives one radian per metre."""
        postures = random_joints(site.robot, POSTURES, np.random.default_rng(0))
        levers = np.array(site.robot.traced.levers.map(POSTURES)(postures.T)).reshape(3, POSTURES, -1)
        along = np.einsum("a,akj->kj", np.array(self.down), levers)[:, site.robot.revolute]
        return float(np.sqrt(((along**2).sum(axis=1) ** 2).mean()) / 1000)


APART = 0.5  # by how much of what all give one joint gives more or less than the others

LEAST_SAG = 1.0
"""Sag (mm) below which joints that give by a radian per metre carry no weight, as those of an upright SCARA."""

POSTURES = 64  # joint values over which an arm's sag is averaged


@dataclass(frozen=True, kw_only=True)
class ThermalGrowth(OverTime):
    """An arm that grows as it warms up, over the order of the lines: evenly, and soon and then no more.

    Args:
        size: of the growth from the first row to the last, parts of one; steel and aluminium grow by 1.2e-5 and
            2.4e-5 for each kelvin.

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


SOON = 5.0  # time constants of early growth in one session

"""Errors that are smooth over a face, or over time, and what changes over a session."""

from __future__ import annotations

import math
from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.discrepancy.effect import Effect, Here, Site, weighted
from casacal.discrepancy.survey import Rows
from casacal.kinematics import Expression
from casacal.unknowns import Parameter


class OverTime(Effect, ABC):
    """An effect that wants to know when a row was measured."""

    def columns(self, site: Site) -> tuple[str, ...]:
        """When a row was measured, 0 to 1."""
        del site
        return ("when",)

    def values(self, site: Site, rows: Rows) -> Mapping[str, Array]:
        """By the number of its line."""
        del site
        return {"when": rows.survey.when(rows.samples)}


WIDER = 1.5
"""Times its half width over which a face's form is a series of sines: where it ends, the series need not vanish."""

SMALLEST_WEIGHT = 0.05
"""Terms of a series below this part of the largest are left out."""

ORDERS = 6

WALK = (1.0, 0.45, 0.22, 0.15)
"""Standard deviations of a slope and of the first waves of a random walk that goes as far."""


@dataclass(frozen=True, kw_only=True)
class FaceForm(Effect):
    """Faces that are not flat: a smooth height over each, without its plane.

    A Gaussian process of squared exponential covariance as a series of sines (Solin and Sarkka, Statistics and
    Computing 30, 2020, eqs (15)-(20)).

    Args:
        size: standard deviation of the height, mm.
        doubt: times by which that may be off.
        reach: distance, in half widths of a face, over which heights are alike.

    """

    size: float = 4e-3
    doubt: float = 10.0
    reach: float = 1.0

    moves = False
    most = 1e3  # a plate may be anything
    key = "form"
    words = "flatness error of the faces"

    @property
    def _terms(self) -> list[tuple[int, int, float]]:
        """Orders of each sine along and across, and its standard deviation for a height of one."""
        every = [(i, j) for i in range(1, ORDERS + 1) for j in range(1, ORDERS + 1)]
        waves = {(i, j): (math.pi * math.hypot(i, j) / (2 * WIDER)) for i, j in every}
        root = {at: math.sqrt(2 * math.pi) * self.reach * math.exp(-((self.reach * w) ** 2) / 4)
                for at, w in waves.items()}  # fmt: skip
        largest = max(root.values())
        return [(i, j, root[i, j] / WIDER) for i, j in every if root[i, j] > SMALLEST_WEIGHT * largest]

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Amplitudes for each face, mm."""
        if (probe := site.instrument.probe) is None:
            return {}
        return {self.key: weighted(np.array([std for *_, std in self._terms]), self.size, "mm", probe.label)}

    def columns(self, site: Site) -> tuple[str, ...]:
        """Where on its face a row lies."""
        del site
        return ("along", "across")

    def values(self, site: Site, rows: Rows) -> Mapping[str, Array]:
        """By the nominal tips; the middle of a face that was not fitted."""
        probe = site.instrument.probe
        places = rows.survey.places(rows.samples, rows.tips, None if probe is None else probe.label)
        return {"along": places[:, 0], "across": places[:, 1]}

    def residual(self, here: Here) -> Expression:
        """Less the height of the face."""
        u = getattr(here.p, self.key)
        sines = [
            ca.sin(math.pi * i * (here.row.along + WIDER) / (2 * WIDER))
            * ca.sin(math.pi * j * (here.row.across + WIDER) / (2 * WIDER))
            for i, j, _ in self._terms
        ]
        return -ca.dot(u, ca.vertcat(*sines))


@dataclass(frozen=True, kw_only=True)
class Drift(OverTime):
    """A zero that wanders over the order of the lines: a slope, and slow waves.

    Args:
        size: of the way from the first row to the last, mm.
        doubt: times by which that may be off.

    """

    size: float = 3e-3
    doubt: float = 10.0

    moves = False
    most = 1e3
    key = "drift"
    words = "drift"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Slope and three waves of each component, each about a third of the one before, as of a random walk; mm."""
        return {self.key: weighted(np.tile(WALK, site.components), self.size, "mm")}

    def residual(self, here: Here) -> Expression:
        """Slope and waves, for each component."""
        shapes = [here.row.when - 0.5, *(ca.cos(math.pi * k * here.row.when) for k in range(1, len(WALK)))]
        return ca.mtimes(ca.reshape(getattr(here.p, self.key), len(WALK), -1).T, ca.vertcat(*shapes))

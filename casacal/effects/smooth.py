"""Errors that are smooth: over a face, over time as by drift and warmth, and over like postures."""

from __future__ import annotations

import math
from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np
from scipy.linalg import solve_triangular

from casacal.data.samples import Samples
from casacal.effects.effect import Effect, is_plainly, weighted
from casacal.model.kinematics import Expression, Product, transform_point
from casacal.model.term import FaceFrame, Here, Site, SurveyedRows
from casacal.model.unknown import Parameter
from casacal.values import Array

WIDER = 1.5  # times its half width over which a face's form is a series of sines: at the edge it need not vanish
SMALLEST_WEIGHT = 0.05  # terms of a series below this part of the largest are left out
ORDERS = 6
WALK = (1.0, 0.45, 0.22, 0.15)  # standard deviations of a slope and the first waves of a random walk that goes as far
SOON = 5.0  # time constants of early growth in one session
JITTER = 1e-9  # added to a covariance of one, so that rows at one place can both be pivots
MOST_UNKNOWNS = 150  # over all components of a residual; the time that a fit takes grows with their cube
ENOUGH = 1e-3  # variance of a row, of one, below which it tells nothing that others have not told


class OverTime(Effect, ABC):
    """An effect that depends on when a row was measured."""

    def columns(self, site: Site) -> tuple[str, ...]:
        """Column of the time at which a row was measured, 0 to 1."""
        del site
        return ("when",)

    def values(self, site: Site, rows: SurveyedRows) -> Mapping[str, Array]:
        """Time of each row, by the number of its line."""
        del site
        return {"when": rows.survey.when(rows.samples)}


@dataclass(frozen=True, kw_only=True)
class FaceForm(Effect):
    """Faces that are not flat: a smooth height over each, without its plane.

    A Gaussian process of squared exponential covariance as a series of sines (Solin and Sarkka, Statistics and
    Computing 30, 2020, eqs (15)-(20)).

    Args:
        size: standard deviation of the height, mm.
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
        root = {}
        for i, j in product(range(1, ORDERS + 1), repeat=2):
            wave = math.pi * math.hypot(i, j) / (2 * WIDER)
            root[i, j] = math.sqrt(2 * math.pi) * self.reach * math.exp(-((self.reach * wave) ** 2) / 4)
        least = SMALLEST_WEIGHT * max(root.values())
        return [(i, j, each / WIDER) for (i, j), each in root.items() if each > least]

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Amplitudes for each face, mm."""
        if (probe := site.instrument.probe) is None:
            return {}
        return {self.key: weighted(np.array([std for *_, std in self._terms]), self.size, "mm", probe.label)}

    def columns(self, site: Site) -> tuple[str, ...]:
        """Columns of a row's place on its face."""
        del site
        return ("along", "across")

    def values(self, site: Site, rows: SurveyedRows) -> Mapping[str, Array]:
        """Places by the nominal tips; the middle of a face that was not fitted."""
        probe = site.instrument.probe
        places = rows.survey.places(rows.samples, rows.tips, None if probe is None else probe.label)
        return {"along": places[:, 0], "across": places[:, 1]}

    def residual(self, here: Here) -> Expression:
        """Residual change: minus the height of the face, mm."""
        u = getattr(here.p, self.key)
        sines = [
            ca.sin(math.pi * i * (here.row.along + WIDER) / (2 * WIDER))
            * ca.sin(math.pi * j * (here.row.across + WIDER) / (2 * WIDER))
            for i, j, _ in self._terms
        ]
        return -ca.dot(u, ca.vertcat(*sines))


@dataclass(frozen=True, kw_only=True)
class SphereForm(Effect):
    """Spheres that are not round: a smooth radius over the directions of each, without size and place.

    The harmonics of second degree, u' A u with u the direction from centre to tip and A symmetric without trace; those
    of the zeroth and first are radius and centre. Balls ground between plates are of such a form.

    Args:
        size: standard deviation of the radius over all directions, mm.

    """

    size: float = 3e-3
    doubt: float = 10.0

    moves = False
    most = 1e3
    key = "roundness"
    words = "form error of the spheres"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Five amplitudes for each sphere, mm."""
        if not is_plainly(site.instrument, "points.SphereTouch"):
            return {}
        return {self.key: weighted(np.ones(5), self.size, "mm", site.instrument.unknowns["centre"].per)}

    def residual(self, here: Here) -> Expression:
        """Residual change: minus the rise of the sphere where the ball touches it, mm."""
        away = transform_point(here.pose, here.p.tool) - here.p.centre
        x, y, z = ca.vertsplit(away / ca.norm_2(away))
        waves = [x * y, y * z, x * z, (x**2 - y**2) / 2, (3 * z**2 - 1) / math.sqrt(12)]  # each of mean square 1 / 15
        return -ca.dot(getattr(here.p, self.key), math.sqrt(3) * ca.vertcat(*waves))


@dataclass(frozen=True, kw_only=True)
class PlateForm(Effect):
    """A plate of known points that is bent and twisted: a second-degree height over it, along its normal.

    Args:
        size: standard deviation of each of the three heights at the edge, mm.

    """

    size: float = 0.01
    doubt: float = 10.0

    moves = False
    most = 1e3
    key = "bow"
    words = "form error of the plate"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Bend along, twist, and bend across, mm."""
        plate = is_plainly(site.instrument, "points.KnownPoint")
        return {self.key: weighted(np.ones(3), self.size, "mm")} if plate else {}

    def residual(self, here: Here) -> Expression:
        """Residual change: minus the height of the row's point, mm, in the plate's frame."""
        known = here.instrument.known_columns
        frame = FaceFrame.of(np.array([list(known[axis].values()) for axis in "xyz"]).T)
        point = ca.vertcat(here.row.x, here.row.y, here.row.z)
        a, b = ca.vertsplit(ca.mtimes(frame.axes, point - frame.centre) / frame.half)
        return -np.cross(*frame.axes) * ca.dot(getattr(here.p, self.key), ca.vertcat(a**2, a * b, b**2))


@dataclass(frozen=True, kw_only=True)
class Drift(OverTime):
    """A zero that wanders over the order of the lines: a slope, and slow waves.

    Args:
        size: of the way from the first row to the last, mm.

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
        """Amplitudes of linear growth and of growth that saturates early."""
        del site
        return {self.key: weighted(np.ones(2), self.size, "1")}

    def pose(self, here: Here) -> Expression:
        """Flange pose with its position scaled by the growth."""
        u, t = getattr(here.p, self.key), here.row.when
        grown = 1 + u[0] * t + u[1] * (1 - ca.exp(-SOON * t))
        matrix = here.pose.matrix if isinstance(here.pose, Product) else ca.SX(here.pose)
        return ca.vertcat(ca.horzcat(matrix[:3, :3], matrix[:3, 3] * grown), matrix[3, :])


@dataclass(frozen=True, kw_only=True)
class JointField(Effect):
    """Residual error field: errors along the residual, correlated between similar postures.

    A Gaussian process of squared exponential covariance over the joint values, by what it has in common with its values
    at a few rows: the first pivots of the Cholesky factor of the fitted rows' covariance (Harbrecht, Peters and
    Schneider, Applied Numerical Mathematics 62, 2012).

    Args:
        size: standard deviation, mm.
        reach: radians over which errors are alike; of a sliding joint, a quarter of its travel counts as one.
        rank: how many rows stand for all.

    """

    size: float = 4e-3
    doubt: float = 10.0
    reach: float = 1.0
    rank: int = 24

    moves = False
    most = 1e3  # an error of unknown origin has no physical size
    key = "field"
    words = "posture-dependent error"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Amplitude of the field at each pivot row, given the pivots before, by component of the residual, mm."""
        return {self.key: weighted(np.ones(self._pivots(site) * site.components), self.size, "mm")}

    def columns(self, site: Site) -> tuple[str, ...]:
        """Columns of a row's covariance with the pivots, whitened by that of the pivots among themselves."""
        return tuple(f"{self.key}_like{k + 1}" for k in range(self._pivots(site)))

    def values(self, site: Site, rows: SurveyedRows) -> Mapping[str, Array]:
        """Those columns, from the joint values of the rows and of the fitted ones."""
        names, here = self.columns(site), self._places(site, rows.samples)
        pivots, like = _pivots(self._places(site, rows.survey.samples), len(names)), np.zeros((len(here), len(names)))
        root = np.linalg.cholesky(_alike(pivots, pivots) + JITTER * np.eye(len(pivots)))
        like[:, : len(pivots)] = solve_triangular(root, _alike(pivots, here), lower=True).T
        return dict(zip(names, like.T, strict=True))

    def residual(self, here: Here) -> Expression:
        """Error of each component: the sum over the pivots."""
        like = ca.vertcat(*(getattr(here.row, name) for name in self.columns(here)))
        return ca.mtimes(ca.reshape(getattr(here.p, self.key), -1, here.components).T, like)

    def _pivots(self, site: Site) -> int:
        """Number of pivot rows; each component of the residual has its own unknowns."""
        return min(self.rank, max(MOST_UNKNOWNS // site.components, 1))

    def _places(self, site: Site, samples: Samples) -> Array:
        """Joint values (N, n) in units of the reach."""
        low, high = site.robot.limits
        travel = np.where(np.isfinite(high - low), (high - low) / 4, 100.0)
        return np.asarray(samples.joints / np.where(site.robot.revolute, 1.0, travel) / self.reach)


def _alike(one: Array, other: Array) -> Array:
    """Covariance (m, n) of a process of size one at places (m, k) and (n, k)."""
    square = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2 * one @ other.T
    return np.asarray(np.exp(-np.maximum(square, 0.0) / 2))


def _pivots(places: Array, rank: int) -> Array:
    """Pivots (r, k), r at most `rank`, among places (N, k): each the one of largest remaining variance."""
    left, factors, chosen = np.ones(len(places)), np.zeros((len(places), rank)), []
    for k in range(min(rank, len(places))):
        pivot = int(np.argmax(left))
        if left[pivot] < ENOUGH:
            break
        chosen.append(pivot)
        column = _alike(places, places[pivot][None])[:, 0] - factors[:, :k] @ factors[pivot, :k]
        factors[:, k] = column / np.sqrt(left[pivot])
        left = np.maximum(left - factors[:, k] ** 2, 0.0)
    return places[chosen]

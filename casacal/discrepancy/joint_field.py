"""Errors that are alike in like postures: a Gaussian process of low rank."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.linalg import solve_triangular

from casacal.array_types import Array
from casacal.discrepancy.effect import Effect, Here, Site, weighted
from casacal.discrepancy.survey import Rows
from casacal.kinematics import Expression
from casacal.samples.samples import Samples
from casacal.unknowns import Parameter

JITTER = 1e-9
"""Added to a covariance of one, so that rows at one place can both be pivots."""


MOST_UNKNOWNS = 150
"""Of all components of a residual together; the time that a fit takes grows with their cube."""

ENOUGH = 1e-3
"""Variance of a row, of one, below which it tells nothing that others have not told."""


@dataclass(frozen=True, kw_only=True)
class JointField(Effect):
    """What is left: errors along the residual that are alike in like postures.

    A Gaussian process of squared exponential covariance over the joint values, by what it has in common with its values
    at a few rows: the first pivots of the Cholesky factor of the fitted rows' covariance (Harbrecht, Peters and
    Schneider, Applied Numerical Mathematics 62, 2012).

    Args:
        size: standard deviation, mm.
        doubt: times by which that may be off.
        reach: radians over which errors are alike; of a sliding joint, a quarter of its travel counts as one.
        rank: how many rows stand for all.

    """

    size: float = 4e-3
    doubt: float = 10.0
    reach: float = 1.0
    rank: int = 24

    moves = False
    most = 1e3  # what else errs has no physical size
    key = "field"
    words = "posture-dependent error"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """What each of these rows has of it beyond those before, component by component of the residual, mm."""
        return {self.key: weighted(np.ones(self._pivots(site) * site.components), self.size, "mm")}

    def columns(self, site: Site) -> tuple[str, ...]:
        """How alike a row is to each of them."""
        return tuple(f"{self.key}_like{k + 1}" for k in range(self._pivots(site)))

    def values(self, site: Site, rows: Rows) -> Mapping[str, Array]:
        """By their joint values and those of the fitted rows."""
        rank = self._pivots(site)
        pivots = _pivots(self._places(site, rows.survey.samples), rank)
        like = np.zeros((len(rows.samples), rank))
        root = np.linalg.cholesky(_alike(pivots, pivots) + JITTER * np.eye(len(pivots)))
        here = self._places(site, rows.samples)
        like[:, : len(pivots)] = solve_triangular(root, _alike(pivots, here), lower=True).T
        return {name: like[:, k] for k, name in enumerate(self.columns(site))}

    def residual(self, here: Here) -> Expression:
        """The sum over these rows, for each component."""
        like = ca.vertcat(*(getattr(here.row, name) for name in self.columns(here)))
        return ca.mtimes(ca.reshape(getattr(here.p, self.key), -1, here.components).T, like)

    def _pivots(self, site: Site) -> int:
        """How many rows stand for all, where each component of the residual has its own."""
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
    """Those places (r, k), r at most `rank`, at which the process tells most of what it is at all of them (N, k)."""
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

"""How far from fitted planes the priors let the drawn arm be, and how surprising it is to find it nearer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.least_squares.elimination import taken_out, triangle

MOST_ROWS = 20_000
"""Rows that the scatter is worked out from; more add memory, not insight."""


@dataclass(frozen=True)
class PriorScatter:
    """What prior errors of the arm and the noise predict for the residuals of the drawn arm, planes fitted."""

    rms: float
    """Root mean square residual to expect, mm."""
    freedom: float
    """Degrees of freedom of a chi-square with the same mean and variance as the mean square, scaled."""

    def chance_below(self, rms: float) -> float:
        """How probable it is that the drawn arm misses the planes by no more than `rms` (mm)."""
        from scipy.special import gammainc  # scipy.stats takes half a second to import

        return float(gammainc(self.freedom / 2, self.freedom * (rms / self.rms) ** 2 / 2))


def prior_scatter(bound: BoundProblem, *, flat_counts: bool = False) -> PriorScatter:
    """The scatter at the nominal; a flat prior of the arm counts as none, so that it is never overstated.

    Where it must not be understated, `flat_counts`, a flat prior counts as wide as filters start it.

    The mean square residual is a sum of squares of independent normal numbers, weighted with eigenvalues; two moments
    of it are matched (Satterthwaite).
    """
    stds = bound.start_std if flat_counts else bound.prior_std
    if bound.groups is not None:
        return _of_many_faces(bound, stds)
    if len(bound.measured) > MOST_ROWS:
        bound = bound.take(np.unique(np.linspace(0, len(bound.measured) - 1, MOST_ROWS).astype(int)))
    noise = bound.noise
    slopes = bound.jacobian(bound.x0) * noise[:, None]
    arm = ~bound.datum & np.isfinite(stds)
    moved, planes = slopes[:, arm] * stds[arm], slopes[:, bound.datum]
    left = moved - planes @ np.linalg.lstsq(planes, moved, rcond=None)[0]
    return _matched(left.T @ left / len(noise), noise)


def _of_many_faces(bound: BoundProblem, stds: Array) -> PriorScatter:
    """The same, faces taken out one by one."""
    noise = bound.noise
    parts = []
    for part in bound.group_rows(bound.x0):
        plain = replace(part, own=part.own * noise[part.rows, None], shared=part.shared * noise[part.rows, None])
        parts.append(taken_out(plain).rows)
    assert bound.groups is not None
    shared = bound.groups.shared
    arm = np.isfinite(stds[shared]) & ~bound.datum[shared]
    moved = triangle(parts, shared.size)[:, arm] * stds[shared][arm]
    return _matched(moved.T @ moved / len(noise), noise)


def _matched(powers: Array, noise: Array) -> PriorScatter:
    """From the mean square residual as a quadratic form of independent prior errors, and the noise of each row."""
    mean = float(np.trace(powers) + (noise**2).mean())
    variance = float((powers**2).sum() + (noise**4).mean() / len(noise))
    return PriorScatter(math.sqrt(mean), mean**2 / variance)

"""What is known of the tip while touches come in, and which touch lowers its error most."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.measuring.known import Known
from casacal.measuring.linear import LinearRows
from casacal.measuring.touch import Touch
from casacal.planning.exchange import gains
from casacal.samples.samples import Samples
from casacal.uncertainty.workspace import up_to_base, workspace_joints
from casacal.values import Value

SURE = 0.95
"""Part of all arms whose error stays below what is promised."""

POOL = 600
"""Touches among which the next one is looked for."""

MOST = 200
"""More touches than nobody makes."""


def wanted_field(bound: BoundProblem, joints: Array) -> Array:
    """Moves (3 M, n) of the tip at joint values (M, q), apart from the position of the base, per unit of the belief."""
    frame = workspace_joints(bound.problem.robot)
    sets = [(bound.tip_jacobian(bound.x0, q), bound.tips(bound.x0, q)) for q in (joints, frame)]
    return np.asarray(up_to_base(*sets[0], *sets[1]) * bound.start_std)


def spectrum(root: Array, field: Array) -> Array:
    """Weights (n,) of the squared RMS tip error as a sum of squares of independent unit normals, mm^2.

    root: R (n, n) of a belief whose covariance is R R'.
    """
    moves = field @ root
    return np.asarray(np.maximum(np.linalg.eigvalsh(moves.T @ moves) * 3 / len(field), 0.0))


def expected_error(weights: Array) -> float:
    """Root of the mean squared tip error, mm."""
    return math.sqrt(float(weights.sum()))


def error_below(weights: Array, sure: float = SURE) -> float:
    """The RMS tip error (mm) below which a part of all arms stays.

    By the first three moments of the sum, between which lies a gamma distribution (Pearson's third).
    """
    mean, variance, third = (float((weights**k).sum()) for k in (1, 2, 3))
    if not variance > 0:
        return 0.0
    spread, skew = math.sqrt(2 * variance), 8 * third / (2 * variance) ** 1.5
    shape = 4 / skew**2
    return math.sqrt(max(mean + spread * (float(gammaincinv(shape, sure)) - shape) / math.sqrt(shape), 0.0))


@dataclass(frozen=True, eq=False)
class Pool(Value):
    """Touches that could be made: rows of the arm as drawn, their whitened slopes (N, m, n) in units of the belief."""

    samples: Samples
    slopes: Array

    @staticmethod
    def of(known: Known, samples: Samples) -> Pool:
        """Those of faces that the belief knows."""
        instrument, there = known.bound.problem.instrument, np.ones(len(samples), dtype=bool)
        have = {slot.name for slot in known.bound.slots}
        for key, unknown in instrument.unknowns.items():
            if unknown.per is not None:
                labels = samples.labels[unknown.per]
                named = [f"{key}.{instrument.instance(key, name)}" in have for name in labels.names]
                there &= np.array(named)[labels.codes]
        rows = samples.take(np.flatnonzero(there))
        return Pool(rows, LinearRows.of(known, rows).slope)

    def most_telling(self, covariance: Array, field: Array) -> int:
        """The number of the touch that lowers the tip error most, of a belief with a covariance (n, n)."""
        return int(np.argmax(gains(self.slopes, covariance, field.T @ field)))

    def best(self, known: Known, field: Array) -> Touch:
        """The touch that lowers the tip error most."""
        return Touch.of(self.samples, self.most_telling(known.covariance, field))

    def needed(self, known: Known, field: Array, tolerance: float) -> int | None:
        """How many more touches, each the best after the one before it, bring the error below a tolerance.

        None where as many as `MOST` do not.
        """
        covariance = known.covariance
        for count in range(MOST + 1):
            values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
            if error_below(spectrum(vectors * np.sqrt(np.maximum(values, 0.0)), field)) <= tolerance:
                return count
            slope = self.slopes[self.most_telling(covariance, field)]
            across = slope @ covariance
            told = np.eye(len(slope)) + across @ slope.T
            covariance = covariance - across.T @ np.linalg.solve(told, across)
        return None

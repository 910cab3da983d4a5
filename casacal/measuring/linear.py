"""Touches linear about a belief: where others expect one, what is known of the tip, and which lowers its error most."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from casacal.array_types import Array
from casacal.estimators.sckf import Belief
from casacal.measuring.known import Known, covered
from casacal.measuring.touch import Touch, rows_of
from casacal.planning.choice import gains, row_slopes
from casacal.samples.samples import Samples
from casacal.uncertainty.fresh_rows import chance
from casacal.values import Value

SURE = 0.95  # part of all arms whose error stays below what is promised
POOL = 600  # touches among which the next one is looked for
MOST = 200  # more touches than nobody makes


@dataclass(frozen=True, eq=False)
class ShiftedBelief:
    """A Gaussian by which touches are expected: its mean is so far (n,) from the belief's; its covariance (n, n).

    evidence: logarithm of that of the rows that told it, less a constant for each row.
    """

    shift: Array
    covariance: Array
    evidence: float = 0.0

    @staticmethod
    def by(belief: Belief) -> ShiftedBelief:
        """The belief itself."""
        return ShiftedBelief(np.zeros(belief.mean.size), np.asarray(belief.root @ belief.root.T))

    def of(self, residual: Array, slope: Array) -> tuple[Array, Array]:
        """By how much a touch is off, residual (m,) and slope (m, n), whitened: value (m,) and covariance (m, m)."""
        return residual + slope @ self.shift, np.eye(len(residual)) + slope @ self.covariance @ slope.T


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Rows linear about a belief, in its units: residuals (touches, m), slopes (touches, m, n), whitened; noise, mm."""

    residual: Array
    slope: Array
    noise: Array

    @staticmethod
    def of(known: Known, touches: Sequence[Touch] | Samples) -> LinearRows:
        """Of touches, about what is known."""
        samples = touches if isinstance(touches, Samples) else rows_of(touches)
        bound, x = known.bound.on(samples), known.x
        return LinearRows(bound.residual(x).reshape(len(samples), -1), row_slopes(bound, x), bound.block.noise)

    def without(self, k: int) -> LinearRows:
        """All but one."""
        return LinearRows(*(np.delete(part, k, axis=0) for part in (self.residual, self.slope, self.noise)))

    def told(self, mean: Array) -> ShiftedBelief:
        """What they tell together, with the unit prior about -mean of the shift."""
        r, j = self.residual.ravel(), self.slope.reshape(-1, mean.size)
        information, gradient = np.eye(mean.size) + j.T @ j, j.T @ r + mean
        covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
        shift = -covariance @ gradient
        chi_square = r @ r + mean @ mean + gradient @ shift
        return ShiftedBelief(shift, covariance, -float(chi_square + np.linalg.slogdet(information)[1]) / 2)

    def off(self, told: ShiftedBelief, k: int) -> tuple[Array, Array]:
        """By how much a touch is off, and the standard deviation of that (m,), mm."""
        value, spread = told.of(self.residual[k], self.slope[k])
        return value * self.noise[k], np.sqrt(np.diagonal(spread)) * self.noise[k]


def innovations_at(known: Known, touches: Sequence[Touch]) -> tuple[Array, Array]:
    """What each touch would be off by if it came next, and the standard deviation of that, both (touches, m), mm."""
    rows, told = LinearRows.of(known, touches), ShiftedBelief.by(known.belief)
    off, stds = zip(*(rows.off(told, k) for k in range(len(touches))), strict=True)
    return np.array(off), np.array(stds)


def chance_of(known: Known, touches: Sequence[Touch]) -> float:
    """Chance that touches are together so far off where all is as is known: chi-square, what they share counted."""
    rows, told = LinearRows.of(known, touches), ShiftedBelief.by(known.belief)
    value, spread = told.of(rows.residual.ravel(), rows.slope.reshape(-1, told.shift.size))
    return chance(square(value, spread), len(value))


def log_density(value: Array, spread: Array) -> float:
    """Logarithm of how likely a value (m,) of covariance (m, m) is, less a constant for each number."""
    return -float(square(value, spread) + np.linalg.slogdet(spread)[1]) / 2


def square(value: Array, spread: Array) -> float:
    """Squared length of a value (m,) by its covariance (m, m)."""
    return float(value @ np.linalg.solve(spread, value))


def length(value: Array) -> float:
    """The number itself with its sign; of several, their length."""
    return float(value[0]) if len(value) == 1 else math.sqrt(float((value**2).sum()))


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
        rows = samples.take(np.flatnonzero(covered(known.bound, samples)))
        return Pool(rows, LinearRows.of(known, rows).slope)

    def most_telling(self, covariance: Array, field: Array) -> int:
        """The number of the touch that lowers the tip error most, of a belief with a covariance (n, n)."""
        return int(np.argmax(gains(self.slopes, covariance, field.T @ field)))

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

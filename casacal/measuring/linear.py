"""Touches linear about a belief: what they tell together, and where each would be expected by the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.estimators.sckf import Belief
from casacal.measuring.known import Known
from casacal.measuring.touch import Touch, rows_of
from casacal.samples.samples import Samples


@dataclass(frozen=True, eq=False)
class Told:
    """A Gaussian by which touches are expected: its mean is so far (n,) from the belief's; its covariance (n, n).

    evidence: logarithm of that of the rows that told it, less a constant for each row.
    """

    shift: Array
    covariance: Array
    evidence: float = 0.0

    @staticmethod
    def by(belief: Belief) -> Told:
        """The belief itself."""
        return Told(np.zeros(belief.mean.size), np.asarray(belief.root @ belief.root.T))

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
        slopes = (bound.jacobian(x) * bound.start_std).reshape(len(samples), -1, bound.unknowns)
        return LinearRows(bound.residual(x).reshape(len(samples), -1), slopes, bound.block.noise)

    def without(self, k: int) -> LinearRows:
        """All but one."""
        return LinearRows(*(np.delete(part, k, axis=0) for part in (self.residual, self.slope, self.noise)))

    def told(self, mean: Array) -> Told:
        """What they tell together, with the unit prior about -mean of the shift."""
        r, j = self.residual.ravel(), self.slope.reshape(-1, mean.size)
        information, gradient = np.eye(mean.size) + j.T @ j, j.T @ r + mean
        covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
        shift = -covariance @ gradient
        chi_square = r @ r + mean @ mean + gradient @ shift
        return Told(shift, covariance, -float(chi_square + np.linalg.slogdet(information)[1]) / 2)

    def off(self, told: Told, k: int) -> tuple[Array, Array]:
        """By how much a touch is off, and the standard deviation of that (m,), mm."""
        value, spread = told.of(self.residual[k], self.slope[k])
        return value * self.noise[k], np.sqrt(np.diagonal(spread)) * self.noise[k]


def innovations_at(known: Known, touches: Sequence[Touch]) -> tuple[Array, Array]:
    """What each touch would be off by if it came next, and the standard deviation of that, both (touches, m), mm."""
    rows, told = LinearRows.of(known, touches), Told.by(known.belief)
    off, stds = zip(*(rows.off(told, k) for k in range(len(touches))), strict=True)
    return np.array(off), np.array(stds)


def log_density(value: Array, spread: Array) -> float:
    """Logarithm of how likely a value (m,) of covariance (m, m) is, less a constant for each number."""
    return -float(square(value, spread) + np.linalg.slogdet(spread)[1]) / 2


def square(value: Array, spread: Array) -> float:
    """Squared length of a value (m,) by its covariance (m, m)."""
    return float(value @ np.linalg.solve(spread, value))


def length(value: Array) -> float:
    """The number itself with its sign; of several, their length."""
    return float(value[0]) if len(value) == 1 else math.sqrt(float((value**2).sum()))

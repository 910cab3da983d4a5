"""Score tests of random effects beside a fit: does anything lie along columns of which the fit knows nothing.

About the estimate x of a geometry with information Lambda beforehand, rows y = r - J x are N(0, s^2 V) with
V = I + J Lambda^-1 J', flat unknowns projected out. V^-1 = I - J C J' with C = (J'J + Lambda)^-1, so that V^-1 y is
the residual r at the minimum. An effect of columns B and size t adds t^2 B B' to V. In the eigenvectors of
K = B'V^-1 B the scores B'V^-1 y are independent, z_i^2 of them chi-square where there is no effect and 1 + t^2 k_i
times as large where there is. Most powerful against a size t is sum z_i^2 t^2 k_i / (1 + t^2 k_i) (Neyman and Pearson;
King, Journal of Econometrics 34, 1987): near the sum of squared scores for small t, near s'K^+ s for large ones. The
size that one expects of an arm finds what is weak and of few kinds, ten times as much what is strong and of many; both
are tested and their chances combined, at hardly any cost, as they are nearly the same test. The rest of the rows tells
the noise, as in Student's t: it then matters neither what was stated, nor that an effect makes noise look larger.
All is in J'J, J'B, B'B and B'r: nothing is N by N.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casacal.array_types import Array
from casacal.least_squares.linalg import posterior_covariance
from casacal.uncertainty.quadratic_forms import chance_beyond, together

TINY = 1e-300

SEEN = 1e-9
"""Part of the squared length of a column that the geometry must leave for it to be seen at all."""

TESTED = (1.0, 10.0)
"""Times the expected size against which the tests are most powerful."""

SIZES = np.exp(np.linspace(-7.0, 7.0, 1401))
"""Times by which effects may be larger than expected, from a thousandth on."""


@dataclass(frozen=True)
class Ground:
    """A geometry at its minimum: covariance C (n, n), what it leaves of the rows, and their degrees of freedom.

    step: (n,), to the minimum from where J was taken. square: y'V^-1 y.
    """

    covariance: Array
    step: Array
    square: float
    freedom: float

    @staticmethod
    def of(information: Array, gradient: Array, square: float, rows: int, prior_std: Array, away: Array) -> Ground:
        """From J'J (n, n), J'r (n,), r'r, the number of rows, the prior, and x - x0 (n,)."""
        covariance = posterior_covariance(information, prior_std)
        known = np.isfinite(np.diagonal(covariance))
        covariance = np.where(np.isfinite(covariance), covariance, 0.0)
        prior = np.where(np.isfinite(prior_std), 1.0 / prior_std**2, 0.0)
        slope = gradient + prior * away
        step = -covariance @ slope
        left = square + float(prior @ away**2) + float(slope @ step)
        return Ground(covariance, step, max(left, 0.0), float(rows - (known & ~np.isfinite(prior_std)).sum()))


@dataclass(frozen=True)
class Score:
    """Scores of one effect along the eigenvectors of K: k (m,), z^2 (m,), and what lies along none of them."""

    values: Array
    squares: Array
    rest: float
    freedom: float

    @staticmethod
    def of(ground: Ground, square: Array, cross: Array, toward: Array) -> Score:
        """Of columns B (N, m) of expected size one: B'B (m, m), J'B (n, m) and B'r (m,)."""
        left = square - cross.T @ ground.covariance @ cross
        values, vectors = np.linalg.eigh((left + left.T) / 2)
        kept = values > SEEN * max(float(np.diagonal(square).max(initial=0.0)), TINY)
        scores = vectors[:, kept].T @ (toward + cross.T @ ground.step)
        squares = scores**2 / values[kept]
        rest = max(ground.square - float(squares.sum()), 0.0)
        return Score(values[kept], squares, rest, ground.freedom - float(kept.sum()))

    @property
    def seen(self) -> bool:
        """Whether the rows can say anything of it."""
        return bool(self.values.size) and self.freedom >= 1

    @property
    def chance(self) -> float:
        """Chance of so much along its columns where there is no effect; noise is told by the rest of the rows."""
        chances = []
        for size in TESTED:
            ratios = size**2 * self.values
            chances.append(chance_beyond(ratios / (1 + ratios), self.squares, self.rest, self.freedom))
        return together(chances)

    @cached_property
    def size(self) -> float:
        """Times the expected size at which the rows are likeliest: restricted likelihood, noise found beside it."""
        total, noise = self.freedom + len(self.values), max(self.rest / self.freedom, TINY)
        ratios = np.append(0.0, SIZES**2)[:, None] * self.values / noise
        left = np.maximum(self.rest + (self.squares / (1 + ratios)).sum(axis=1), TINY)
        best = int(np.argmin(total * np.log(left) + np.log1p(ratios).sum(axis=1)))
        return 0.0 if best == 0 else float(SIZES[best - 1]) * math.sqrt(float(left[best]) / total / noise)

"""Score tests of random effects beside a fit: does anything lie along columns of which the fit knows nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casacal.array_types import Array
from casacal.least_squares.linalg import information_of, posterior_covariance
from casacal.uncertainty.quadratic_forms import chance_beyond, together
from casacal.wording import sized

CLEAR = 0.01  # chance, after all that was tested, below which an effect is taken to be there
SUSPICIOUS = 0.05  # chance of one test alone below which an effect may be there


@dataclass(frozen=True)
class ScoreTest:
    """One effect beside the geometry: whether the rows show it, and what it would do.

    key, words: as effects and reports call it. p: chance of rows like these where there is no such effect. p_holm: the
    same of the least of as many tests. size: at which the rows are likeliest, the effect alone. expected_size: of any
    arm, NaN where nothing is expected. tip_mm: what an effect of that size does to the tip where only the geometry is
    fitted, its own motion and what it makes of the estimate, RMS over the workspace apart from the base.
    """

    key: str
    words: str
    p: float
    p_holm: float
    size: float
    expected_size: float
    unit: str
    tip_mm: float
    leads: bool = False
    """Whether it is one of those that explain the rows, each beside those before it (`leading_tests`)."""

    @property
    def shown(self) -> str:
        """Whether the rows show it; what a likelier effect explains as well they do not."""
        if self.leads:
            return "yes"
        return "explained" if self.p_holm < CLEAR else "perhaps" if self.p < SUSPICIOUS else "no"

    @property
    def shown_size(self) -> str:
        """The size as people read it."""
        return sized(self.size, self.unit)


TINY = 1e-300

SEEN = 1e-9  # part of the squared length of a column that the geometry must leave for it to be seen at all
TESTED = (1.0, 10.0)  # times the expected size against which the tests are most powerful
SIZES = np.exp(np.linspace(-7.0, 7.0, 1401))  # times by which effects may be larger than expected, from a thousandth on


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
        prior = information_of(prior_std)
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

"""How small the smallest of many correlated chances must be: the null drawn in the whitened space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casacal.array_types import Array
from casacal.changes.whitened import Whitened, chances

DRAWS = 20_000
"""Sets of rows of an arm that has not changed: the rate of false alarms is met to 0.0007 at 1 %."""

AT_ONCE = 4_000_000
"""Numbers that are drawn at once."""

SPARE = 1e-6
"""Part of a row's residual that must be left to it for it to be judged by the others."""


def row_bases(whitened: Whitened, count: int, per_row: int) -> Array:
    """Orthonormal bases (rows, m, per_row) of what each row alone could be off by; zero where nobody could tell."""
    found = np.zeros((count, len(whitened.residual), per_row))
    for k in range(count):
        alone = np.zeros((len(whitened.residual), per_row))
        alone[k * per_row + np.arange(per_row), np.arange(per_row)] = 1.0
        left, values, _ = np.linalg.svd(whitened.of_columns(alone), full_matrices=False)
        found[k] = left * (values**2 > SPARE)
    return found


class AllTests:
    """All tests of fresh rows at once: of each cause, of single rows, and of everything."""

    def __init__(self, whitened: Whitened, bases: Sequence[Array], rows: Array, noise_freedom: float) -> None:
        self.whitened, self.bases, self.rows, self.noise = whitened, list(bases), rows, noise_freedom
        self.freedoms = np.array([basis.shape[1] for basis in bases], dtype=np.float64)
        self.row_freedoms = np.rint((rows**2).sum(axis=(1, 2)))
        self._every = np.hstack([*self.bases, *rows]) if len(rows) else np.hstack(self.bases)

    def at(self, residual: Array) -> AllTests:
        """The same tests of another whitened residual (m,)."""
        return AllTests(replace(self.whitened, residual=residual), self.bases, self.rows, self.noise)

    @property
    def judged(self) -> int:
        """How many rows the others can judge."""
        return int((self.row_freedoms > 0).sum())

    def falls(self, residuals: Array) -> tuple[Array, Array, Array]:
        """Fall of chi-square by each cause (D, causes) and row (D, rows), and chi-square itself (D,).

        residuals: (D, m), whitened.
        """
        squares = (residuals @ self._every) ** 2
        ends = np.cumsum(self.freedoms).astype(np.intp)
        parts = np.split(squares, ends, axis=1)
        by_cause = np.column_stack([part.sum(axis=1) for part in parts[:-1]]) if self.bases else parts[-1][:, :0]
        by_row = parts[-1].reshape(len(residuals), len(self.rows), -1).sum(axis=2)
        inside = residuals - (residuals @ self.whitened.own) @ self.whitened.own.T
        return by_cause, by_row, (inside**2).sum(axis=1)

    def chances(self, falls: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Chance of each fall; of single rows times as many as there are (Bonferroni)."""
        by_cause, by_row, everything = falls
        return (
            chances(by_cause, self.freedoms, self.noise),
            np.minimum(self.judged * chances(by_row, self.row_freedoms, self.noise), 1.0),
            chances(everything, float(self.whitened.freedom), self.noise),
        )

    def smallest(self, residuals: Array, noise: Array | float = 1.0) -> Array:
        """The smallest chance (D,) of whitened residuals (D, m) whose noise was found to be so many times the true."""
        squared = np.broadcast_to(np.asarray(noise) ** 2, (len(residuals),))
        by_cause, by_row, everything = self.falls(residuals)
        found = chances(everything / squared, float(self.whitened.freedom), self.noise)
        for falls, freedoms, times in ((by_cause, self.freedoms, 1.0), (by_row, self.row_freedoms, self.judged)):
            for freedom in np.unique(freedoms[freedoms > 0]):  # of one freedom the largest fall is the least likely
                largest = falls[:, freedoms == freedom].max(axis=1)
                found = np.minimum(found, times * chances(largest / squared, freedom, self.noise))
        return found

    def level(self, alarm: float, seed: int, draws: int = DRAWS) -> float:
        """Below which the smallest chance of an arm that has not changed falls in this part of all cases."""
        rng, size = np.random.default_rng(seed), len(self.whitened.residual)
        found, left = [], draws
        while left:
            count = min(left, max(AT_ONCE // size, 1))
            noise = np.ones(count)
            if math.isfinite(self.noise):
                noise = np.sqrt(rng.chisquare(self.noise, count) / self.noise)
            found.append(self.smallest(rng.normal(size=(count, size)), noise))
            left -= count
        return float(np.quantile(np.concatenate(found), alarm))

"""Touches linear about a belief, and the evidence of them with the arm and the faces integrated out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.estimators.sckf import Belief
from casacal.measuring.known import Known
from casacal.measuring.touch import Touch, rows_of


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Rows linear about a belief, in its units: residuals (touches, m), slopes (touches, m, n), whitened; noise, mm."""

    residual: Array
    slope: Array
    noise: Array

    @staticmethod
    def of(known: Known, belief: Belief, touches: Sequence[Touch]) -> LinearRows:
        """Of touches, about a mean."""
        bound, count = known.bound.on(rows_of(touches)), len(touches)
        x = bound.x0 + bound.start_std * belief.mean
        slopes = (bound.jacobian(x) * bound.start_std).reshape(count, -1, bound.unknowns)
        return LinearRows(bound.residual(x).reshape(count, -1), slopes, bound.block.noise)

    def without(self, k: int) -> LinearRows:
        """All but one."""
        return LinearRows(*(np.delete(part, k, axis=0) for part in (self.residual, self.slope, self.noise)))

    def evidence(self, mean: Array) -> float:
        """Logarithm, less a constant for each row, with the unit prior about -mean of the shift integrated out."""
        r, j = self.residual.ravel(), self.slope.reshape(-1, mean.size)
        information, gradient = np.eye(mean.size) + j.T @ j, j.T @ r + mean
        chi_square = r @ r + mean @ mean - gradient @ np.linalg.solve(information, gradient)
        return -float(chi_square + np.linalg.slogdet(information)[1]) / 2

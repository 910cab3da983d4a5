"""Fresh rows with unit covariance, and what a fit of some directions takes off their chi-square.

With P of `casacal.uncertainty.fresh_rows`, P = L'L for L = (I - U (I - (I + S^2)^-1/2) U') N, where N B = U S W'. What
L makes of the residuals is standard normal in the space that the rows' own unknowns leave, and the fall of r'P r by
fitting directions A is the squared length of its projection onto L A: a generalised likelihood ratio, chi-square with
rank(L A) degrees of freedom where nothing changed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.uncertainty.fresh_rows import spanned

SEEN = 0.1
"""Whitened length of a plausible change below which its direction is not looked for: rows could never show it."""


@dataclass(frozen=True, eq=False)
class Whitened:
    """Residual (m,) with unit covariance in the space beside the rows' own unknowns, and the way to it."""

    residual: Array
    own: Array
    left: Array
    shrink: Array

    @staticmethod
    def of(residual: Array, spread: Array, own: Array) -> Whitened:
        """Of whitened residuals (m,), spread B (m, k) and own columns (m, o), as `expected` takes them."""
        basis = spanned(own)
        across = spread - basis @ (basis.T @ spread)
        left, sizes, _ = np.linalg.svd(across, full_matrices=False)
        shrink = 1.0 - 1.0 / np.sqrt(1.0 + sizes**2)
        bare = Whitened(residual, basis, left, shrink)
        return Whitened(bare.of_columns(residual[:, None])[:, 0], basis, left, shrink)

    def of_columns(self, columns: Array) -> Array:
        """L times columns (m, k)."""
        beside = columns - self.own @ (self.own.T @ columns)
        return np.asarray(beside - self.left @ (self.shrink[:, None] * (self.left.T @ beside)))

    @property
    def freedom(self) -> int:
        """Dimension of the space in which the residual lies."""
        return int(len(self.residual) - self.own.shape[1])

    @property
    def chi_square(self) -> float:
        """r'P r."""
        return float(self.residual @ self.residual)


def seen_basis(columns: Array, sizes: Array) -> Array:
    """Orthonormal basis (m, rank) of what whitened columns (m, k) span, for changes of these sizes (k,) that show."""
    left, values, _ = np.linalg.svd(columns * sizes, full_matrices=False)
    return np.asarray(left[:, values > SEEN])


def chances(chi_square: Array, freedom: Array | float, noise_freedom: float = math.inf) -> Array:
    """Chance of so much or more, element by element: chi-square, or F where the noise was itself found."""
    from scipy.special import fdtrc, gammaincc

    freedom = np.asarray(freedom, dtype=np.float64)
    some = np.maximum(freedom, 1.0)
    if math.isfinite(noise_freedom):
        found = fdtrc(some, noise_freedom, np.maximum(chi_square, 0.0) / some)
    else:
        found = gammaincc(some / 2, np.maximum(chi_square, 0.0) / 2)
    return np.asarray(np.where(freedom > 0, found, 1.0))


def likelihood(chi_square: float, freedom: int, noise_freedom: float = math.inf) -> float:
    """Logarithm of how likely rows with such a chi-square are: normal, or Student's t where the noise was found."""
    if math.isfinite(noise_freedom):
        return -(noise_freedom + freedom) / 2 * math.log1p(max(chi_square, 0.0) / noise_freedom)
    return -chi_square / 2


def occam(columns: Array, sizes: Array) -> float:
    """What freedom costs in the logarithm of the evidence: half the log-determinant of I + S A'A S."""
    scaled = columns * sizes
    return float(np.linalg.slogdet(np.eye(scaled.shape[1]) + scaled.T @ scaled)[1]) / 2

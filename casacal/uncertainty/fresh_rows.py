"""Fresh rows against a fit's prediction of them: restricted likelihood, in whitened rows.

The residuals of such rows hold their own noise, what the fit may err by, and unknowns that these rows alone know, such
as where a new face stands: r = e + K d + O u with e ~ N(0, I), d ~ N(0, C), u free. What O spans says nothing and is
projected out: with N the projector beside it and B B' = K C K', the rest has the covariance N + N B B' N, so

    r' P r,    P = N - N B (I + B'NB)^-1 B'N,

is chi-square with rows - rank(O) degrees of freedom (Patterson and Thompson 1971). Since (P r)_k / P_kk is the residual
of row k where every other row predicts it, (P r)_k / sqrt(P_kk) is standard normal.

P = L'L for L = (I - U (I - (I + S^2)^-1/2) U') N, where N B = U S W'. What L makes of the residuals is standard normal
in the space beside O, and the fall of r'P r by fitting directions A is the squared length of its projection onto L A: a
generalised likelihood ratio, chi-square with rank(L A) degrees of freedom where nothing changed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import fdtrc, gammaincc, ndtri

from casacal.linalg import ROUNDING, inverse_triangle, svd
from casacal.values import Array, Index

CHANCE = 1e-4  # chance that rows which are as expected have any that is called gross (Bonferroni)
MOST_GROSS = 0.05  # beyond this fraction of the rows (and three of them) it is not single rows that are off
VISIBLE = 0.1  # whitened length of a plausible change below which rows could never show it


@dataclass(frozen=True, eq=False)
class FreshRows:
    """Rows linear about what a fit found, everything whitened.

    residual: r (m,). spread: B (m, k), the derivative by what the fit found times a root of its covariance. own: O (m,
    o), the derivative by the unknowns that these rows alone know.
    """

    residual: Array
    spread: Array
    own: Array

    def take(self, rows: Index) -> FreshRows:
        """Some of the rows."""
        return FreshRows(self.residual[rows], self.spread[rows], self.own[rows])

    @cached_property
    def basis(self) -> Array:
        """Orthonormal basis (m, rank) of the span of the own unknowns, O."""
        return spanned(self.own)

    def projected(self, columns: Array) -> Array:
        """N times columns (m,) or (m, c): their part orthogonal to the own unknowns."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    @cached_property
    def left(self) -> Array:
        """Residuals (m,) with the own unknowns fitted."""
        return self.projected(self.residual)

    @cached_property
    def across(self) -> Array:
        """N B (m, k)."""
        return self.projected(self.spread)

    @cached_property
    def half(self) -> Array:
        """Lower triangular H (k, k) with H'H = (I + B'NB)^-1."""
        across = self.across
        return inverse_triangle(np.asarray(np.linalg.cholesky(np.eye(across.shape[1]) + across.T @ across)))

    @cached_property
    def _pulls(self) -> Array:
        return np.asarray(self.across @ self.half.T)

    @property
    def chi_square(self) -> float:
        """r'P r."""
        toward = self._pulls.T @ self.left
        return float(self.left @ self.left - toward @ toward)

    @property
    def freedom(self) -> int:
        """Rows less what their own unknowns absorb."""
        return int(len(self.residual) - self.basis.shape[1])

    @property
    def std(self) -> Array:
        """Standard deviation (m,) that is expected of each residual, own unknowns fitted."""
        return np.asarray(np.sqrt(np.maximum(1.0 - (self.basis**2).sum(axis=1) + (self.across**2).sum(axis=1), 0.0)))

    @property
    def deleted(self) -> Array:
        """Residuals (m,) where all other rows predict them, standard normal."""
        free = np.maximum(1.0 - (self.basis**2).sum(axis=1) - (self._pulls**2).sum(axis=1), 0.0)
        judged = free > 1e-9  # a row that its own unknowns follow wherever it is has nothing to be judged by
        off = self.left - self._pulls @ (self._pulls.T @ self.left)
        return np.where(judged, off / np.sqrt(np.where(judged, free, 1.0)), 0.0)

    def gross(self) -> Index:
        """Rows that the others do not expect where they are, worst first; none where more than single ones are off.

        One at a time, each judged by the rest; the rest's own scatter, where it is larger than expected, is the
        measure.
        """
        limit = -float(ndtri(CHANCE / (2 * max(len(self.residual), 1))))
        most, kept, found = max(3, int(MOST_GROSS * len(self.residual))), np.arange(len(self.residual)), []
        while kept.size:
            size = np.abs(self.take(kept).deleted)
            worst = int(size.argmax())
            if size[worst] <= limit * max(1.4826 * float(np.median(size)), 1.0):
                break
            found.append(int(kept[worst]))
            if len(found) > most:
                return np.zeros(0, dtype=np.intp)
            kept = np.delete(kept, worst)
        return np.array(found, dtype=np.intp)

    def toward(self, scaled: Array) -> tuple[float, int]:
        """Chi-square in the directions of the arm that fresh rows see, and how many these are.

        An arm that has changed since shows there and nowhere else, so this notices what drowns in the noise of all
        rows. Seen are directions that the rows know better than the prior: whitened singular values of one or more. The
        size of the arm would without that be among them: where faces hold no length, a change of it moves the residuals
        in proportion to themselves. scaled: whitened derivative (m, a) by what may have changed, in units of its prior.
        """
        directions, sizes, _ = svd(self.projected(scaled))
        decided = directions[:, sizes >= 1.0]
        along, left = decided.T @ self.spread, decided.T @ self.residual
        return float(left @ np.linalg.solve(np.eye(len(left)) + along @ along.T, left)), len(left)

    @cached_property
    def directions(self) -> tuple[Array, Array]:
        """U (m, d) and the diagonal of S (d,): directions in which the fit may err, and by how many units of noise."""
        found, sizes, _ = svd(self.across)
        return found, sizes

    def whitened(self, columns: Array) -> Array:
        """L times columns (m, c)."""
        left, (directions, sizes) = self.projected(columns), self.directions
        shrink = 1.0 - 1.0 / np.sqrt(1.0 + sizes**2)
        return np.asarray(left - directions @ (shrink[:, None] * (directions.T @ left)))

    @cached_property
    def white(self) -> Array:
        """L r (m,)."""
        return self.whitened(self.residual[:, None])[:, 0]


def chances(chi_square: Array, freedom: Array | float, noise_freedom: float = math.inf) -> Array:
    """Chance of so much or more, element by element: chi-square, or F where the noise was itself found."""
    freedom = np.asarray(freedom, dtype=np.float64)
    some = np.maximum(freedom, 1.0)
    if math.isfinite(noise_freedom):
        found = fdtrc(some, noise_freedom, np.maximum(chi_square, 0.0) / some)
    else:
        found = gammaincc(some / 2, np.maximum(chi_square, 0.0) / 2)
    return np.asarray(np.where(freedom > 0, found, 1.0))


def chance(chi_square: float, freedom: int, noise_freedom: float = math.inf) -> float:
    """Probability of so much or more; scalar form of `chances`."""
    return float(chances(np.asarray(chi_square), freedom, noise_freedom))


def covariance_root(covariance: Array) -> Array:
    """R (n, k) with R R' = C (n, n), a covariance that rounding may have left a little short of positive."""
    stds = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale = np.where(stds > 0, stds, 1.0)
    scaled = covariance / np.outer(scale, scale)
    try:
        return np.asarray(scale[:, None] * np.linalg.cholesky(scaled))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(scaled)
        held = values > 0
        return np.asarray(scale[:, None] * vectors[:, held] * np.sqrt(values[held]))


def spanned(columns: Array) -> Array:
    """Orthonormal basis (m, rank) of the span of columns (m, k), whatever their units."""
    sizes = np.linalg.norm(columns, axis=0)
    scaled = columns[:, sizes > 0] / sizes[sizes > 0]
    if not scaled.size:
        return np.zeros((len(columns), 0))
    left, values, _ = svd(scaled)
    return np.asarray(left[:, values > ROUNDING * max(scaled.shape) * values.max(initial=0.0)])


def learnt(covariance: Array, jacobian: Array, own: Array) -> Array:
    """Covariance (n, n) of the fit's unknowns after an update by these rows."""
    root = covariance_root(covariance)
    left = root @ FreshRows(np.zeros(len(own)), jacobian @ root, own).half.T
    return np.asarray(left @ left.T)


def visible_basis(columns: Array, sizes: Array) -> Array:
    """Orthonormal basis (m, rank) of whitened columns (m, k), for changes of these sizes (k,) longer than `VISIBLE`."""
    left, values, _ = svd(columns * sizes)
    return np.asarray(left[:, values > VISIBLE])


def likelihood(chi_square: float, freedom: int, noise_freedom: float = math.inf) -> float:
    """Logarithm of how likely rows with such a chi-square are: normal, or Student's t where the noise was found."""
    if math.isfinite(noise_freedom):
        return -(noise_freedom + freedom) / 2 * math.log1p(max(chi_square, 0.0) / noise_freedom)
    return -chi_square / 2


def occam(columns: Array, sizes: Array) -> float:
    """Occam factor in the log evidence: half the log-determinant of I + S A'A S."""
    scaled = columns * sizes
    return float(np.linalg.slogdet(np.eye(scaled.shape[1]) + scaled.T @ scaled)[1]) / 2

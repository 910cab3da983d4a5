"""How likely rows are under what was known beforehand, everything linear where a fit stands.

With J the Jacobian there, y = J x - r and x ~ N(0, L^-1), whitened rows have

    -2 log p = log |L + J'J| - log |L| + min_x (|y - J x|^2 + x' L x),

unknowns without prior projected out (Patterson and Thompson 1971). All that is needed is in J'J, J'y and y'y, so that a
million rows cost no more than a hundred.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from casacal.array_types import Array
from casacal.least_squares.arrow import Arrow
from casacal.least_squares.objective import LeastSquares


@dataclass(frozen=True)
class Told:
    """What rows say where everything is linear: J'J (n, n), J'y (n,) and y'y, whitened."""

    information: Array
    toward: Array
    square: float

    def __add__(self, other: Told) -> Told:
        """Both together."""
        return Told(self.information + other.information, self.toward + other.toward, self.square + other.square)

    def with_noise(self, times: float) -> Told:
        """The same of rows whose noise is some times as large."""
        return Told(self.information / times**2, self.toward / times**2, self.square / times**2)

    @staticmethod
    def of(slopes: Array, heights: Array) -> Told:
        """Of rows J (m, n) and y (m,)."""
        return Told(slopes.T @ slopes, slopes.T @ heights, float(heights @ heights))


def told(problem: LeastSquares, x: Array) -> Told:
    """All rows of a problem at x (n,), about which y = J x - r."""
    normal = problem.normal(x)
    kept = normal.information
    information = np.asarray(kept.dense() if isinstance(kept, Arrow) else kept, dtype=np.float64)
    square = 2 * (normal.cost - float(x @ normal.gradient)) + float(x @ information @ x)
    return Told(information, information @ x - normal.gradient, square)


def evidence(rows: Told, prior: Array) -> float:
    """Logarithm of the marginal likelihood of rows under zero means and a prior's information (n,), but for a constant.

    The constant depends on the rows alone. Unknowns without prior are projected out. -inf where rounding spoils it.
    """
    posterior = rows.information.copy()
    posterior.flat[:: len(prior) + 1] += prior
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(posterior), 1e-300))
    root, failed = dpotrf(scale[:, None] * posterior * scale, lower=1)
    if failed:
        return -np.inf
    at = scale * dpotrs(root, scale * rows.toward, lower=1)[0]
    determinant = 2 * float(np.log(np.diagonal(root)).sum() - np.log(scale).sum()) - float(
        np.log(prior[prior > 0]).sum()
    )
    return -(rows.square - float(rows.toward @ at) + determinant) / 2

"""A least-squares problem in some of its unknowns."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array, Rows
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares, Normal


class Restricted(LeastSquares):
    """A problem in some of its unknowns, the others held at a given x."""

    def __init__(self, whole: LeastSquares, free: Rows, held_at: Array) -> None:
        self.whole, self.free, self.held_at = whole, np.flatnonzero(free), held_at.copy()
        self.names = tuple(whole.names[j] for j in self.free)
        self.units = tuple(whole.units[j] for j in self.free)
        self.x0, self.prior_std = whole.x0[self.free], whole.prior_std[self.free]
        self.start_std, self.datum = whole.start_std[self.free], whole.datum[self.free]

    def expand(self, x: Array) -> Array:
        """All unknowns (..., n) of the whole problem at the free ones (..., m)."""
        full = np.broadcast_to(self.held_at, (*x.shape[:-1], self.held_at.size)).copy()
        full[..., self.free] = x
        return full

    @property
    def rows(self) -> int:
        """Rows of the whole problem."""
        return self.whole.rows

    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,)."""
        return self.whole.residual(self.expand(x))

    def jacobian(self, x: Array) -> Array:
        """Columns of the free unknowns (rows, m)."""
        return self.whole.jacobian(self.expand(x))[:, self.free]

    def compact_jacobian(self, x: Array) -> Array:
        """Rows (k, m) with the J'J of the free columns."""
        return self.whole.compact_jacobian(self.expand(x))[:, self.free]

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states."""
        return self.whole.row(k, self.expand(states))

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient in the free unknowns."""
        r, gradient = self.whole.row_jacobian(k, self.expand(x))
        return r, gradient[self.free]

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Normal equations of the free unknowns."""
        whole = self.whole.normal(self.expand(x), loss)
        return Normal(whole.cost, whole.gradient[self.free], whole.information[np.ix_(self.free, self.free)])

"""A least-squares problem in some of its unknowns: the others are held somewhere, or move freely with these."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array, Rows
from casacal.least_squares.linalg import freed_of
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares, Normal


class Conditioned(LeastSquares):
    """A problem in the unknowns that `free` marks (n,), about a given x (n,).

    The others are held there: what is known of them together with the free ones says where these are to be expected.
    Those that `out` marks are not held but taken out: they move freely with the free ones, and information is what is
    then left. Positions in x are not those of the whole.
    """

    def __init__(self, whole: LeastSquares, free: Rows, at: Array, *, out: Rows | None = None) -> None:
        self.whole, self.free, self.held_at = whole, np.flatnonzero(free), at.copy()
        self.out = np.zeros(0, dtype=np.intp) if out is None else np.flatnonzero(out)
        self.names = tuple(whole.names[j] for j in self.free)
        self.units = tuple(whole.units[j] for j in self.free)
        self.x0, self.prior_std = whole.x0[self.free], whole.prior_std[self.free]
        self.start_std, self.datum = whole.start_std[self.free], whole.datum[self.free]
        self.known = whole.known
        if whole.known is not None:
            held = set(whole.names) - {*self.names, *(whole.names[j] for j in self.out)}
            values = {name: float(at[j]) for j, name in enumerate(whole.names) if name in held}
            self.known = whole.known.given(values).of(self.names)
            self.x0, self.prior_std = self.known.placed(self.names, self.x0, self.prior_std)

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
        """Columns of the free unknowns (rows, m); where some are taken out, as many rows as their J'J needs."""
        return self.compact_jacobian(x) if self.out.size else self.whole.jacobian(self.expand(x))[:, self.free]

    def compact_jacobian(self, x: Array) -> Array:
        """Rows (k, m) with the J'J that is left of the free unknowns."""
        rows = self.whole.compact_jacobian(self.expand(x))
        if not self.out.size:
            return rows[:, self.free]
        prior = self.whole.prior_rows
        held = prior[np.any(prior[:, self.out] != 0, axis=1)]  # what holds the others besides the rows
        own = np.linalg.lstsq(held[:, self.out], held[:, self.free], rcond=None)[0] if len(held) else 0.0
        left = np.vstack([rows[:, self.free] - rows[:, self.out] @ own, np.zeros((len(held), self.free.size))])
        return freed_of(left, np.vstack([rows[:, self.out], held[:, self.out]]))

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states."""
        return self.whole.row(k, self.expand(states))

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient in the free unknowns."""
        r, gradient = self.whole.row_jacobian(k, self.expand(x))
        return r, gradient[self.free]

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Normal equations of the free unknowns, with the others taken out of the information where they are."""
        whole = self.whole.normal(self.expand(x), loss)
        if self.out.size:
            rows = self.compact_jacobian(x)
            return Normal(whole.cost, whole.gradient[self.free], rows.T @ rows)
        return Normal(whole.cost, whole.gradient[self.free], whole.information[np.ix_(self.free, self.free)])

"""A bound problem in its shared unknowns alone, those of single labels taken out: what figures of the arm need."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.slots import Block, Slot
from casacal.least_squares.elimination import taken_out, triangle
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares, Normal
from casacal.problem.problem import Problem


class Marginal(LeastSquares):
    """The shared unknowns (s,) of a bound problem, where single labels have many of their own.

    These stand at a given x and move freely with the shared ones: information is what is left after they are taken
    out. Positions in x are not those of the slots.
    """

    def __init__(self, whole: BoundProblem, at: Array) -> None:
        assert whole.groups is not None
        self.whole, self.at, self.shared = whole, at.copy(), whole.groups.shared
        self.names = tuple(whole.names[j] for j in self.shared)
        self.units = tuple(whole.units[j] for j in self.shared)
        self.x0, self.prior_std = whole.x0[self.shared], whole.prior_std[self.shared]
        self.start_std, self.datum = whole.start_std[self.shared], whole.datum[self.shared]

    @property
    def problem(self) -> Problem:
        """Robot and instruments."""
        return self.whole.problem

    @property
    def blocks(self) -> tuple[Block, ...]:
        """The rows of each instrument."""
        return self.whole.blocks

    @property
    def block(self) -> Block:
        """The rows of the only instrument; raises ProblemError where there are several."""
        return self.whole.block

    @property
    def slots(self) -> Sequence[Slot]:
        """Every unknown, those taken out among them."""
        return self.whole.slots

    @property
    def rows(self) -> int:
        """Scalar residuals of all instruments."""
        return self.whole.rows

    def expand(self, x: Array) -> Array:
        """All unknowns (n,) at the shared ones (s,)."""
        full = self.at.copy()
        full[self.shared] = x
        return full

    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,), the unknowns of single labels where they stand."""
        return self.whole.residual(self.expand(x))

    def jacobian(self, x: Array) -> Array:
        """As many rows as are needed for its J'J: rows of samples mix where unknowns are taken out."""
        return self.compact_jacobian(x)

    def compact_jacobian(self, x: Array) -> Array:
        """Rows (k, s) with the J'J that is left of the shared unknowns."""
        prior = self.whole.prior_information
        parts = (taken_out(part.held(prior[part.members])).rows for part in self.whole.group_rows(self.expand(x)))
        return triangle(parts, self.x0.size)

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states (m, s): (m,)."""
        full = np.tile(self.at, (len(states), 1))
        full[:, self.shared] = states
        return self.whole.row(k, full)

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient (s,), the others held."""
        r, gradient = self.whole.row_jacobian(k, self.expand(x))
        return r, gradient[self.shared]

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost and gradient (s,) where the others stand, information (s, s) with them taken out."""
        there, rows = self.whole.normal(self.expand(x), loss), self.compact_jacobian(x)
        return Normal(there.cost, there.gradient[self.shared], rows.T @ rows)

    def parameters(self) -> Iterator[tuple[str, str, float, int | None]]:
        """Every number of every parameter: name, unit, nominal, and its position in x (None when held)."""
        places = {name: j for j, name in enumerate(self.names)}
        return ((name, unit, nominal, places.get(name)) for name, unit, nominal, _ in self.whole.parameters())

    def tips(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Tips (N, 3; mm) at joint values (N, n; rad, mm) and reading zero."""
        return self.whole.tips(self.expand(x), joints, instrument)

    def tip_jacobian(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Derivative (3 N, s) of those tips by x, in units of mm per unit of x."""
        return self.whole.tip_jacobian(self.expand(x), joints, instrument, self.shared)


Seen: TypeAlias = BoundProblem | Marginal
"""What figures of the arm are worked out from."""


def seen(bound: BoundProblem, x: Array) -> tuple[Seen, Array]:
    """What figures of the arm need at x (n,), and the part of x that it has: all, where labels are few."""
    if bound.groups is None:
        return bound, x
    found = Marginal(bound, x)
    return found, x[found.shared]

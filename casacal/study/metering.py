"""A least-squares problem that counts what is asked of it, so that the harness measures, never the method."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import DampedStep, ExtendedPass, FilterPass, LeastSquares, Normal


class Metered(LeastSquares):
    """The same problem, with counters: rows of residuals and of Jacobians, and the best objective so far.

    best: one (residual rows, Jacobian rows, objective) each time an estimator evaluates a lower objective.
    used_graph: whether a symbolic form was taken, beyond which nothing can be counted here.
    """

    def __init__(self, problem: LeastSquares) -> None:
        self.problem = problem
        self.names, self.units, self.x0 = problem.names, problem.units, problem.x0.copy()
        self.prior_std, self.start_std = problem.prior_std.copy(), problem.start_std.copy()
        self.datum, self.known = problem.datum.copy(), problem.known
        self.residual_rows, self.jacobian_rows, self.used_graph = 0, 0, False
        self.best: list[tuple[int, int, float]] = []

    @property
    def graph(self) -> Any:
        """The symbolic form."""
        self.used_graph = True
        return self.problem.graph

    @property
    def symbolic(self) -> Any:
        """The rows as CasADi expressions, evaluated where nobody can count."""
        self.used_graph = True
        return self.problem.symbolic

    @property
    def rows(self) -> int:
        """Number of scalar residuals."""
        return self.problem.rows

    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,)."""
        r = self.problem.residual(x)
        self._count(self.rows, 0)
        self._seen(float(r @ r) / 2 + self.prior_cost(x))
        return r

    def jacobian(self, x: Array) -> Array:
        """Whitened Jacobian (rows, n)."""
        self._count(0, self.rows)
        return self.problem.jacobian(x)

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient and information of the data."""
        normal = self.problem.normal(x, loss)
        self._count(self.rows, self.rows)
        if loss is None:
            self._seen(normal.cost + self.prior_cost(x))
        return normal

    def damped_step(self, x: Array, normal: Normal, damping: float) -> DampedStep | None:
        """A damped step, which costs no rows."""
        return self.problem.damped_step(x, normal, damping)

    def compact_jacobian(self, x: Array) -> Array:
        """Rows with the J'J of the Jacobian."""
        self._count(0, self.rows)
        return self.problem.compact_jacobian(x)

    def costs(self, states: Array, loss: Loss | None = None) -> Array:
        """Objective at many states (m,)."""
        found = self.problem.costs(states, loss)
        self._count(self.rows * len(states), 0)
        if loss is None:
            self._seen(float(np.min(found, initial=math.inf)))
        return found

    def filter_pass(self, first: int, mean: Array, root: Array) -> FilterPass | None:
        """A fused filter, whose rows see 2 n states each."""
        done = self.problem.filter_pass(first, mean, root)
        if done is not None:
            self._count(2 * self.unknowns * (done.stop - first), 0)
        return done

    def extended_pass(self, mean: Array, covariance: Array) -> ExtendedPass | None:
        """A fused extended filter, which sees each row and its gradient once."""
        done = self.problem.extended_pass(mean, covariance)
        if done is not None:
            self._count(self.rows, self.rows)
        return done

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states (m,)."""
        self._count(len(states), 0)
        return self.problem.row(k, states)

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient."""
        self._count(1, 1)
        return self.problem.row_jacobian(k, x)

    def _count(self, residual_rows: int, jacobian_rows: int) -> None:
        self.residual_rows += residual_rows
        self.jacobian_rows += jacobian_rows

    def _seen(self, cost: float) -> None:
        if math.isfinite(cost) and (not self.best or cost < self.best[-1][2]):
            self.best.append((self.residual_rows, self.jacobian_rows, cost))

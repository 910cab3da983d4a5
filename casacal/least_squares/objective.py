"""The seam between models and estimators: one objective, NumPy only.

Every estimator minimises, or filters towards the minimum of, the negative log posterior

    f(x) = 1/2 sum_k r_k(x)^2 + 1/2 sum_j ((x_j - x0_j) / s_j)^2,        r_k = e_k / w_k,

with e_k the residual of row k, w_k its standard deviation and s_j the prior standard deviation of unknown j
(infinite: flat). Whitened means divided by w_k. With a loss, rho(r_k) stands in place of r_k^2 / 2.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from casacal.array_types import Array, Index, Rows
from casacal.least_squares.linalg import damped_solution, information_of, revealed_solution, with_diagonal
from casacal.least_squares.losses import Loss


@dataclass(frozen=True)
class Normal:
    """The data's part of the normal equations at one x: cost r'r/2, gradient J'r (n,), information J'J (n, n)."""

    cost: float
    gradient: Array
    information: Array


class DampedStep(NamedTuple):
    """A damped Gauss-Newton step: the x (n,) it leads to, its squared length s'Hs, and the fall of cost it predicts."""

    x: Array
    squared_length: float
    predicted: float

    @property
    def finite(self) -> bool:
        """Whether it leads anywhere."""
        return math.isfinite(self.squared_length) and math.isfinite(self.predicted)


@dataclass(frozen=True)
class FilterPass:
    """What a cubature filter did with rows up to `stop`: the belief after them, and its trace, one entry a row.

    mean: (n,); root: (n, n), lower triangular; means: (rows done, n), all in units of `start_std` about x0.
    """

    stop: int
    mean: Array
    root: Array
    means: Array
    innovations: Array
    stds: Array


@dataclass(frozen=True)
class ExtendedPass:
    """What a fused extended filter did: the belief after all rows, and its trace.

    mean: (n,); covariance: (n, n). means: (rows, n); innovations, stds: (rows,).
    """

    mean: Array
    covariance: Array
    means: Array
    innovations: Array
    stds: Array


class LeastSquares(ABC):
    """A least-squares problem with a Gaussian prior.

    A concrete problem sets the attributes and gives `residual`, `jacobian`, `row` and `row_jacobian`; what follows
    from these is here. `graph` is the symbolic form for the IPOPT reference, `symbolic` the rows as CasADi expressions
    for one's own programs; both None where there are none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    x0: Array
    prior_std: Array
    start_std: Array
    datum: Rows
    """Unknowns that only say where the touched or watching thing stands (n,); the control M0 fits these alone."""
    graph: Any = None
    symbolic: Any = None

    @property
    @abstractmethod
    def rows(self) -> int:
        """Number of scalar residuals."""

    @abstractmethod
    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,) at x (n,)."""

    @abstractmethod
    def jacobian(self, x: Array) -> Array:
        """Whitened Jacobian (rows, n) at x (n,)."""

    @abstractmethod
    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states (m, n): (m,)."""

    @abstractmethod
    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient (n,) at x (n,)."""

    def first_part(self) -> tuple[LeastSquares, Index] | None:
        """The same rows in the unknowns that matter most, and where these stand; None where that is all of them.

        A filter that is to give a start, no more, need not follow the others.
        """
        return None

    def filter_pass(self, first: int, mean: Array, root: Array) -> FilterPass | None:
        """Let a cubature filter take in rows from `first` on; None where it cannot. Beliefs: (x - x0) / start_std.

        What a fused kernel does in place of `row` and the filter's own step, row by row. It may stop early.
        """
        del first, mean, root
        return None

    def extended_pass(self, mean: Array, covariance: Array) -> ExtendedPass | None:
        """Let an extended filter take in all rows; None where it cannot. Beliefs: (x - x0) / start_std.

        What a fused kernel does in place of `row_jacobian` and the filter's own step, row by row.
        """
        del mean, covariance
        return None

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient and information of the data at x (n,), without the prior.

        With a loss the gradient is J'Wr and the information J'WJ, W its weights at r: Gauss-Newton on sum rho(r).
        """
        r, jacobian = self.residual(x), self.jacobian(x)
        weighted = jacobian if loss is None else jacobian * loss.weight(r)[:, None]
        cost = float(r @ r) / 2 if loss is None else float(loss.cost(r).sum())
        return Normal(cost, weighted.T @ r, weighted.T @ jacobian)

    def compact_jacobian(self, x: Array) -> Array:
        """Rows (k, n) with the J'J of the whitened Jacobian, few enough to hold: what singular values need."""
        return self.jacobian(x)

    def information(self, x: Array) -> Array:
        """J'J (n, n) of the data at x (n,)."""
        return self.normal(x).information

    def weighted_rows(self, x: Array, loss: Loss | None = None) -> Array:
        """Rows (k, n) with the J'WJ at x (n,), W the weights of a loss: what singular values need."""
        if loss is None:
            return self.compact_jacobian(x)
        return self.jacobian(x) * np.sqrt(loss.weight(self.residual(x)))[:, None]

    def damped_step(self, x: Array, normal: Normal, damping: float) -> DampedStep | None:
        """Solve (H + damping I) s = -g for the whole objective at x, in coordinates (x - x0) / start_std.

        None when that matrix is not safely positive definite. `normal` is the data's part of H and g at x.
        """
        scale = self.start_std
        information = with_diagonal(normal.information, scale, scale**2 * self.prior_information)
        gradient = scale * (normal.gradient + self.prior_information * (x - self.x0))
        step = damped_solution(information, gradient, damping)
        if step is None:
            return None
        return DampedStep(
            x + scale * step, float(step @ (information @ step)), float(step @ (damping * step - gradient)) / 2
        )

    def revealing_step(self, x: Array, normal: Normal, damping: float, loss: Loss | None = None) -> DampedStep | None:
        """The same step from singular values, where normal equations are not safe; None where not all is finite."""
        scale, prior = self.start_std, self.prior_information
        gradient = scale * (normal.gradient + prior * (x - self.x0))
        stacked = np.vstack([self.weighted_rows(x, loss), np.diag(np.sqrt(prior))]) * scale
        found = revealed_solution(stacked, gradient, damping)
        return None if found is None else DampedStep(x + scale * found[0], found[1], found[2])

    def costs(self, states: Array, loss: Loss | None = None) -> Array:
        """Objective at many states (m, n): (m,)."""
        return np.array([self.cost(x, loss) for x in states])

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return len(self.names)

    @cached_property
    def prior_information(self) -> Array:
        """Lambda: 1 / s^2 of each unknown (n,), zero where the prior is flat."""
        return information_of(self.prior_std)

    def prior_cost(self, x: Array) -> float:
        """The prior's part of the objective at x (n,)."""
        away = x - self.x0
        return float((self.prior_information * away) @ away) / 2

    def cost(self, x: Array, loss: Loss | None = None) -> float:
        """The objective f at x (n,), with a loss where one is given."""
        r = self.residual(x)
        return (float(r @ r) / 2 if loss is None else float(loss.cost(r).sum())) + self.prior_cost(x)

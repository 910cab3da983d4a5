"""The seam between models and estimators: one objective, NumPy only.

Every estimator minimises, or filters towards the minimum of, the negative log posterior

    f(x) = 1/2 sum_k r_k(x)^2 + 1/2 |W (x - x0)|^2,        r_k = e_k / w_k,

with e_k the residual of row k and w_k its standard deviation; whitened means divided by w_k. W are the rows of the
prior: 1 / s_j for an unknown of standard deviation s_j (none where that is infinite: flat), or the inverse root of the
covariance of unknowns that are known together. With a loss, rho(r_k) stands in place of r_k^2 / 2.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from casacal.array_types import Array, Index, Rows
from casacal.least_squares.gaussian import Gaussian, prior_rows
from casacal.least_squares.linalg import damped_solution, revealed_solution
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
    """Mean of the prior (n,), and where estimates start."""
    prior_std: Array
    """Standard deviation of each unknown (n,) whatever the others are; infinite where the prior is flat."""
    start_std: Array
    """The same (n,), or a good scale where the prior is flat."""
    datum: Rows
    """Unknowns that only say where the touched or watching thing stands (n,); the control M0 fits these alone."""
    known: Gaussian | None = None
    """Unknowns that are known together; `x0` and `prior_std` say the part of each alone."""
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
        information = scale[:, None] * (normal.information + self.prior_information) * scale
        gradient = scale * (normal.gradient + self.prior_information @ (x - self.x0))
        step = damped_solution(information, gradient, damping)
        if step is None:
            return None
        return DampedStep(
            x + scale * step, float(step @ (information @ step)), float(step @ (damping * step - gradient)) / 2
        )

    def revealing_step(self, x: Array, normal: Normal, damping: float, loss: Loss | None = None) -> DampedStep | None:
        """The same step from singular values, where normal equations are not safe; None where not all is finite."""
        scale = self.start_std
        gradient = scale * (normal.gradient + self.prior_information @ (x - self.x0))
        stacked = np.vstack([self.weighted_rows(x, loss), self.prior_rows]) * scale
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
    def prior_rows(self) -> Array:
        """W (k, n): the prior as whitened rows."""
        return prior_rows(self.names, self.prior_std, self.known)

    @cached_property
    def prior_information(self) -> Array:
        """Lambda = W'W (n, n), zero along what is flat."""
        return np.asarray(self.prior_rows.T @ self.prior_rows)

    @property
    def prior_covariance(self) -> Array:
        """Covariance of the prior (n, n), with infinite variances where it is flat."""
        found = np.diag(self.prior_std**2)
        if self.known is not None:
            places = {name: j for j, name in enumerate(self.names)}
            index = [places[name] for name in self.known.names]
            found[np.ix_(index, index)] = self.known.covariance
        return found

    @cached_property
    def prior_root(self) -> Array:
        """Lower triangular root (n, n) of the prior's covariance in units of `start_std`, with which filters begin."""
        if self.known is None:
            return np.eye(self.unknowns)
        scaled = self.prior_covariance / np.outer(self.start_std, self.start_std)
        return np.linalg.cholesky(np.where(np.isfinite(scaled), scaled, np.eye(self.unknowns)))

    def prior_cost(self, x: Array) -> float:
        """The prior's part of the objective at x (n,)."""
        away = self.prior_rows @ (x - self.x0)
        return float(away @ away) / 2

    def cost(self, x: Array, loss: Loss | None = None) -> float:
        """The objective f at x (n,), with a loss where one is given."""
        r = self.residual(x)
        return (float(r @ r) / 2 if loss is None else float(loss.cost(r).sum())) + self.prior_cost(x)

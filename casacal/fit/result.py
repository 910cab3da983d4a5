"""What an estimator returns: the estimate, and the problem from which every quality figure is recomputed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np

from casacal.errors import CasacalError, came
from casacal.fit.least_squares import LeastSquares
from casacal.kernels.losses import Loss, worth_under
from casacal.linalg import posterior_covariance, unit_scale
from casacal.values import Array, Value, frozen, short


class Status(Enum):
    """How an estimator ended: a closed set of sentences that say what to do next."""

    CONVERGED = "Converged: the step fell below a negligible part of a posterior standard deviation."
    PRECISION = "Converged: the cost cannot be lowered further in double precision."
    ONE_PASS = "Every row was used once, as a filter does; it does not iterate. Use lm or sckf-lm for the minimum."
    BUDGET = (
        "Spent its budget; such a method gives no sign of having arrived. Compare with lm; in Python, budget can be "
        "raised."
    )
    TRUTH = "The truth of a simulation; nothing was estimated."
    NOMINAL = "The arm as drawn; nothing was estimated."
    UNSAID = "An estimate came back without a word on convergence. Compare with lm."
    MAX_STEPS = (
        "Ran out of steps before converging. Look for a mistake with casacal check, or try another method; "
        "in Python, max_steps can be raised."
    )
    STUCK = "No step lowers the cost although the gradient is not zero. Check units, signs and priors."
    NOT_FINITE = "The model gave values that are not finite. Check the samples and the nominal values."
    WORSE = (
        "The estimate fits the samples worse than the arm as drawn. "
        "Use lm or sckf-lm with priors that are not flat, or check the samples."
    )
    FAR = "One pass over the rows ended far from the minimum for the accuracy that it claims. Use lm or sckf-lm."
    SOLVER = "The solver gave up before reaching its tolerance. Compare with lm; check units, signs and priors."


FAILED = (Status.MAX_STEPS, Status.STUCK, Status.NOT_FINITE, Status.WORSE, Status.FAR, Status.SOLVER)


@dataclass(frozen=True, eq=False, repr=False)
class Result(Value):
    """An estimate and how it came about.

    x: estimate (n,) in the units of `problem.units`, deviations from nominal. trace: one array per quantity, one entry
    per step. residual_rows, jacobian_rows: how many rows of each were evaluated. information: J'J (n, n) of the data
    at x, from which the covariance follows; belief: the covariance (n, n) itself, from a method that carries one along.
    """

    method: str
    problem: LeastSquares
    x: Array
    status: Status
    trace: Mapping[str, Array] = field(default_factory=dict)
    steps: int = 0
    residual_rows: int = 0
    jacobian_rows: int = 0
    loss: Loss | None = None
    information: Array | None = None
    belief: Array | None = None

    def __post_init__(self) -> None:
        for name in ("x", "information", "belief", "trace"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def __repr__(self) -> str:
        numbers = [f"{name} {value:.6g}" for name, value in zip(self.problem.names, self.x, strict=True)]
        return f"<Result of {self.method}: cost {self.cost:.6g}; {short(numbers, 4)}. {self.message}>"

    @cached_property
    def covariance(self) -> Array:
        """Covariance of x (n, n); variances that neither data nor prior hold are infinite."""
        if self.belief is not None:
            return self.belief
        told = self.problem.normal(self.x, self.loss).information if self.information is None else self.information
        if self.loss is not None:  # what its weights, and rows that they hold down, leave
            told = worth_under(self.loss, self.problem.residual(self.x)) * told
        return posterior_covariance(told, self.problem.prior_information)

    @cached_property
    def cost(self) -> float:
        """The objective at x, recomputed from the problem; with the loss where there is one."""
        with np.errstate(over="ignore", invalid="ignore"):  # an estimate may lie anywhere
            return self.problem.cost(self.x, self.loss)

    @cached_property
    def weights(self) -> Array:
        """Weight of each row (rows,) under the loss: one keeps its full pull, zero is ignored."""
        r = self.problem.residual(self.x)
        return np.ones_like(r) if self.loss is None else self.loss.weight(r)

    @property
    def converged(self) -> bool:
        """Whether the estimator did all it promises."""
        return self.status not in FAILED

    @property
    def success(self) -> bool:
        """The same, by SciPy's name."""
        return self.converged

    @property
    def message(self) -> str:
        """The status as a sentence."""
        return self.status.value

    @property
    def nfev(self) -> int:
        """Evaluations of all residuals, or as many rows."""
        return self.residual_rows // max(self.problem.rows, 1)

    @property
    def njev(self) -> int:
        """Evaluations of the whole Jacobian, or as many rows."""
        return self.jacobian_rows // max(self.problem.rows, 1)

    @property
    def std(self) -> Array:
        """Posterior standard deviations (n,)."""
        return np.sqrt(np.diagonal(self.covariance))

    @cached_property
    def kkt(self) -> float:
        """Largest component of the objective's gradient at x, in prior-scaled (flat: column-scaled) coordinates."""
        normal = self.problem.normal(self.x, self.loss)
        gradient = normal.gradient + self.problem.prior_information @ (self.x - self.problem.x0)
        by_column = unit_scale(np.diagonal(normal.information))  # 1 / |column of the Jacobian| (More 1978)
        scales = np.where(np.isfinite(self.problem.prior_std), self.problem.prior_std, by_column)
        return float(np.abs(scales * gradient).max(initial=0.0))


def as_result(outcome: Result | Array | Any, problem: LeastSquares, method: str) -> Result:
    """What an estimator returned as a result over the problem itself: a `Result`, or x (n,) without a word more.

    Raises CasacalError for an estimate of another shape, or one that is not finite.
    """
    wanted = f"Return a Result, or x of shape {problem.x0.shape}"
    try:
        x = np.array(outcome.x if isinstance(outcome, Result) else outcome, dtype=np.float64)
    except (TypeError, ValueError):
        raise CasacalError(f"Got {came(outcome)} from the method '{method}'", wanted) from None
    if x.shape != problem.x0.shape:
        raise CasacalError(f"The estimate of '{method}' has the shape {x.shape}", wanted)
    if not np.isfinite(x).all():
        raise CasacalError(f"The estimate of '{method}' is not finite", "See its status on this problem alone")
    if isinstance(outcome, Result):
        return replace(outcome, method=method, problem=problem, x=x)
    return Result(method, problem, x, Status.UNSAID)


def nominal(problem: LeastSquares) -> Result:
    """The control that does nothing: the prior's mean with the prior's covariance; evaluates nothing."""
    return Result("nominal", problem, problem.x0.copy(), Status.NOMINAL, belief=problem.prior_covariance)


def nothing_unknown(problem: LeastSquares, method: str) -> Result:
    """What any method returns where every unknown is held: the arm as drawn, x of no entries."""
    assert not problem.unknowns
    return replace(nominal(problem), method=method)

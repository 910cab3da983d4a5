"""The seam between models and estimators: f(x) = |r(x)|^2 / 2 + a prior, as an estimator sees it. NumPy alone.

`LeastSquares` is whitened residuals, their Jacobian, normal equations and rows one by one; `Gaussian` is a prior of
unknowns that are known together; `Conditioned` is a problem in some unknowns; an estimator returns a `Result`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from casacal.errors import CasacalError, ProblemError, came
from casacal.fit.constrained import ConstraintSet
from casacal.kernels.losses import Loss, worth_under
from casacal.linalg import damped_solution, freed_of, posterior_covariance, revealed_solution, unit_scale, whitening_of
from casacal.values import EMPTY, Array, FrozenMapping, Index, Rows, Value, frozen, short

MOST_ENTRIES = 20_000_000  # of a Jacobian that is held in memory at once; so many rows share one worth
FEWEST_OF_A_GROUP = 10  # residuals beyond what they determine, from which on they speak of a noise of their own


@dataclass(frozen=True, eq=False)
class Gaussian(Value):
    """Mean (n,) and covariance (n, n) of unknowns in their own units, mm and rad.

    An infinite variance says that nothing is known of an unknown; its covariances are zero.
    """

    names: tuple[str, ...]
    mean: Array
    covariance: Array

    def of(self, names: Collection[str]) -> Gaussian:
        """Marginal Gaussian of some unknowns, in their order here."""
        kept = [j for j, name in enumerate(self.names) if name in names]
        return Gaussian(tuple(self.names[j] for j in kept), self.mean[kept], self.covariance[np.ix_(kept, kept)])

    def given(self, values: Mapping[str, float]) -> Gaussian:
        """Conditional Gaussian of the other unknowns, some held at these values."""
        held = [j for j, name in enumerate(self.names) if name in values and np.isfinite(self.covariance[j, j])]
        rest = [j for j, name in enumerate(self.names) if name not in values]
        off = np.array([values[self.names[j]] for j in held]) - self.mean[held]
        white = whitening_of(self.covariance[np.ix_(held, held)])
        along = white @ self.covariance[np.ix_(held, rest)]
        names, covariance = tuple(self.names[j] for j in rest), self.covariance[np.ix_(rest, rest)]
        return Gaussian(names, self.mean[rest] + along.T @ (white @ off), covariance - along.T @ along)

    def beside(self, other: Gaussian) -> Gaussian:
        """Together with another of other unknowns that have nothing to do with these."""
        mine, whole = len(self.names), np.zeros((len(self.names) + len(other.names),) * 2)
        whole[:mine, :mine], whole[mine:, mine:] = self.covariance, other.covariance
        return Gaussian((*self.names, *other.names), np.concatenate([self.mean, other.mean]), whole)

    def placed(self, names: Sequence[str], mean: Array, std: Array) -> tuple[Array, Array]:
        """Means and standard deviations (n,) of unknowns by name, with those of this in their places."""
        mean, std = mean.copy(), std.copy()
        for j, name in enumerate(names):
            if name in self.names:
                k = self.names.index(name)
                mean[j], std[j] = self.mean[k], np.sqrt(self.covariance[k, k])
        return mean, std


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
    """Result of a cubature filter over rows up to `stop`: belief after them, and trace, one entry a row.

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
    """Result of a fused extended filter: belief after all rows, and trace.

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
    """Marginal prior standard deviation of each unknown (n,); infinite where the prior is flat."""
    start_std: Array
    """Prior standard deviation (n,), or a good scale where the prior is flat."""
    datum: Rows
    """Mask (n,) of unknowns that only locate the touched face or the device; the control M0 fits these alone."""
    known: Gaussian | None = None
    """Joint prior of some unknowns; `x0` and `prior_std` are its marginals."""
    constraints: ConstraintSet | None = None
    """What x must meet; None where it is free."""
    graph: Any = None
    symbolic: Any = None

    @property
    @abstractmethod
    def rows(self) -> int:
        """Number of scalar residuals."""

    @property
    def noise_groups(self) -> tuple[Index, ...]:
        """Residuals of each noise group; none where nothing tells rows apart."""
        return ()

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
        """Problem in the most influential unknowns, and their positions; None where that is all of them.

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
        fall = float(step @ (damping * step - gradient)) / 2
        return DampedStep(x + scale * step, float(step @ (information @ step)), fall)

    def revealing_step(self, x: Array, normal: Normal, damping: float, loss: Loss | None = None) -> DampedStep | None:
        """Damped step by singular values, where normal equations lose digits; None where not all is finite."""
        scale = self.start_std
        gradient = scale * (normal.gradient + self.prior_information @ (x - self.x0))
        stacked = np.vstack([self.weighted_rows(x, loss), self.prior_rows]) * scale
        found = revealed_solution(stacked, gradient, damping)
        return None if found is None else DampedStep(x + scale * found[0], found[1], found[2])

    def constrained_step(self, x: Array, normal: Normal, damping: float, loss: Loss | None = None) -> DampedStep | None:
        """A damped step from x, which meets the constraints, to another x that does; None where none is found.

        Gauss-Newton's quadratic over the linearised constraints, as in sequential quadratic programming (Nocedal and
        Wright, Numerical Optimization, 2nd edition, section 18.1), then back onto them. Both ends meet the constraints,
        so that the objective itself is the merit: no penalty is to be chosen, nor does one refuse good steps.
        """
        assert self.constraints is not None
        scale = self.start_std
        gradient = scale * (normal.gradient + self.prior_information @ (x - self.x0))
        stacked = np.vstack([self.weighted_rows(x, loss), self.prior_rows]) * scale
        found = self.constraints.stepped(x, stacked, gradient, damping)
        if found is None:
            return None
        there, step = found
        squared = float(((stacked @ step) ** 2).sum())
        return DampedStep(there, squared, -float(gradient @ step) - squared / 2)

    def feasible(self, x: Array) -> Array:
        """An x (n,) near another that meets the constraints; ProblemError where none does near that one nor near x0."""
        if self.constraints is None:
            return x
        found = self.constraints.restored(x)
        found = self.constraints.restored(self.x0) if found is None else found
        if found is None:
            named = ", ".join(f"'{name}'" for name in self.constraints.names)
            what = f"No values near the drawing meet the constraints ({named}) together"
            raise ProblemError(what, "Leave one out, or widen it")
        return found

    def tangent(self, x: Array, active: Collection[str] | None = None) -> Array | None:
        """Columns (n, k) along which x (n,) may move, as `ConstraintSet.tangent`; None where it is free."""
        return None if self.constraints is None else self.constraints.tangent(x, active)

    def posterior(self, information: Array, x: Array, active: Collection[str] | None = None) -> Array:
        """Covariance (n, n) from the information J'J (n, n) of data at x and the prior, along `tangent`."""
        return posterior_covariance(information, self.prior_information, self.tangent(x, active))

    def costs(self, states: Array, loss: Loss | None = None) -> Array:
        """Objective at many states (m, n): (m,)."""
        return np.array([self.cost(x, loss) for x in states])

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return len(self.names)

    @cached_property
    def prior_rows(self) -> Array:
        """W (k, n): the prior as whitened rows, W'W its information; none along what is flat."""
        # of a name that is known twice the last counts, as where what stands may have moved
        names = self.names
        together = {} if self.known is None else {name: j for j, name in enumerate(self.known.names)}
        finite = [j for j in range(self.unknowns) if np.isfinite(self.prior_std[j])]
        firm = [j for j in finite if names[j] not in together]
        rows = np.zeros((len(firm), len(names)))
        rows[np.arange(len(firm)), firm] = 1.0 / self.prior_std[firm]
        if self.known is None:
            return rows
        held = [j for j in finite if names[j] in together]
        index = [together[names[j]] for j in held]
        dense = np.zeros((len(held), len(names)))
        dense[:, held] = whitening_of(self.known.covariance[np.ix_(index, index)])
        return np.vstack([rows, dense])

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


class Conditioned(LeastSquares):
    """A problem in the unknowns that `free` marks (n,), about a given x (n,).

    The others are held there: what is known of them together with the free ones says where these are to be expected.
    Those that `out` marks are not held but move freely with the free ones, and information is what is then left.
    """

    def __init__(self, whole: LeastSquares, free: Rows, at: Array, *, out: Rows | None = None) -> None:
        self.whole, self.free, self.held_at = whole, np.flatnonzero(free), at.copy()
        self.out = np.zeros(0, dtype=np.intp) if out is None else np.flatnonzero(out)
        self.names = tuple(whole.names[j] for j in self.free)
        self.units = tuple(whole.units[j] for j in self.free)
        self.x0, self.prior_std = whole.x0[self.free], whole.prior_std[self.free]
        self.start_std, self.datum = whole.start_std[self.free], whole.datum[self.free]
        self.known = whole.known
        if whole.constraints is not None:
            kept = np.asarray(whole.constraints.depends[:, self.free].any(axis=1))
            self.constraints = whole.constraints.part(kept, self.free, self.expand) if kept.any() else None
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
        held = prior[np.any(prior[:, self.out] != 0, axis=1)]  # priors of the unknowns that are taken out
        own = np.linalg.lstsq(held[:, self.out], held[:, self.free], rcond=None)[0] if len(held) else 0.0
        left = np.vstack([rows[:, self.free] - rows[:, self.out] @ own, np.zeros((len(held), self.free.size))])
        return freed_of(left, np.vstack([rows[:, self.out], held[:, self.out]]))

    @property
    def noise_groups(self) -> tuple[Index, ...]:
        """Residuals of each noise group."""
        return self.whole.noise_groups

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


class Status(Enum):
    """How an estimator ended: a closed set of sentences that say what to do next."""

    CONVERGED = "Converged: the step fell below a negligible part of a posterior standard deviation."
    PRECISION = "Converged: the cost cannot be lowered further in double precision."
    ONE_PASS = "Every row was used once, as a filter does; it does not iterate. Use lm or sckf-lm for the minimum."
    BUDGET = (
        "Spent its budget; such a method gives no sign of having arrived. Compare with lm; in Python, budget can be "
        "raised."
    )
    STALLED = (
        "Searched until nothing lowered the cost any more; such a method gives no sign of having arrived. Compare "
        "with lm."
    )
    UNMOVED = (
        "Found nothing better than the arm as drawn, which is what came back. Use lm; in Python, budget can be raised."
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


FAILED = (Status.MAX_STEPS, Status.STUCK, Status.NOT_FINITE, Status.WORSE, Status.FAR, Status.SOLVER, Status.UNMOVED)


@dataclass(frozen=True, eq=False, repr=False)
class Result(Value):
    """An estimate and how it came about.

    x: estimate (n,) in the units of `problem.units`, deviations from nominal. trace: one array per quantity, one entry
    per step. residual_rows, jacobian_rows: how many rows of each were evaluated. information: J'J (n, n) of the data
    at x, from which the covariance follows; belief: the covariance (n, n) itself, from a method that carries one along.
    dual: multipliers of the constraints (m,) as a solver found them, where it finds them.
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
    dual: Array | None = None

    def __post_init__(self) -> None:
        for name in ("x", "information", "belief", "dual", "trace"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def __repr__(self) -> str:
        numbers = [f"{name} {value:.6g}" for name, value in zip(self.problem.names, self.x, strict=True)]
        return f"<Result of {self.method}: cost {self.cost:.6g}; {short(numbers, 4)}. {self.message}>"

    @cached_property
    def covariance(self) -> Array:
        """Covariance of x (n, n); variances that neither data nor prior hold are infinite."""
        if self.belief is not None:
            return self.belief
        data = self.problem.normal(self.x, self.loss).information if self.information is None else self.information
        return self.problem.posterior(data if self.loss is None else self._under(self.loss, data), self.x)

    def _under(self, loss: Loss, weighted: Array) -> Array:
        """Information (n, n) that rows have under a loss, from J'WJ: each noise group's worth is that of its own rows.

        Gross rows of one instrument say nothing of another's.
        """
        r = self.problem.residual(self.x)
        if r.size * self.x.size > MOST_ENTRIES:
            return np.asarray(worth_under(loss, r) * weighted)
        jacobian, weight = self.problem.jacobian(self.x), loss.weight(r)
        spread = self.problem.posterior(weighted, self.x)
        spread = np.where(np.isfinite(spread), spread, 0.0)
        of_rows = np.einsum("ij,jk,ik->i", jacobian, spread, jacobian, optimize=True)
        determined = np.clip(weight * of_rows, 0.0, 1.0)  # more only by rounding, where little holds x
        worth = np.full(len(r), worth_under(loss, r, float(determined.sum())))
        for rows in self.problem.noise_groups:
            if len(rows) - (own := float(determined[rows].sum())) >= FEWEST_OF_A_GROUP:
                worth[rows] = worth_under(loss, r[rows], own)
        return np.asarray(jacobian.T @ (jacobian * (weight * worth)[:, None]))

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the bounds on which x lies; equalities are not among them."""
        if (known := self.problem.constraints) is None:
            return ()
        return tuple(np.array(known.names)[known.on_ends(self.x) & ~known.equalities].tolist())

    @cached_property
    def multipliers(self) -> Mapping[str, float]:
        """Multiplier of each constraint by name: by how much the cost falls where its end is one unit higher.

        Of a bound positive at the upper end, negative at the lower, zero where x does not lie on it. As the solver
        found them, else those that balance the gradient at x best (Nocedal and Wright, section 18.3).
        """
        if (known := self.problem.constraints) is None:
            return EMPTY
        found = known.multipliers(self.x, self._normal.gradient) if self.dual is None else self.dual
        return FrozenMapping(dict(zip(known.names, found.tolist(), strict=True)))

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
        """`converged`, under SciPy's name."""
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
    def _normal(self) -> Normal:
        """Normal equations of the whole objective at x, but for the prior's information."""
        data = self.problem.normal(self.x, self.loss)
        pull = self.problem.prior_information @ (self.x - self.problem.x0)
        return replace(data, gradient=data.gradient + pull)

    @cached_property
    def kkt(self) -> float:
        """Largest component of the objective's gradient at x, in prior-scaled (flat: column-scaled) coordinates.

        With constraints of the Lagrangian's: apart from what their multipliers balance.
        """
        normal, gradient = self._normal, self._normal.gradient
        if self.problem.constraints is not None:
            held = np.array([*self.multipliers.values()])
            gradient = gradient + self.problem.constraints.evaluate(self.x)[1].T @ held
        by_column = unit_scale(np.diagonal(normal.information))  # 1 / |column of the Jacobian| (More 1978)
        scales = np.where(np.isfinite(self.problem.prior_std), self.problem.prior_std, by_column)
        return float(np.abs(scales * gradient).max(initial=0.0))


def as_result(outcome: Result | Array | Any, problem: LeastSquares, method: str) -> Result:
    """`Result` of what an estimator returned: a `Result`, or x (n,) alone.

    Raises CasacalError for an estimate of another shape, or one that is not finite.
    """
    wanted = f"Return a Result, or x of shape {problem.x0.shape}"
    try:
        x = np.array(outcome.x if isinstance(outcome, Result) else outcome, dtype=np.float64)
        x = x[:, 0] if x.shape == (problem.unknowns, 1) else x  # CasADi's vectors are columns
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
    """Result where every unknown is held: the nominal arm, x of no entries."""
    assert not problem.unknowns
    return replace(nominal(problem), method=method)

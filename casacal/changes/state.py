"""The earlier posterior as the prior, and fresh rows beside it: the joint state that an update estimates anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.compensation.arm import CalibratedArm
from casacal.compensation.motion import corrected_values, known_motion
from casacal.errors import CasacalError
from casacal.estimators import lm
from casacal.least_squares.objective import LeastSquares
from casacal.uncertainty.fresh_rows import covariance_root
from casacal.verification.fresh import Fresh


class Mapped(LeastSquares):
    """A problem at x = at + M v (n,), v (k,) with priors of its own."""

    def __init__(self, whole: BoundProblem, at: Array, ways: Array, x0: Array, stds: Array, starts: Array) -> None:
        self.whole, self.at, self.ways = whole, at, ways
        self.names = tuple(f"v{j + 1}" for j in range(ways.shape[1]))
        self.units = ("",) * len(self.names)
        self.x0, self.prior_std, self.start_std = x0, stds, starts
        self.datum = np.zeros(len(self.names), dtype=bool)

    def expand(self, v: Array) -> Array:
        """All unknowns (n,) at v (k,)."""
        return np.asarray(self.at + self.ways @ v)

    @property
    def rows(self) -> int:
        """Rows of the whole problem."""
        return self.whole.rows

    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,)."""
        return self.whole.residual(self.expand(x))

    def jacobian(self, x: Array) -> Array:
        """Whitened (rows, k)."""
        return np.asarray(self.whole.jacobian(self.expand(x)) @ self.ways)

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states."""
        return np.array([self.residual(v)[k] for v in states])

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient (k,)."""
        return float(self.residual(x)[k]), self.jacobian(x)[k]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Where everything stands given both: v (k,) with its covariance (k, k), x (n,), and twice the cost there."""

    v: Array
    covariance: Array
    x: Array
    chi_square: float


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the rows: x = at + M v with v ~ N(mean, stds^2), infinite where nobody knows.

    start: sizes (k,) with which unknowns that are free are looked for.
    """

    at: Array
    ways: Array
    mean: Array
    stds: Array
    start: Array

    @staticmethod
    def of(
        at: Array,
        known: NDArray[np.bool_],
        covariance: Array,
        free: tuple[Array, Array, Array],
    ) -> Prior:
        """Of an estimate (n,), what is known (n,) and its covariance (k, k).

        free: of what is not known, in order: where it is guessed (f,), how well (f,), and sizes (f,).
        """
        lost = ~np.isfinite(np.diagonal(covariance))
        there = np.flatnonzero(known)[~lost]
        root = covariance_root(covariance[np.ix_(~lost, ~lost)])
        alone = np.flatnonzero(~known)
        ways = np.zeros((at.size, root.shape[1] + alone.size + int(lost.sum())))
        ways[there, : root.shape[1]] = root
        ways[alone, root.shape[1] + np.arange(alone.size)] = 1.0
        ways[np.flatnonzero(known)[lost], root.shape[1] + alone.size + np.arange(int(lost.sum()))] = 1.0
        ones, more = np.ones(root.shape[1]), int(lost.sum())
        guess, stds, sizes = free
        return Prior(
            at,
            ways,
            np.concatenate([np.zeros(root.shape[1]), guess, np.zeros(more)]),
            np.concatenate([ones, stds, np.full(more, np.inf)]),
            np.concatenate([ones, sizes, np.ones(more)]),
        )

    def with_ways(self, ways: Array, sizes: Array) -> Prior:
        """The same with further directions (n, c) along which anything may have happened."""
        more = ways.shape[1]
        return Prior(
            self.at,
            np.hstack([self.ways, ways]),
            np.concatenate([self.mean, np.zeros(more)]),
            np.concatenate([self.stds, np.full(more, np.inf)]),
            np.concatenate([self.start, sizes]),
        )

    def given(self, bound: BoundProblem, *, most: int = 1000, strict: bool = True) -> Posterior:
        """The minimum (Levenberg-Marquardt, so many steps at most), linearised there.

        Raises CasacalError where none is found; where that is not strict, what was found counts.
        """
        problem = Mapped(bound, self.at, self.ways, self.mean, self.stds, self.start)
        start = np.where(np.isfinite(self.stds), self.mean, 0.0)
        found = lm(problem, start=start, max_steps=most)
        if strict and not found.converged:
            raise CasacalError(f"The rows were not fitted: {found.message}", "Look for wrong rows with casacal check")
        return Posterior(found.x, found.covariance, problem.expand(found.x), 2 * found.cost)


@dataclass(frozen=True, eq=False)
class State:
    """Unknowns of the rows (n,), then those (o,) that only the result knows: s = at + S v.

    others: names of these, and where each stands in the result's covariance. x (n,), moved (o,): where rows put them;
    covariance: of all (n + o, n + o).
    """

    others: tuple[str, ...]
    places: tuple[int, ...]
    x: Array
    moved: Array
    covariance: Array
    chi_square: float


def motion_of(arm: CalibratedArm) -> tuple[Array, list[str]]:
    """Covariance (n, n) of all that a result says of arm, cell and effects that move the tip, and their names."""
    said = arm.document.get("discrepancy") or {}
    if "covariance" not in said:
        return known_motion(arm)
    rows = [[np.inf if value is None else float(value) for value in row] for row in said["covariance"]]
    return np.array(rows), list(said["covariance_of"])


def updated_state(arm: CalibratedArm, fresh: Fresh, free: Sequence[Array], dropped: Callable[[str], bool]) -> State:
    """The posterior of everything: the result's own as the prior, with directions (n,) that are free.

    dropped: names of what the result knows and nobody does any more. Raises CasacalError where the result leaves
    directions without bound, and where the rows cannot be fitted.
    """
    bound, (whole, names) = fresh.bound, motion_of(arm)
    corrected, own = corrected_values(arm), set(fresh.own_names)
    known = np.flatnonzero(fresh.known)
    index = {name: i for i, name in enumerate(names)}
    shared = [index[bound.names[j]] if not bound.beside[j] or bound.names[j] in corrected else -1 for j in known]
    places = [i for i, name in enumerate(names) if i not in shared and name not in own and not dropped(name)]
    both, k = np.zeros((known.size + len(places),) * 2), known.size
    both[:k, :k], both[k:, k:] = fresh.covariance, whole[np.ix_(places, places)]
    rows = np.flatnonzero(np.array(shared) >= 0)
    cross = whole[np.ix_([shared[r] for r in rows], places)]
    both[np.ix_(rows, np.arange(k, len(both)))], both[np.ix_(np.arange(k, len(both)), rows)] = cross, cross.T
    if not np.isfinite(both).all():
        raise CasacalError(
            f"{arm.file}: it leaves directions without bound, so there is no prior to update",
            "Calibrate again with old and new rows",
        )
    root, alone = covariance_root(both), np.flatnonzero(~fresh.known)
    more, count = len(free), root.shape[1]
    ways = np.zeros((bound.unknowns + len(places), count + alone.size + more))
    ways[known, :count], ways[bound.unknowns :, :count] = root[:k], root[k:]
    ways[alone, count + np.arange(alone.size)] = 1.0
    for i, direction in enumerate(free):
        ways[: bound.unknowns, count + alone.size + i] = direction
    at = np.where(fresh.known, fresh.at, fresh.x)
    firm = np.isfinite(bound.prior_std[alone])
    prior = Prior(
        at,
        ways[: bound.unknowns],
        np.concatenate([np.zeros(count), np.where(firm, bound.x0[alone] - at[alone], 0.0), np.zeros(more)]),
        np.concatenate([np.ones(count), bound.prior_std[alone], np.full(more, np.inf)]),
        np.concatenate([np.ones(count), bound.start_std[alone], np.full(more, 1e-3)]),
    )
    found = prior.given(bound)
    covariance = ways @ found.covariance @ ways.T
    moved = ways[bound.unknowns :] @ found.v
    others = tuple(names[i] for i in places)
    return State(others, tuple(places), found.x, moved, (covariance + covariance.T) / 2, found.chi_square)

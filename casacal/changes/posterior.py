"""The earlier posterior as the prior of fresh rows, with more doubt where asked for, and what both tell together."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.compensation.arm import CalibratedArm, all_motion, with_effects
from casacal.errors import CasacalError, UnknownNameError, came
from casacal.estimators import lm
from casacal.least_squares.objective import LeastSquares
from casacal.uncertainty.fresh_rows import covariance_root
from casacal.values import is_real
from casacal.verification.fresh import Fresh

ANEW = ("growth",)  # keys of effects that move the tip and differ from session to session


def with_memory(fresh: Fresh, arm: CalibratedArm) -> Fresh:
    """The same rows with the geometry and the effects that go with the arm as they were estimated, and how well.

    Itself where a result says nothing of effects.
    """
    found = with_effects(arm)
    if found is None:
        return fresh
    whole, off = found
    places, bound, columns = {name: i for i, name in enumerate(off)}, fresh.bound, np.flatnonzero(fresh.known)
    stays = [k for k, j in enumerate(columns) if bound.names[j] in places and bound.beside[j] not in ANEW]
    index = [places[bound.names[columns[k]]] for k in stays]
    covariance, at = fresh.covariance.copy(), fresh.at.copy()
    covariance[np.ix_(stays, stays)] = whole[np.ix_(index, index)]
    for k in stays:
        at[columns[k]] += off[bound.names[columns[k]]]
    return replace(fresh, at=at, covariance=covariance)


def with_drift(fresh: Fresh, drift: Mapping[str, float]) -> Fresh:
    """The same rows with more doubt about what they are judged by.

    drift: standard deviations (mm, rad) by the name of an unknown ("theta4"), or the key of several ("theta").
    Raises UnknownNameError for what these rows take from no calibration, CasacalError for what is no size.
    """
    bound, places = fresh.bound, dict[str, list[int]]()
    position = np.cumsum(fresh.known) - 1
    for slot in bound.slots:
        for j, name in zip(slot.columns, slot.unknown.names(slot.name), strict=True):
            if fresh.known[j] and not slot.beside:
                for word in dict.fromkeys((name, slot.name, slot.key)):
                    places.setdefault(word, []).append(int(position[j]))
    covariance = fresh.covariance.copy()
    for name, std in drift.items():
        if name not in places:
            raise UnknownNameError("unknown of the calibration", name, places)
        if not (is_real(std) and 0 <= std < math.inf):
            raise CasacalError(f"Got {came(std)} as the drift of '{name}'", "Give zero or more, mm or rad")
        covariance[places[name], places[name]] += float(std) ** 2
    return replace(fresh, covariance=covariance) if drift else fresh


class _Mapped(LeastSquares):
    """A problem at x = at + M v (n,), v (k,) with priors of its own."""

    def __init__(self, whole: BoundProblem, prior: Prior) -> None:
        self.whole, self.at, self.ways = whole, prior.at[: whole.unknowns], prior.ways[: whole.unknowns]
        self.names = tuple(f"v{j + 1}" for j in range(prior.mean.size))
        self.units = ("",) * len(self.names)
        self.x0, self.prior_std, self.start_std = prior.mean, prior.stds, prior.start
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

    at (n,), ways: M (n, k), of all unknowns of the rows and of others that they do not see. start: sizes (k,) with
    which unknowns that are free are looked for.
    """

    at: Array
    ways: Array
    mean: Array
    stds: Array
    start: Array

    @staticmethod
    def of(fresh: Fresh, unknowns: int, covariance: Array | None = None) -> Prior:
        """Of what a calibration says of fresh rows, and of what these know alone.

        unknowns: how many there are in all; those that the rows do not have stay zero. covariance: of what is known of
        the rows, and after it of the last unknowns; by default that of the rows.
        """
        bound, alone = fresh.bound, np.flatnonzero(~fresh.known)
        covariance = fresh.covariance if covariance is None else covariance
        known = np.flatnonzero(fresh.known)
        known = np.append(known, np.arange(unknowns - len(covariance) + known.size, unknowns))
        lost = ~np.isfinite(np.diagonal(covariance))
        root = covariance_root(covariance[np.ix_(~lost, ~lost)])
        count, more = root.shape[1], int(lost.sum())
        free = count + np.arange(alone.size + more)
        ways = np.zeros((unknowns, count + free.size))
        ways[known[~lost], :count] = root
        ways[np.append(alone, known[lost]), free] = 1.0
        at, std = np.zeros(unknowns), bound.prior_std[alone]
        at[: bound.unknowns] = np.where(fresh.known, fresh.at, fresh.x)
        guess = np.where(np.isfinite(std), bound.x0[alone] - at[alone], 0.0)
        return Prior(
            at,
            ways,
            np.concatenate([np.zeros(count), guess, np.zeros(more)]),
            np.concatenate([np.ones(count), std, np.full(more, np.inf)]),
            np.concatenate([np.ones(count), bound.start_std[alone], np.ones(more)]),
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
        problem = _Mapped(bound, self)
        start = np.where(np.isfinite(self.stds), self.mean, 0.0)
        found = lm(problem, start=start, max_steps=most)
        if strict and not found.converged:
            raise CasacalError(f"The rows were not fitted: {found.message}", "Look for wrong rows with casacal check")
        return Posterior(found.x, found.covariance, problem.expand(found.x), 2 * found.cost)


@dataclass(frozen=True, eq=False)
class UpdatedState:
    """Unknowns of the rows (n,), then those (o,) that only the result knows, by name.

    x (n,): where the rows put theirs. moved: by how much each of the others moved with them. covariance: of all
    (n + o, n + o).
    """

    x: Array
    moved: Mapping[str, float]
    covariance: Array
    chi_square: float


def updated_state(
    arm: CalibratedArm, fresh: Fresh, free: Sequence[Array], dropped: Callable[[str], bool]
) -> UpdatedState:
    """The posterior of everything: the result's own as the prior, with directions (n,) that are free.

    dropped: names of what the result knows and nobody does any more. Raises CasacalError where the result leaves
    directions without bound, and where the rows cannot be fitted.
    """
    bound, (whole, names) = fresh.bound, all_motion(arm)
    corrected, own = arm.found.of_effects, set(fresh.own_names)
    known, n = np.flatnonzero(fresh.known), bound.unknowns
    index = {name: i for i, name in enumerate(names)}
    shared = {
        k: index[bound.names[j]] for k, j in enumerate(known) if not bound.beside[j] or bound.names[j] in corrected
    }
    places = [i for i, name in enumerate(names) if i not in shared.values() and name not in own and not dropped(name)]
    both, k = np.zeros((known.size + len(places),) * 2), known.size
    both[:k, :k], both[k:, k:] = fresh.covariance, whole[np.ix_(places, places)]
    both[list(shared), k:] = whole[np.ix_(list(shared.values()), places)]
    both[k:, :k] = both[:k, k:].T
    if not np.isfinite(both).all():
        fix = "Calibrate again with old and new rows"
        raise CasacalError(f"{arm.file}: it leaves directions without bound, so there is no prior to update", fix)
    prior = Prior.of(fresh, n + len(places), both)
    ways = np.zeros((n + len(places), len(free)))
    ways[:n] = np.reshape(free, (len(free), n)).T
    prior = prior.with_ways(ways, np.full(len(free), 1e-3))
    found = prior.given(bound)
    covariance = prior.ways @ found.covariance @ prior.ways.T
    moved = dict(zip((names[i] for i in places), (prior.ways[n:] @ found.v).tolist(), strict=True))
    return UpdatedState(found.x, moved, (covariance + covariance.T) / 2, found.chi_square)

"""The fit of all touches so far, their scatter, and, linear about it, the readings and the tip error to expect."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from casacal.array_types import Array
from casacal.binding.bound_problem import OTHERS, BoundProblem
from casacal.binding.slots import Slot, instances, make_slots
from casacal.errors import ProblemError
from casacal.estimators import lm
from casacal.estimators.sckf import Belief, begun
from casacal.least_squares.gaussian import Gaussian
from casacal.least_squares.linalg import svd
from casacal.measuring.touch import Touch, rows_of
from casacal.planning.choice import gains, row_slopes
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples, joined
from casacal.uncertainty.fresh_rows import chance, covariance_root
from casacal.values import Value, read_only

Places = Mapping[str, Array]
"""Where things stand that were declared without a nominal value, by the full name of the unknown."""

FACTORS = tuple(1.25**k for k in range(1, 18))  # noise over what was stated, among which the likeliest is looked for
TELLING = 4.5  # logarithm of likelihoods from which on stated noise is given up: e^4.5, 90 to one
NEAR, MOVES = 0.5, 5  # part of what it begins with by which a face may be elsewhere; times that it is moved
FEWEST = 12  # touches from which on their scatter is looked at


@dataclass(frozen=True, eq=False)
class Known(Value):
    """What some touches tell.

    touches: these. bound: to their rows. belief: in units of `start_std` about x0. factor: noise over what was stated,
    one or more. proposed: names of what stands where touches say, not a plan.
    """

    touches: tuple[Touch, ...]
    bound: BoundProblem
    belief: Belief
    factor: float = 1.0
    proposed: frozenset[str] = frozenset()

    @property
    def x(self) -> Array:
        """The mean (n,), in mm and rad."""
        return np.asarray(self.bound.x0 + self.bound.start_std * self.belief.mean)

    @property
    def covariance(self) -> Array:
        """Of the belief (n, n), in its units."""
        return np.asarray(self.belief.root @ self.belief.root.T)

    def knows(self, touch: Touch) -> bool:
        """Whether there are unknowns for the face of a touch."""
        return bool(covered(self.bound, rows_of([touch])).all())


def proposed_places(slots: Sequence[Slot]) -> dict[str, Array]:
    """Where faces and the like stand that were declared without a nominal value, as the rows propose them."""
    return {slot.name: slot.nominal for slot in slots if slot.unknown.nominal is None}


def telling(problem: Problem, samples: Samples, places: Places) -> list[int]:
    """Which rows tell something: those of faces that are planned or were touched often enough."""
    told = np.ones(len(samples), dtype=bool)
    for name, rows, enough in _proposing(problem, samples):
        if name in places:
            continue
        try:
            if enough:
                make_slots(problem, (samples.take(rows),), places)
        except ProblemError:  # touches on a line do not say where a face is
            enough = False
        told[rows] &= enough
    return [int(k) for k in np.flatnonzero(told)]


def known_from(
    problem: Problem, touches: Sequence[Touch], places: Places, planned: Samples | None, before: Known | None = None
) -> Known:
    """Fit touches that are all usable, with the prior and, where it is flat, what a filter would start with.

    Faces begin where they are planned, or else where their own touches say, and again where they are found to stand.
    All that is planned has unknowns from the beginning on. The binding of `before`, a touch ago, serves again. Raises
    ProblemError where nothing says where a face stands.
    """
    samples = rows_of(touches)
    proposed = frozenset(name for name, enough in counts(problem, samples).items() if enough and name not in places)
    if before is not None and before.proposed == proposed and covered(before.bound, samples).all():
        bound = before.bound.with_noise().on(samples)
    else:
        bound = _bound(problem, samples, places, planned, proposed)
    belief = _fitted(bound)
    for _ in range(MOVES):
        # some face is believed further from where it began than it begins with
        if not (np.abs(belief.mean) > NEAR)[bound.datum].any():
            break
        bound = _moved(bound, belief)
        belief = _fitted(bound)
    factor = _noise_over_stated(bound, belief) if len(touches) >= FEWEST else 1.0
    if factor > 1.0:
        bound = bound.with_noise({OTHERS: factor})
        belief = _fitted(bound)
    return Known(tuple(touches), bound, belief, factor, proposed)


def known_before(problem: Problem, rows: Samples, places: Places, planned: Samples | None = None) -> Known:
    """Prior knowledge before any touch, bound to some rows of faces that are planned."""
    bound = _bound(problem, rows, places, planned, frozenset())
    return Known((), bound, begun(bound))


def _fitted(bound: BoundProblem) -> Belief:
    """The posterior of all rows about its peak."""
    found, scale = lm(bound), bound.start_std
    return Belief((found.x - bound.x0) / scale, covariance_root(found.covariance / np.outer(scale, scale)))


def _noise_over_stated(bound: BoundProblem, belief: Belief) -> float:
    """The factor of the stated noise at which the rows are likeliest; one where that is no telling difference."""
    # marginal likelihood of rows r + J y, y ~ N(-mean, I), for which J = U S V' makes each factor cheap
    x = bound.x0 + bound.start_std * belief.mean
    r, slopes = bound.residual(x), bound.jacobian(x) * bound.start_std
    _, sizes, right = svd(slopes, full=True)
    squares = np.zeros(belief.mean.size)
    squares[: sizes.size] = sizes**2
    pull, prior = right @ slopes.T @ r, right @ belief.mean

    def likelihood(factor: float) -> float:
        told, toward = 1 + squares / factor**2, pull / factor**2 + prior
        left = float(r @ r) / factor**2 + float(prior @ prior) - float(toward @ (toward / told))
        return -(left + float(np.log(told).sum())) / 2 - len(r) * math.log(factor)

    best = max(FACTORS, key=likelihood)
    return best if likelihood(best) >= likelihood(1.0) + TELLING else 1.0


def _moved(bound: BoundProblem, belief: Belief) -> BoundProblem:
    """The same rows with faces where they are believed to stand."""
    x, slots = bound.x0 + bound.start_std * belief.mean, list(bound.slots)
    for k, slot in enumerate(slots):
        if slot.datum and slot.unknown.nominal_plane(slot.nominal) is not None:
            _, plane = slot.unknown.shown(slot.nominal, x[slot.columns])
            slots[k] = replace(slot, nominal=read_only(slot.unknown.placed(plane["point_mm"], plane["normal"])))
    return _with_starts(BoundProblem(bound.problem, slots, bound.samples))


def _bound(
    problem: Problem, samples: Samples, places: Places, planned: Samples | None, proposed: frozenset[str]
) -> BoundProblem:
    try:
        slots = make_slots(problem, (samples,), {k: v for k, v in places.items() if k not in proposed})
    except ProblemError:  # touches on a line say of no face where it stands
        slots = make_slots(problem, (samples,), places)
    if planned is not None:
        slots = make_slots(problem, (joined(samples, planned),), {**places, **proposed_places(slots)})
    return _with_starts(BoundProblem(problem, slots, (samples,)))


def _with_starts(bound: BoundProblem) -> BoundProblem:
    """The same where a flat prior is as wide as filters start it: few touches leave no direction without an end."""
    flat = np.flatnonzero(~np.isfinite(bound.prior_std))
    names = tuple(bound.names[j] for j in flat)
    return bound.with_known(Gaussian(names, bound.x0[flat], np.diag(bound.start_std[flat] ** 2)))


def counts(problem: Problem, samples: Samples) -> dict[str, bool]:
    """Whether rows are enough to say where each thing stands that was declared without a nominal value, by name."""
    return {name: enough for name, _, enough in _proposing(problem, samples)}


def _proposing(problem: Problem, samples: Samples) -> Iterator[tuple[str, NDArray[np.intp], bool]]:
    """Each such thing by name, its rows, and whether they are enough."""
    for key, unknown in problem.instrument.unknowns.items():
        if unknown.nominal is None:
            flat = int((~np.isfinite(unknown.prior_stds)).sum())
            for label, rows in instances(problem.instrument, key, unknown, samples):
                enough = len(rows) * problem.models[0].components > flat
                yield key if label is None else f"{key}.{label}", rows, enough


def covered(bound: BoundProblem, samples: Samples) -> NDArray[np.bool_]:
    """Which rows (N,) have their unknowns among those that are bound: whose face is known, and the like."""
    have, found = {slot.name for slot in bound.slots}, np.ones(len(samples), dtype=bool)
    for key, unknown in bound.problem.instrument.unknowns.items():
        for label, rows in instances(bound.problem.instrument, key, unknown, samples):
            found[rows] &= label is None or f"{key}.{label}" in have
    return found


SURE = 0.95  # part of all arms whose error stays below what is promised
POOL = 600  # touches among which the next one is looked for
MOST = 200  # more touches than nobody makes


@dataclass(frozen=True, eq=False)
class ShiftedBelief:
    """A Gaussian of covariance (n, n) with its mean `shift` (n,) from the belief's; evidence: of its rows, as a log."""

    shift: Array
    covariance: Array
    evidence: float = 0.0

    @staticmethod
    def by(belief: Belief) -> ShiftedBelief:
        """The belief itself."""
        return ShiftedBelief(np.zeros(belief.mean.size), np.asarray(belief.root @ belief.root.T))

    def of(self, residual: Array, slope: Array) -> tuple[Array, Array]:
        """By how much a touch is off, residual (m,) and slope (m, n), whitened: value (m,) and covariance (m, m)."""
        return residual + slope @ self.shift, np.eye(len(residual)) + slope @ self.covariance @ slope.T


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Rows linear about a belief, in its units: residuals (touches, m), slopes (touches, m, n), whitened; noise, mm."""

    residual: Array
    slope: Array
    noise: Array

    @staticmethod
    def of(known: Known, touches: Sequence[Touch] | Samples) -> LinearRows:
        """Of touches, about what is known."""
        samples = touches if isinstance(touches, Samples) else rows_of(touches)
        bound, x = known.bound.on(samples), known.x
        return LinearRows(bound.residual(x).reshape(len(samples), -1), row_slopes(bound, x), bound.block.noise)

    def without(self, k: int) -> LinearRows:
        """All but one."""
        return LinearRows(*(np.delete(part, k, axis=0) for part in (self.residual, self.slope, self.noise)))

    def told(self, mean: Array) -> ShiftedBelief:
        """What they tell together, with the unit prior about -mean of the shift."""
        r, j = self.residual.ravel(), self.slope.reshape(-1, mean.size)
        information, gradient = np.eye(mean.size) + j.T @ j, j.T @ r + mean
        covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
        shift = -covariance @ gradient
        chi_square = r @ r + mean @ mean + gradient @ shift
        return ShiftedBelief(shift, covariance, -float(chi_square + np.linalg.slogdet(information)[1]) / 2)

    def off(self, told: ShiftedBelief, k: int) -> tuple[Array, Array]:
        """By how much a touch is off, and the standard deviation of that (m,), mm."""
        value, spread = told.of(self.residual[k], self.slope[k])
        return value * self.noise[k], np.sqrt(np.diagonal(spread)) * self.noise[k]


def innovations_at(known: Known, touches: Sequence[Touch]) -> tuple[Array, Array]:
    """Predicted residual of each touch if it came next, and its standard deviation, both (touches, m), mm."""
    rows, told = LinearRows.of(known, touches), ShiftedBelief.by(known.belief)
    found = np.array([rows.off(told, k) for k in range(len(touches))])
    return found[:, 0], found[:, 1]


def chance_of(known: Known, touches: Sequence[Touch]) -> float:
    """Chance that touches are together so far off where all is as is known: chi-square, what they share counted."""
    rows, told = LinearRows.of(known, touches), ShiftedBelief.by(known.belief)
    value, spread = told.of(rows.residual.ravel(), rows.slope.reshape(-1, told.shift.size))
    return chance(square(value, spread), len(value))


def square(value: Array, spread: Array) -> float:
    """Squared length of a value (m,) by its covariance (m, m)."""
    return float(value @ np.linalg.solve(spread, value))


def spectrum(root: Array, field: Array) -> Array:
    """Weights of the squared RMS tip error (mm^2) as a sum of squares of unit normals; covariance is root root'."""
    moves = field @ root
    return np.asarray(np.maximum(np.linalg.eigvalsh(moves.T @ moves) * 3 / len(field), 0.0))


def error_below(weights: Array, sure: float = SURE) -> float:
    """The RMS tip error (mm) below which a part of all arms stays, by Pearson's third: a gamma of the same moments."""
    mean, variance, third = (float((weights**k).sum()) for k in (1, 2, 3))
    if not variance > 0:
        return 0.0
    spread, skew = math.sqrt(2 * variance), 8 * third / (2 * variance) ** 1.5
    shape = 4 / skew**2
    return math.sqrt(max(mean + spread * (float(gammaincinv(shape, sure)) - shape) / math.sqrt(shape), 0.0))


@dataclass(frozen=True, eq=False)
class Pool(Value):
    """Touches that could be made: rows of the arm as drawn, their whitened slopes (N, m, n) in units of the belief."""

    samples: Samples
    slopes: Array

    @staticmethod
    def of(known: Known, samples: Samples) -> Pool:
        """Those of faces that the belief knows."""
        rows = samples.take(np.flatnonzero(covered(known.bound, samples)))
        return Pool(rows, LinearRows.of(known, rows).slope)

    def most_telling(self, covariance: Array, field: Array) -> int:
        """The number of the touch that lowers the tip error most, of a belief with a covariance (n, n)."""
        return int(np.argmax(gains(self.slopes, covariance, field.T @ field)))

    def needed(self, known: Known, field: Array, tolerance: float) -> int | None:
        """How many more touches, each the best of its time, bring the error below a tolerance; None over `MOST`."""
        covariance = known.covariance
        for count in range(MOST + 1):
            if error_below(spectrum(covariance_root(covariance), field)) <= tolerance:
                return count
            slope = self.slopes[self.most_telling(covariance, field)]
            across = slope @ covariance
            told = np.eye(len(slope)) + across @ slope.T
            covariance = covariance - across.T @ np.linalg.solve(told, across)
        return None

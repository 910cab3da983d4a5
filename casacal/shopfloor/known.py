"""Belief about the arm after the touches so far, and typing mistakes that would explain the latest one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import is_

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from casacal.data.samples import Samples, joined
from casacal.errors import CasacalError, ProblemError
from casacal.fit.bound_problem import OTHERS, BoundProblem, bind
from casacal.fit.filters import Belief, begun
from casacal.fit.kernel_rows import stated_prior
from casacal.fit.least_squares import Gaussian
from casacal.fit.lm import lm
from casacal.fit.slots import Slot, instances, make_slots
from casacal.linalg import svd
from casacal.model.problem import Problem
from casacal.planning.candidates import pool_of
from casacal.planning.choice import gains, row_slopes
from casacal.planning.clearance import Clearance
from casacal.planning.route import CHECK
from casacal.shopfloor.touch import Slip, Touch, rows_of
from casacal.simulation.cell import Disturbances
from casacal.simulation.places import drawn_arm
from casacal.simulation.touches import TouchingArm
from casacal.uncertainty.fresh_rows import chance, covariance_root
from casacal.values import Array, Value, read_only

NEW = 3e-3  # chance of a touch that comes below which it is looked into
EARLIER = 1e-4  # chance of one that came before, which every later one tries again
CLOSER_LOOK = 0.01  # chance below which an earlier touch is a suspect where a new one is off
LOOKED_INTO = 4  # earlier touches that are looked into at once
STRAY = 60.0  # range (mm) over which a touch lies anywhere that is off for no known reason
STRAY_WEIGHT = -2.0
AS_LIKELY = math.log(20.0)  # logarithm of evidence by which explanations may differ that are both named
ALONG = 0.02  # noise of a touch over that of others below which its plunger lies along the face
AS_GOOD = 4  # explanations that are named at most
FACTORS = tuple(1.25**k for k in range(1, 18))  # noise over what was stated, among which the likeliest is looked for
TELLING = 4.5  # logarithm of likelihoods from which on stated noise is given up: e^4.5, 90 to one
NEAR, MOVES = 0.5, 5  # part of what it begins with by which a face may be elsewhere; times that it is moved
STOOD = 2.0  # times that faces may stand further off their plan than filters begin with: 20 mm and 0.02 rad
FEWEST = 12  # touches from which on their scatter is looked at
SURE = 0.95  # part of all arms whose error stays below what is promised
POOL = 600  # touches among which the next one is looked for
MOST = 200  # more touches than anybody makes


@dataclass(frozen=True, eq=False)
class Suspected(Value):
    """An explanation: which touch, what was done there (None for no known reason), its part of all explanations'."""

    touch: int
    slip: Slip | None
    chance: float


@dataclass(frozen=True, eq=False)
class Alarm(Value):
    """A touch that does not agree with the others, and what explains it, the likeliest first.

    touch: the likeliest to be wrong, counted from 0. off, std: by how much the touch that raised the alarm is off, and
    the standard deviation of that, mm.
    """

    raised_by: int
    off: float
    std: float
    suspects: tuple[Suspected, ...]

    @staticmethod
    def of(rows: LinearRows, belief: ShiftedBelief, k: int, suspects: tuple[Suspected, ...], number: int) -> Alarm:
        """Alarm by row k, the touch `number`, against a belief from others; several residuals count by their norm."""
        off, std = rows.off(belief, k)
        size = float(off[0]) if len(off) == 1 else float(np.linalg.norm(off))  # a single number keeps its sign
        return Alarm(number, size, float(np.linalg.norm(std)), suspects)

    @property
    def touch(self) -> int:
        """Which touch is the likeliest to be wrong."""
        return self.suspects[0].touch if self.suspects else self.raised_by


def examined(
    known: Known, touches: Mapping[int, Touch], slips: Callable[[int], list[Slip]], *, others: Known | None
) -> Alarm | None:
    """Look for a touch that the others contradict; None where all agree.

    known: by all of these touches, which have their numbers. slips: possible typing mistakes in one of them. others:
    known by all but the last, where that has just come; else None.
    """
    numbers, last = list(touches), len(touches) - 1
    new, fresh = touches[numbers[last]], False
    if others is not None and not new.kept and chance_of(others, [new]) < NEW:
        fresh, known = True, others  # about which all is linear: a gross one moves it far
    mean, rows = known.belief.mean, LinearRows.of(known, list(touches.values()))
    chances = _chances(rows, mean)
    looked = [k for k, number in enumerate(numbers) if not touches[number].kept and not (fresh and k == last)]
    off = [k for k in looked if chances[k] < EARLIER]
    if not fresh and not off:
        return None
    closer = sorted((k for k in looked if chances[k] < CLOSER_LOOK), key=chances.__getitem__)[:LOOKED_INTO]
    raised = last if fresh else min(off, key=chances.__getitem__)
    beliefs = {numbers[k]: rows.without(k).posterior(mean) for k in dict.fromkeys([raised, *closer])}
    suspects = _explained(known, beliefs, slips, rows.noise[0], float(np.median(rows.noise)))
    return Alarm.of(rows, beliefs[numbers[raised]], raised, suspects, numbers[raised])


def refuse_along(known: Known, touch: Touch) -> None:
    """Raise CasacalError for a touch at which the plunger would lie along its face."""
    noise = known.bound.on(rows_of([touch])).block.noise
    if (noise < ALONG * np.median(known.bound.block.noise)).any():
        where = ", ".join(touch.labels.values()) or "the face"
        fix = "Look at the joint values and the face"
        raise CasacalError(f"At these joint values the plunger is parallel to '{where}' and cannot touch it", fix)


def _chances(rows: LinearRows, mean: Array) -> Array:
    """Chance of each touch (touches,) by all others."""
    belief, m = rows.posterior(mean), rows.residual.shape[1]
    left = rows.residual + np.einsum("kin,n->ki", rows.slope, belief.shift)
    free = np.eye(m) - np.einsum("kin,nl,kjl->kij", rows.slope, belief.covariance, rows.slope)
    some = np.einsum("kii->k", free) > 1e-9 * m  # of a face's only touches nobody can say anything
    squares = np.zeros(len(left))
    squares[some] = np.einsum("ki,ki->k", left[some], np.linalg.solve(free[some], left[some][..., None])[..., 0])
    return np.array([chance(float(each), m) for each in squares])


def _explained(
    known: Known, beliefs: Mapping[int, ShiftedBelief], slips: Callable[[int], list[Slip]], noise: Array, usual: float
) -> tuple[Suspected, ...]:
    """Explanations of touches by their numbers, likeliest first, the best of each kind; noise of a touch (m,), mm."""
    # range of a stray touch in units of its noise, as the evidence counts rows: less ln(2 pi) / 2
    stray = float(np.log(STRAY / np.minimum(noise, STRAY / 2)).sum() - len(noise) * math.log(2 * math.pi) / 2)
    scores: list[tuple[int, Slip | None, float]] = []
    for number, rest in beliefs.items():
        scores.append((number, None, rest.evidence + STRAY_WEIGHT - stray))
        possible = slips(number)
        if not possible:
            continue
        there = covered(known.bound, rows_of([slip.touch for slip in possible]))  # not a face that nobody has touched
        others = [slip for slip, known_face in zip(possible, there, strict=True) if known_face]
        if not others:
            continue
        rows = LinearRows.of(known, [slip.touch for slip in others])
        for k, slip in enumerate(others):
            if not (rows.noise[k] < ALONG * usual).any():  # a plunger along the face touches nothing
                value, spread = rest.of(rows.residual[k], rows.slope[k])
                likely = -float(square(value, spread) + np.linalg.slogdet(spread)[1]) / 2  # less a constant
                scores.append((number, slip, rest.evidence + likely + slip.weight))
    scores.sort(key=lambda each: -each[2])
    best: dict[tuple[int, str | None], tuple[int, Slip | None, float]] = {}
    for score in scores:
        best.setdefault((score[0], None if score[1] is None else score[1].kind), score)
    most = scores[0][2]
    total = sum(math.exp(likely - most) for *_, likely in scores)
    shown = [each for each in best.values() if each[2] > most - AS_LIKELY][:AS_GOOD]
    return tuple(Suspected(number, slip, math.exp(likely - most) / total) for number, slip, likely in shown)


@dataclass(frozen=True, eq=False)
class SessionState(Value):
    """The knowledge after some touches.

    known: by all of them but one in doubt and those kept for checking; None before any. alarm: the one in doubt.
    off, std: by how much the touch that has just come was off, and the standard deviation of that (m,), mm; None where
    nothing could be said. waiting: touches of faces of which nobody knows yet where they stand.
    """

    known: Known | None = None
    alarm: Alarm | None = None
    off: Array | None = None
    std: Array | None = None
    waiting: tuple[int, ...] = ()
    setting: SessionSetting | None = None


@dataclass(frozen=True, eq=False)
class SessionSetting(Value):
    """The part that does not change from touch to touch: problem, planned rows, places of faces, further touches."""

    problem: Problem
    planned: Samples | None
    places: Places
    cell: Disturbances | None = None
    clearance: Clearance | None = None

    @staticmethod
    def of(
        problem: Problem, plan: Samples | None, cell: Disturbances | None, clearance: Clearance | None
    ) -> SessionSetting:
        """Setting with the planned rows whose faces they place, if any."""
        if plan is None or not (rows := telling(problem, plan, {})):  # faces that are planned too seldom have no place
            return SessionSetting(problem, None, {}, cell, clearance)
        placed = plan.take(rows)
        places = proposed_places(bind(problem.without_terms, placed).slots)
        return SessionSetting(problem, placed, places, cell, clearance)

    @cached_property
    def further(self) -> Samples:
        """Touches beyond the plan, among which the next one is looked for."""
        return pool_of(self.problem, self.cell, POOL, 7, self.clearance)

    @cached_property
    def arm(self) -> TouchingArm:
        """The plunger on the arm as drawn, of an instrument that has one."""
        probe = self.problem.instrument.probe
        assert probe is not None
        return drawn_arm(self.problem, probe, np.random.default_rng(0))

    def known_by(self, touches: Sequence[Touch], before: Known | None) -> Known | None:
        """Belief from the usable touches, None without any; `before`: the belief a touch ago."""
        used = [touches[k] for k in self.usable(touches)]
        if before is not None and len(used) == len(before.touches) and all(map(is_, used, before.touches)):
            return before
        return known_from(self.problem, used, self.places, self.planned, before) if used else None

    def usable(self, touches: Sequence[Touch]) -> list[int]:
        """Indices of usable touches: those on faces that are planned or were touched often enough."""
        return telling(self.problem, rows_of(touches), self.places) if touches else []

    def state(
        self, touches: Sequence[Touch], slips: Callable[[int], list[Slip]], before: Known | None, *, new: bool
    ) -> SessionState:
        """Belief after touches; `slips` are candidate mistakes, `new` says that the last touch is new."""
        fit = [k for k, touch in enumerate(touches) if touch.purpose != CHECK]
        used = [fit[k] for k in self.usable([touches[k] for k in fit])]
        waiting, last = tuple(k for k in fit if k not in set(used)), len(touches) - 1
        known = self.known_by([touches[k] for k in used], before)
        if known is None:
            return SessionState(waiting=waiting, setting=self)
        if new and touches[last].purpose == CHECK:
            others: Known | None = known
            alarm, touch = None, touches[last]
            if not touch.kept and chance_of(known, [touch]) < NEW:  # it is not part of the belief
                rows, by = LinearRows.of(known, [touch]), ShiftedBelief.by(known.belief)
                usual = float(np.median(known.bound.block.noise))
                suspects = _explained(known, {last: by}, slips, rows.noise[0], usual)
                alarm = Alarm.of(rows, by, 0, suspects, last)
        else:
            others = None  # all touches but the last, its face included, where they determine it
            if new and used == [last]:
                others = known_before(self.problem, rows_of(touches[last:]), self.places, self.planned)
            elif new and last in used:
                rest = self.known_by([touches[k] for k in used[:-1]], before)
                others = rest if rest is not None and rest.knows(touches[last]) else None
            alarm = examined(known, {k: touches[k] for k in used}, slips, others=others)
        off, std = (None, None) if others is None else (each[0] for each in innovations_at(others, [touches[last]]))
        if alarm is not None and alarm.touch in used:  # without which a face may be short of a touch
            known = self.known_by([touches[k] for k in used if k != alarm.touch], before)
        return SessionState(known, alarm, off, std, waiting, self)


Places = Mapping[str, Array]
"""Where things stand that were declared without a nominal value, by the full name of the unknown."""


@dataclass(frozen=True, eq=False)
class Known(Value):
    """Belief about the arm after some touches.

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
        """Covariance (n, n) of the belief, in its units."""
        return np.asarray(self.belief.root @ self.belief.root.T)

    def knows(self, touch: Touch) -> bool:
        """Whether there are unknowns for the face of a touch."""
        return bool(covered(self.bound, rows_of([touch])).all())


def proposed_places(slots: Sequence[Slot]) -> dict[str, Array]:
    """Nominal values that the rows propose for unknowns declared without one, by name."""
    return {slot.name: slot.nominal for slot in slots if slot.unknown.nominal is None}


def telling(problem: Problem, samples: Samples, places: Places) -> list[int]:
    """Indices of usable rows: those on faces that are planned or were touched often enough."""
    usable = np.ones(len(samples), dtype=bool)
    for name, rows, enough in _proposing(problem, samples):
        if name in places:
            continue
        try:
            if enough:
                make_slots(problem, (samples.take(rows),), places)
        except ProblemError:  # touches on a line do not say where a face is
            enough = False
        usable[rows] &= enough
    return [int(k) for k in np.flatnonzero(usable)]


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
    # marginal likelihood of rows r + J R y, y ~ N(-mean, I), R the prior's root: J R = U S V' makes each factor cheap
    x, root = bound.x0 + bound.start_std * belief.mean, bound.prior_root
    r, slopes = bound.residual(x), bound.jacobian(x) * bound.start_std @ root
    _, sizes, right = svd(slopes, full=True)
    squares = np.zeros(belief.mean.size)
    squares[: sizes.size] = sizes**2
    pull, prior = right @ slopes.T @ r, right @ np.linalg.solve(root, belief.mean)

    def likelihood(factor: float) -> float:
        information, toward = 1 + squares / factor**2, pull / factor**2 + prior
        left = float(r @ r) / factor**2 + float(prior @ prior) - float(toward @ (toward / information))
        return -(left + float(np.log(information).sum())) / 2 - len(r) * math.log(factor)

    best = max(FACTORS, key=likelihood)
    return best if likelihood(best) >= likelihood(1.0) + TELLING else 1.0


def _moved(bound: BoundProblem, belief: Belief) -> BoundProblem:
    """Rows bound with faces at their believed positions."""
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
    """Problem with flat priors as wide as a filter's start, so that few touches leave the covariance finite."""
    flat = np.flatnonzero(~np.isfinite(bound.prior_std))
    names = tuple(bound.names[j] for j in flat)
    wide = Gaussian(names, bound.x0[flat], np.diag((STOOD * bound.start_std[flat]) ** 2))
    stated = stated_prior(bound.problem.constraints, bound.slots)
    return bound.with_known(wide if stated is None else stated.beside(wide))


def counts(problem: Problem, samples: Samples) -> dict[str, bool]:
    """Whether rows are enough to place each unknown that was declared without a nominal value, by name."""
    return {name: enough for name, _, enough in _proposing(problem, samples)}


def _proposing(problem: Problem, samples: Samples) -> Iterator[tuple[str, NDArray[np.intp], bool]]:
    """Each unknown without a nominal value: its name, its rows, and whether they are enough."""
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
        """Predicted residual (m,) of a touch and its covariance (m, m), from residual and slope (m, n), whitened."""
        return residual + slope @ self.shift, np.eye(len(residual)) + slope @ self.covariance @ slope.T


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Rows linear about a belief, in its units: residuals (touches, m), slopes (touches, m, n), whitened; noise, mm.

    prior: information (n, n) before any touch.
    """

    residual: Array
    slope: Array
    noise: Array
    prior: Array

    @staticmethod
    def of(known: Known, touches: Sequence[Touch] | Samples) -> LinearRows:
        """Linearise touches about the mean of a belief."""
        samples = touches if isinstance(touches, Samples) else rows_of(touches)
        bound, x = known.bound.on(samples), known.x
        white = np.linalg.inv(bound.prior_root)
        residual, slopes = bound.residual(x).reshape(len(samples), -1), row_slopes(bound, x)
        return LinearRows(residual, slopes, bound.block.noise, white.T @ white)

    def without(self, k: int) -> LinearRows:
        """All rows but one."""
        residual, slope, noise = (np.delete(part, k, axis=0) for part in (self.residual, self.slope, self.noise))
        return LinearRows(residual, slope, noise, self.prior)

    def posterior(self, mean: Array) -> ShiftedBelief:
        """Posterior of the shift, with the prior about -mean."""
        r, j, pull = self.residual.ravel(), self.slope.reshape(-1, mean.size), self.prior @ mean
        information, gradient = self.prior + j.T @ j, j.T @ r + pull
        covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
        shift = -covariance @ gradient
        chi_square = r @ r + mean @ pull + gradient @ shift
        return ShiftedBelief(shift, covariance, -float(chi_square + np.linalg.slogdet(information)[1]) / 2)

    def off(self, belief: ShiftedBelief, k: int) -> tuple[Array, Array]:
        """Predicted residual of touch k and its standard deviation (m,), mm."""
        value, spread = belief.of(self.residual[k], self.slope[k])
        return value * self.noise[k], np.sqrt(np.diagonal(spread)) * self.noise[k]


def innovations_at(known: Known, touches: Sequence[Touch]) -> tuple[Array, Array]:
    """Predicted residual of each touch if it came next, and its standard deviation, both (touches, m), mm."""
    rows, belief = LinearRows.of(known, touches), ShiftedBelief.by(known.belief)
    found = np.array([rows.off(belief, k) for k in range(len(touches))])
    return found[:, 0], found[:, 1]


def per_reading(known: Known, touch: Touch) -> float | None:
    """By how much (mm) the predicted residual of a touch grows per mm that is read along a plunger, or None."""
    probe = known.bound.problem.instrument.probe
    if probe is None or probe.column is None or not known.knows(touch):
        return None
    longer = replace(touch, columns={**touch.columns, probe.column: touch.columns[probe.column] + 1.0})
    off, _ = innovations_at(known, [touch, longer])
    slope = float(off[1, 0] - off[0, 0])
    return slope if off.shape[1] == 1 and abs(slope) > ALONG else None


def chance_of(known: Known, touches: Sequence[Touch]) -> float:
    """Chance of so large a joint residual of some touches: chi-square of their predicted covariance."""
    rows, belief = LinearRows.of(known, touches), ShiftedBelief.by(known.belief)
    value, spread = belief.of(rows.residual.ravel(), rows.slope.reshape(-1, belief.shift.size))
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
        """Pool of the samples on faces that the belief knows."""
        rows = samples.take(np.flatnonzero(covered(known.bound, samples)))
        if not len(rows):
            return Pool(rows, np.zeros((0, 1, known.bound.unknowns)))
        return Pool(rows, LinearRows.of(known, rows).slope)

    def most_telling(self, covariance: Array, field: Array) -> int:
        """The number of the touch that lowers the tip error most, of a belief with a covariance (n, n)."""
        return int(np.argmax(gains(self.slopes, covariance, field.T @ field)))

    def needed(self, known: Known, field: Array, tolerance: float) -> int | None:
        """How many more touches, each the best of its time, bring the error below a tolerance; None over `MOST`."""
        covariance = known.covariance
        for count in range(MOST + 1 if len(self.slopes) else 0):
            if error_below(spectrum(covariance_root(covariance), field)) <= tolerance:
                return count
            slope = self.slopes[self.most_telling(covariance, field)]
            across = slope @ covariance
            innovation = np.eye(len(slope)) + across @ slope.T
            covariance = covariance - across.T @ np.linalg.solve(innovation, across)
        return None

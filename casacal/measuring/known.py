"""What touches have told so far: one fit of all of them, and how they scatter."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.noise_scale import OTHERS
from casacal.binding.slots import Slot, instances, make_slots
from casacal.errors import ProblemError
from casacal.estimators import lm
from casacal.estimators.sckf import Belief, begun
from casacal.least_squares.gaussian import Gaussian
from casacal.least_squares.linalg import svd
from casacal.measuring.touch import Touch, rows_of
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples, joined
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


def places_of(problem: Problem, samples: Samples) -> dict[str, Array]:
    """Where faces and the like stand by planned rows, which all tell something."""
    return _proposed(bind(problem.without_effects, samples).slots)


def _proposed(slots: Sequence[Slot]) -> dict[str, Array]:
    return {slot.name: slot.nominal for slot in slots if slot.unknown.nominal is None}


def telling(problem: Problem, samples: Samples, places: Places) -> list[int]:
    """Which rows tell something: those of faces that are planned or were touched often enough."""
    told = np.ones(len(samples), dtype=bool)
    for name, rows, enough in _proposing(problem, samples):
        if name not in places and not (enough and _stands(problem, samples.take(rows), places)):
            told[rows] = False
    return [int(k) for k in np.flatnonzero(told)]


def _stands(problem: Problem, samples: Samples, places: Places) -> bool:
    """Whether rows of one face say where it is; those on a line do not."""
    try:
        make_slots(problem, (samples,), places)
    except ProblemError:
        return False
    return True


def known_from(
    problem: Problem, touches: Sequence[Touch], places: Places, planned: Samples | None, before: Known | None = None
) -> Known:
    """Fit touches that are all usable, with the prior and, where it is flat, what a filter would start with.

    Faces begin where they are planned, or else where their own touches say, and where they are found to stand
    elsewhere, there: what they begin with is no knowledge of where they are. What is planned has its unknowns from the
    beginning on, so that they stay the same. `before` is what was known a touch ago, whose binding serves again. Raises
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
    """What is known before any touch, bound to some rows of faces that are planned."""
    bound = _bound(problem, rows, places, planned, frozenset())
    return Known((), bound, begun(bound))


def _fitted(bound: BoundProblem) -> Belief:
    """The posterior of all rows about its peak."""
    found, scale = lm(bound), bound.start_std
    root = np.asarray(np.linalg.cholesky(found.covariance / np.outer(scale, scale)), dtype=np.float64)
    return Belief((found.x - bound.x0) / scale, root)


def _noise_over_stated(bound: BoundProblem, belief: Belief) -> float:
    """The factor of the stated noise at which the rows are likeliest; one where that is no telling difference.

    The marginal likelihood of rows linear about the belief, r + J y with y ~ N(-mean, I): with J = U S V' each factor
    costs a few numbers.
    """
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
    x = bound.x0 + bound.start_std * belief.mean
    slots = []
    for slot in bound.slots:
        if slot.datum and slot.unknown.nominal_plane(slot.nominal) is not None:
            _, plane = slot.unknown.shown(slot.nominal, x[slot.columns])
            slot = replace(slot, nominal=read_only(slot.unknown.placed(plane["point_mm"], plane["normal"])))
        slots.append(slot)
    return _with_starts(BoundProblem(bound.problem, slots, bound.samples))


def _bound(
    problem: Problem, samples: Samples, places: Places, planned: Samples | None, proposed: frozenset[str]
) -> BoundProblem:
    try:
        slots = make_slots(problem, (samples,), {k: v for k, v in places.items() if k not in proposed})
    except ProblemError:  # touches on a line say of no face where it stands
        slots = make_slots(problem, (samples,), places)
    if planned is not None:
        slots = make_slots(problem, (joined(samples, planned),), {**places, **_proposed(slots)})
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
    have, instrument = {slot.name for slot in bound.slots}, bound.problem.instrument
    found = np.ones(len(samples), dtype=bool)
    for key, unknown in instrument.unknowns.items():
        if unknown.per is not None:
            labels = samples.labels[unknown.per]
            named = [f"{key}.{instrument.instance(key, name)}" in have for name in labels.names]
            found &= np.array(named)[labels.codes]
    return found

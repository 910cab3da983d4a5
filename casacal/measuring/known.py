"""What touches have told so far: the cubature filter's belief after each, and how they scatter."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.noise_scale import OTHERS
from casacal.binding.slots import Slot, instances, make_slots
from casacal.errors import ProblemError
from casacal.estimators.sckf import Belief, begun, take_in
from casacal.measuring.touch import Touch, rows_of
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples, joined
from casacal.values import Value, read_only

Places = Mapping[str, Array]
"""Where things stand that were declared without a nominal value, by the full name of the unknown."""

FACTORS = tuple(1.25**k for k in range(1, 18))  # noise over what was stated, among which the likeliest is looked for
TELLING = 4.5  # logarithm of likelihoods from which on stated noise is given up: e^4.5, 90 to one
NEAR, MOVES = 0.5, 5  # part of what a filter starts with by which a face may be elsewhere; times that it is moved
STEPS = 6  # Gauss-Newton steps at most; three are the rule
FEWEST = 12  # touches from which on their scatter is looked at


@dataclass(frozen=True, eq=False)
class Known(Value):
    """What some touches tell.

    bound: to their rows. belief: after the last, in units of `start_std` about x0. factor: noise over what was stated,
    one or more. proposed: names of what stands where touches say, not a plan.
    """

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
    return _proposed(bind(problem.without_terms, samples).slots)


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
    """Let a filter take in touches that are all usable, in their order, from the prior on.

    Faces begin where they are planned, or else where their own touches say, and where they are found to stand
    elsewhere, there: what a filter starts from is no knowledge of where they are.
    What is planned has its unknowns from the beginning on, so that they stay the same. `before` is what was known a
    touch ago, whose binding serves again. Raises ProblemError where nothing says where a
    face stands.
    """
    samples = rows_of(touches)
    proposed = frozenset(name for name, enough in counts(problem, samples).items() if enough and name not in places)
    if before is not None and before.proposed == proposed and covered(before.bound, samples).all():
        bound = before.bound.with_noise().on(samples)
    else:
        bound = _bound(problem, samples, places, planned, proposed)
    belief, likelihood = _filtered(bound)
    for _ in range(MOVES):
        # some face is believed further from where it began than a filter starts with
        if not (np.abs(belief.mean) > NEAR)[bound.datum].any():
            break
        bound = _moved(bound, belief)
        belief, likelihood = _filtered(bound)
    if len(touches) >= FEWEST:
        noisier = [(factor, bound.with_noise({OTHERS: factor})) for factor in FACTORS]
        filtered = [_filtered(each) for _, each in noisier]
        best = max(range(len(FACTORS)), key=lambda k: filtered[k][1])
        if filtered[best][1] >= likelihood + TELLING:
            return Known(noisier[best][1], filtered[best][0], noisier[best][0], proposed)
    return Known(bound, belief, 1.0, proposed)


def known_before(problem: Problem, rows: Samples, places: Places, planned: Samples | None = None) -> Known:
    """What is known before any touch, bound to some rows of faces that are planned."""
    bound = _bound(problem, rows, places, planned, frozenset())
    return Known(bound, begun(bound))


def _filtered(bound: BoundProblem) -> tuple[Belief, float]:
    """The belief after all rows, and the logarithm of their likelihood, less a constant.

    By innovations (Schweppe, IEEE Trans. Inf. Theory 11, 1965).
    """
    belief, k, told = begun(bound), 0, list[tuple[Array, Array]]()
    while k < bound.rows:
        taken = take_in(bound, belief, k)
        belief, k = Belief(taken.mean, taken.root), taken.stop
        told.append((taken.innovations, taken.stds))
    innovations, stds = (np.concatenate(each) for each in zip(*told, strict=True))
    unlikely = (innovations / stds) ** 2 / 2 + np.log(stds * bound.block.noise.ravel())
    return _settled(bound, belief), -float(unlikely.sum())


def _settled(bound: BoundProblem, belief: Belief) -> Belief:
    """The belief about the peak of the posterior, where one pass leaves it some tenths of a standard deviation short.

    Gauss-Newton steps from the filter's mean, as the paper's M7 goes from M5 to M6, with the same unit prior.
    """
    mean, cost, lower = belief.mean, math.inf, None
    for _ in range(STEPS):
        x = bound.x0 + bound.start_std * mean
        r, j = bound.residual(x), bound.jacobian(x) * bound.start_std
        if (now := float(r @ r + mean @ mean)) >= cost * (1 - 1e-9):
            break
        settled, cost = mean, now
        lower = np.linalg.cholesky(np.eye(mean.size) + j.T @ j)
        mean = mean - solve_triangular(lower.T, solve_triangular(lower, j.T @ r + mean, lower=True))
    if lower is None:
        return belief
    half = solve_triangular(lower, np.eye(mean.size), lower=True)
    return Belief(settled, np.linalg.cholesky(half.T @ half))


def _moved(bound: BoundProblem, belief: Belief) -> BoundProblem:
    """The same rows with faces where they are believed to stand."""
    x = bound.x0 + bound.start_std * belief.mean
    slots = []
    for slot in bound.slots:
        if slot.datum and slot.unknown.nominal_plane(slot.nominal) is not None:
            _, plane = slot.unknown.shown(slot.nominal, x[slot.columns])
            slot = replace(slot, nominal=read_only(slot.unknown.placed(plane["point_mm"], plane["normal"])))
        slots.append(slot)
    return BoundProblem(bound.problem, slots, bound.samples)


def _bound(
    problem: Problem, samples: Samples, places: Places, planned: Samples | None, proposed: frozenset[str]
) -> BoundProblem:
    try:
        slots = make_slots(problem, (samples,), {k: v for k, v in places.items() if k not in proposed})
    except ProblemError:  # touches on a line say of no face where it stands
        slots = make_slots(problem, (samples,), places)
    if planned is not None:
        slots = make_slots(problem, (joined(samples, planned),), {**places, **_proposed(slots)})
    return BoundProblem(problem, slots, (samples,))


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

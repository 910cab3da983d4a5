"""Whether touches agree with one another, and which single slip would explain it where they do not.

Every explanation (one slip in one touch, or a touch that is off for no known reason) is weighed by the evidence of all
rows under it, with the arm and the faces integrated out: a Gaussian, linear about the belief.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import is_

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import bind
from casacal.errors import CasacalError
from casacal.measuring.known import (
    POOL,
    Known,
    LinearRows,
    Places,
    ShiftedBelief,
    chance_of,
    innovations_at,
    known_before,
    known_from,
    proposed_places,
    square,
    telling,
)
from casacal.measuring.touch import Slip, Touch, rows_of
from casacal.planning.candidates import Clearance, pool_of
from casacal.planning.route import CHECK
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.cell import Disturbances
from casacal.uncertainty.fresh_rows import chance
from casacal.values import Value

NEW = 3e-3  # chance of a touch that comes below which it is looked into
EARLIER = 1e-4  # chance of one that came before, which every later one tries again
CLOSER_LOOK = 0.01  # chance below which an earlier touch is a suspect where a new one is off
MOST = 4  # earlier touches that are looked into at once
STRAY = 60.0  # range (mm) over which a touch lies anywhere that is off for no known reason
STRAY_WEIGHT = -2.0
AS_LIKELY = math.log(20.0)  # logarithm of evidence by which explanations may differ that are both named
ALONG = 0.02  # noise of a touch over that of others below which its plunger lies along the face
AS_GOOD = 4  # explanations that are named at most


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
    def of(rows: LinearRows, told: ShiftedBelief, k: int, suspects: tuple[Suspected, ...], number: int) -> Alarm:
        """By row k, a touch of some number, where others tell something; of several numbers, their lengths."""
        off, std = rows.off(told, k)
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
    closer = sorted((k for k in looked if chances[k] < CLOSER_LOOK), key=chances.__getitem__)[:MOST]
    raised = last if fresh else min(off, key=chances.__getitem__)
    told = {numbers[k]: rows.without(k).told(mean) for k in dict.fromkeys([raised, *closer])}
    suspects = _explained(known, told, slips, rows.noise[0], float(np.median(rows.noise)))
    return Alarm.of(rows, told[numbers[raised]], raised, suspects, numbers[raised])


def judged_alone(known: Known, touch: Touch, slips: Callable[[int], list[Slip]], number: int) -> Alarm | None:
    """Look at a touch that is not taken in, by what is known; None where it agrees."""
    if touch.kept or chance_of(known, [touch]) >= NEW:
        return None
    rows, told = LinearRows.of(known, [touch]), ShiftedBelief.by(known.belief)
    usual = float(np.median(known.bound.block.noise))
    return Alarm.of(rows, told, 0, _explained(known, {number: told}, slips, rows.noise[0], usual), number)


def refuse_along(known: Known, touch: Touch) -> None:
    """Raise CasacalError for a touch at which the plunger would lie along its face."""
    noise = known.bound.on(rows_of([touch])).block.noise
    if (noise < ALONG * np.median(known.bound.block.noise)).any():
        where = ", ".join(touch.labels.values()) or "the face"
        fix = "Look at the joint values and the face"
        raise CasacalError(f"At these joint values the plunger is parallel to '{where}' and cannot touch it", fix)


def _chances(rows: LinearRows, mean: Array) -> Array:
    """Chance of each touch (touches,) by all others."""
    told, m = rows.told(mean), rows.residual.shape[1]
    left = rows.residual + np.einsum("kin,n->ki", rows.slope, told.shift)
    free = np.eye(m) - np.einsum("kin,nl,kjl->kij", rows.slope, told.covariance, rows.slope)
    some = np.einsum("kii->k", free) > 1e-9 * m  # of a face's only touches nobody can say anything
    squares = np.zeros(len(left))
    squares[some] = np.einsum("ki,ki->k", left[some], np.linalg.solve(free[some], left[some][..., None])[..., 0])
    return np.array([chance(float(each), m) for each in squares])


def _explained(
    known: Known, told: Mapping[int, ShiftedBelief], slips: Callable[[int], list[Slip]], noise: Array, usual: float
) -> tuple[Suspected, ...]:
    """Explanations of touches by their numbers, likeliest first, the best of each kind; noise of a touch (m,), mm."""
    # range of a stray touch in units of its noise, as the evidence counts rows: less ln(2 pi) / 2
    stray = float(np.log(STRAY / np.minimum(noise, STRAY / 2)).sum() - len(noise) * math.log(2 * math.pi) / 2)
    scores: list[tuple[int, Slip | None, float]] = []
    for number, rest in told.items():
        scores.append((number, None, rest.evidence + STRAY_WEIGHT - stray))
        others = [slip for slip in slips(number) if known.knows(slip.touch)]  # not a face that nobody has touched
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
        """Of a plan's rows, or of none."""
        if plan is None or not (told := telling(problem, plan, {})):  # faces that are planned too seldom have no place
            return SessionSetting(problem, None, {}, cell, clearance)
        placed = plan.take(told)
        places = proposed_places(bind(problem.without_terms, placed).slots)
        return SessionSetting(problem, placed, places, cell, clearance)

    @cached_property
    def further(self) -> Samples:
        """Touches beyond the plan, among which the next one is looked for."""
        return pool_of(self.problem, self.cell, POOL, 7, self.clearance)

    def known_by(self, touches: Sequence[Touch], before: Known | None) -> Known | None:
        """Fit of those touches that tell where something stands; `before`: the fit a touch ago, None where none do."""
        used = [touches[k] for k in self.usable(touches)]
        if before is not None and len(used) == len(before.touches) and all(map(is_, used, before.touches)):
            return before
        return known_from(self.problem, used, self.places, self.planned, before) if used else None

    def usable(self, touches: Sequence[Touch]) -> list[int]:
        """Which touches tell something: those of faces that are planned or were touched often enough."""
        return telling(self.problem, rows_of(touches), self.places) if touches else []

    def state(
        self, touches: Sequence[Touch], slips: Callable[[int], list[Slip]], before: Known | None, *, new: bool
    ) -> SessionState:
        """What touches tell; `slips` says what may be wrong with one, `new` that the last has just come."""
        fit = [k for k, touch in enumerate(touches) if touch.purpose != CHECK]
        used = [fit[k] for k in self.usable([touches[k] for k in fit])]
        waiting, last = tuple(k for k in fit if k not in set(used)), len(touches) - 1
        known = self.known_by([touches[k] for k in used], before)
        if known is None:
            return SessionState(waiting=waiting, setting=self)
        if new and touches[last].purpose == CHECK:
            others: Known | None = known
            alarm = judged_alone(known, touches[last], slips, last)
        else:
            others = self._others([touches[k] for k in used], before) if new and last in used else None
            alarm = examined(known, {k: touches[k] for k in used}, slips, others=others)
        off, std = (None, None) if others is None else (each[0] for each in innovations_at(others, [touches[last]]))
        if alarm is not None and alarm.touch in used:  # without which a face may be short of a touch
            known = self.known_by([touches[k] for k in used if k != alarm.touch], before)
        return SessionState(known, alarm, off, std, waiting, self)

    def _others(self, used: Sequence[Touch], before: Known | None) -> Known | None:
        """What all touches but the last tell of its face too; None where they tell nothing of it."""
        if len(used) == 1:
            return known_before(self.problem, rows_of(used), self.places, self.planned)
        others = self.known_by(used[:-1], before)
        return others if others is not None and others.knows(used[-1]) else None

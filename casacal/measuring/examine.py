"""Whether touches agree with one another, and which single slip would explain it where they do not.

Every explanation (one slip in one touch, or a touch that is off for no known reason) is weighed by the evidence of all
rows under it, with the arm and the faces integrated out: a Gaussian, linear about the belief.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.errors import CasacalError
from casacal.estimators.sckf import Belief
from casacal.measuring.further import LinearRows
from casacal.measuring.known import Known
from casacal.measuring.slips import Slip
from casacal.measuring.touch import Touch, rows_of
from casacal.uncertainty.fresh_rows import chance
from casacal.values import Value

NEW = 3e-3
"""Chance of a touch that comes below which it is looked into."""

EARLIER = 1e-4
"""Chance of one that came before, which every later one tries again."""

CLOSER_LOOK = 0.01
"""Chance below which an earlier touch is a suspect where a new one is off."""

MOST = 4
"""Earlier touches that are looked into at once."""

STRAY = 60.0
"""Range (mm) over which a touch lies anywhere that is off for no known reason."""

STRAY_WEIGHT = -2.0
AS_LIKELY = math.log(20.0)
"""Logarithm of evidence by which explanations may differ that are both named."""

ALONG = 0.02
"""Noise of a touch over that of others below which its plunger lies along the face."""

AS_GOOD = 4
"""Explanations that are named at most."""


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

    @property
    def touch(self) -> int:
        """Which touch is the likeliest to be wrong."""
        return self.suspects[0].touch if self.suspects else self.raised_by


def examined(
    known: Known, touches: Sequence[Touch], slips: Callable[[int], list[Slip]], *, others: Known | None
) -> Alarm | None:
    """Look for a touch that the others contradict; None where all agree.

    Args:
        known: from all of these touches, in their order.
        touches: those that were taken in.
        slips: what may have been typed wrong in one of them.
        others: what all but the last tell, where that has just come; None where all have been there before.

    """
    last = len(touches) - 1
    fresh = others is not None and not touches[last].kept and _chance_alone(others, touches[last]) < NEW
    if fresh and others is not None:
        known = others  # about which all is linear: a gross one moves it far
    before = known.belief
    rows = LinearRows.of(known, before, touches)
    chances = _left_out(rows, before.mean)
    looked = [k for k in range(len(touches)) if not touches[k].kept and not (fresh and k == last)]
    off = [k for k in looked if chances[k] < EARLIER]
    if not fresh and not off:
        return None
    closer = sorted((k for k in looked if chances[k] < CLOSER_LOOK), key=chances.__getitem__)[:MOST]
    raised = last if fresh else min(off, key=chances.__getitem__)
    suspects = _explained(known, before, rows, slips, [*([last] if fresh else []), *closer])
    return Alarm(raised, *_off_by(rows, before, raised), suspects)


def refuse_along(known: Known, touch: Touch) -> None:
    """Raise CasacalError for a touch at which the plunger would lie along its face."""
    noise = known.bound.on(rows_of([touch])).block.noise
    if (noise < ALONG * np.median(known.bound.block.noise)).any():
        where = ", ".join(touch.labels.values()) or "the face"
        raise CasacalError(
            f"At these joint values the plunger is parallel to '{where}' and cannot touch it",
            "Look at the joint values and the face",
        )


def _chance_alone(known: Known, touch: Touch) -> float:
    """Chance of a touch by what others tell."""
    rows = LinearRows.of(known, known.belief, [touch])
    value, spread = rows.residual[0], rows.slope[0] @ known.belief.root
    square = float(value @ np.linalg.solve(np.eye(len(value)) + spread @ spread.T, value))
    return chance(square, len(value))


def judged_alone(known: Known, touch: Touch, slips: Callable[[], list[Slip]], number: int) -> Alarm | None:
    """Look at a touch that is not taken in, by what is known; None where it agrees."""
    rows = LinearRows.of(known, known.belief, [touch])
    value, slope = rows.residual[0], rows.slope[0]
    spread = slope @ known.belief.root
    if touch.kept or _chance_alone(known, touch) >= NEW:
        return None
    others = slips()
    scores: list[tuple[Slip | None, float]] = [(None, STRAY_WEIGHT - _stray(rows))]
    found = LinearRows.of(known, known.belief, [slip.touch for slip in others]) if others else None
    for k, slip in enumerate(others):
        assert found is not None
        if (found.noise[k] < ALONG * np.median(known.bound.block.noise)).any():
            continue
        scores.append((slip, slip.weight + _alone(found.residual[k], found.slope[k] @ known.belief.root)))
    return Alarm(number, *_off_alone(rows, value, spread), _ranked([(number, *each) for each in scores]))


def _explained(
    known: Known,
    about: Belief,
    rows: LinearRows,
    slips: Callable[[int], list[Slip]],
    looked: Sequence[int],
) -> tuple[Suspected, ...]:
    scores: list[tuple[int, Slip | None, float]] = []
    for k in looked:
        stray = rows.without(k).evidence(about.mean) + STRAY_WEIGHT - _stray(rows)
        scores.append((k, None, stray))
        others = slips(k)
        if not others:
            continue
        changed = LinearRows.of(known, about, [slip.touch for slip in others])
        rest = rows.without(k)
        parts = zip(others, changed.residual, changed.slope, changed.noise, strict=True)
        for slip, residual, slope, noise in parts:
            if (noise < ALONG * np.median(rows.noise)).any():  # a plunger along the face touches nothing
                continue
            whole = LinearRows(
                np.vstack([rest.residual, residual]),
                np.vstack([rest.slope, slope[None]]),
                np.vstack([rest.noise, noise]),
            )
            scores.append((k, slip, whole.evidence(about.mean) + slip.weight))
    return _ranked(scores)


def _ranked(scores: Sequence[tuple[int, Slip | None, float]]) -> tuple[Suspected, ...]:
    """The likeliest first, of each touch and kind only the best; those that are far less likely left out."""
    order = sorted(scores, key=lambda each: -each[2])
    best = {(touch, None if slip is None else slip.kind): None for touch, slip, _ in order}
    kept = []
    for touch, slip, score in order:
        key = touch, None if slip is None else slip.kind
        if key in best:
            del best[key]
            kept.append((touch, slip, score))
    most = order[0][2]
    total = sum(math.exp(score - most) for *_, score in order)
    shown = [each for each in kept if each[2] > most - AS_LIKELY][:AS_GOOD]
    return tuple(Suspected(touch, slip, math.exp(score - most) / total) for touch, slip, score in shown)


def _left_out(rows: LinearRows, mean: Array) -> Array:
    """Chance of each touch (touches,) by all others."""
    flat, m = rows.slope.reshape(-1, mean.size), rows.residual.shape[1]
    covariance = np.linalg.inv(np.eye(mean.size) + flat.T @ flat)
    shift = -covariance @ (flat.T @ rows.residual.ravel() + mean)
    left = rows.residual + np.einsum("kin,n->ki", rows.slope, shift)
    free = np.eye(m) - np.einsum("kin,nl,kjl->kij", rows.slope, covariance, rows.slope)
    told = np.einsum("kii->k", free) > 1e-9 * m  # of a face's only touches nobody can say anything
    squares = np.zeros(len(left))
    squares[told] = np.einsum("ki,ki->k", left[told], np.linalg.solve(free[told], left[told][..., None])[..., 0])
    return np.array([chance(float(square), m) for square in squares])


def _alone(residual: Array, spread: Array) -> float:
    covariance = np.eye(len(residual)) + spread @ spread.T
    square = residual @ np.linalg.solve(covariance, residual)
    return -float(square + np.linalg.slogdet(covariance)[1]) / 2


def _stray(rows: LinearRows) -> float:
    """Logarithm of the range of a stray touch in units of its noise, as the evidence counts rows: less ln(2 pi) / 2."""
    noise = rows.noise[0]
    return float(np.log(STRAY / np.minimum(noise, STRAY / 2)).sum() - len(noise) * math.log(2 * math.pi) / 2)


def _off_by(rows: LinearRows, about: Belief, k: int) -> tuple[float, float]:
    """By how much a touch is off by the others, and the standard deviation of that, mm; of several, their length."""
    rest = rows.without(k)
    flat = rest.slope.reshape(-1, about.mean.size)
    covariance = np.linalg.inv(np.eye(about.mean.size) + flat.T @ flat)
    shift = -covariance @ (flat.T @ rest.residual.ravel() + about.mean)
    value = rows.residual[k] + rows.slope[k] @ shift
    noise = rows.noise[k]
    spread = np.eye(len(value)) + rows.slope[k] @ covariance @ rows.slope[k].T
    std = math.sqrt(float((np.diagonal(spread) * noise**2).sum()))
    return _signed(value * noise), std


def _off_alone(rows: LinearRows, value: Array, spread: Array) -> tuple[float, float]:
    noise = rows.noise[0]
    std = math.sqrt(float(((1 + (spread**2).sum(axis=1)) * noise**2).sum()))
    return _signed(value * noise), std


def _signed(value: Array) -> float:
    return float(value[0]) if len(value) == 1 else float(np.linalg.norm(value))

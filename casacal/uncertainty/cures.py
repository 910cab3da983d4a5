"""What to do next, best first: extra touches, simulated, put on top of the samples there are, and judged at the tip.

Every figure is worked out at the estimate, as the tip error to expect is: the arm as calibrated touches its faces as
they were found, and the linearised touches are added to what the samples know, everything free.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.marginal import Seen, seen
from casacal.errors import CasacalError
from casacal.least_squares.linalg import posterior_covariance
from casacal.uncertainty.extra_touches import EXTRA_TOUCHES, Known, Touches
from casacal.uncertainty.identifiability import NullDirection, WeakDirection, prior_scale
from casacal.uncertainty.offers import offers
from casacal.uncertainty.workspace import tip_stds, without_rigid, workspace_joints

GAIN = 0.95
"""Expected tip error over that without a cure, above which it is not worth recommending."""
SETTLES = 0.5
"""Part of a direction's standard deviation below which a cure settles it."""
LOWERS = 0.95
"""The same below which a cure helps at all."""
MOST_TILT = math.radians(85.0)
"""Tilt of a plunger that hardly touches a face: such an arm is not understood."""
NO_CURE = "none that was tried lowers it; rely on the prior"


@dataclass(frozen=True, eq=False)
class Cure:
    """Something to do next, and the tip error to expect after it."""

    words: str
    touches: int
    expected_rms_mm: float
    """Over the workspace, apart from where the base stands."""
    recommended: bool
    """Whether it gains more than a few per cent, over as many touches of the same kind too."""
    covariance: Array
    """Of the unknowns that the samples share (s, s), after it."""


def cures(bound: BoundProblem, x: Array) -> tuple[Cure, ...]:
    """What to do next at x (n,), best first, each from 24 extra touches.

    More of the same; more tilt; another face at right angles; a plate that stands alone, inclined; a known length; half
    the noise. What this arm cannot reach is left out. An instrument that touches no faces has two: more of the same,
    and half the noise.
    """
    if not (x.size and np.isfinite(x).all()):
        return ()
    arm, at = seen(bound, x)
    joints = workspace_joints(bound.problem.robot)
    tips, told = arm.tips(at, joints), arm.information(at)
    field = without_rigid(arm.tip_jacobian(at, joints), tips)

    def judged(information: Array, prior_std: Array) -> tuple[float, Array]:
        covariance = posterior_covariance(information, prior_std)[: at.size, : at.size]  # what comes last moves no tip
        return math.sqrt(float((tip_stds(covariance, field) ** 2).sum(axis=1).mean())), covariance

    found: dict[str, tuple[float, Array, str]] = {}
    for kind, words, information, prior_std in _outcomes(bound, arm, x, told):
        if np.isfinite(information).all():
            error, covariance = judged(information, prior_std)
            if kind not in found or error < found[kind][0]:  # of the same at several places, the best
                found[kind] = error, covariance, words
    now, _ = judged(told, arm.prior_std)
    same = min(now, found["same"][0]) if "same" in found else now
    made = [
        Cure(words, EXTRA_TOUCHES, error, error < GAIN * (now if kind == "same" else same), covariance)
        for kind, (error, covariance, words) in found.items()
    ]
    return tuple(sorted(made, key=lambda cure: cure.expected_rms_mm))


def cure_for(bound: Seen, now: Array, found: Sequence[Cure], direction: NullDirection | WeakDirection) -> str:
    """What lowers the spread along a direction, in words: the best cure that settles it, else the one that helps most.

    Args:
        bound: the problem whose direction it is.
        now: covariance of its unknowns (s, s).
        found: from `cures`, best first.
        direction: in units of `prior_scale`.

    """
    along = np.where(bound.datum, 0.0, direction.direction) / np.linalg.norm(direction.direction)
    if not along.any():
        return "none needed"
    along = along / prior_scale(bound)
    before = _spread(now, along)
    left = [(cure, _ratio(_spread(cure.covariance, along), before)) for cure in found]
    for cure, part in sorted(left, key=lambda each: not each[0].recommended):
        if part < SETTLES:
            return cure.words
    best = min(left, key=lambda each: each[1], default=None)
    return NO_CURE if best is None or best[1] > LOWERS else f"{best[0].words} (in part)"


def _outcomes(bound: BoundProblem, arm: Seen, x: Array, told: Array) -> Iterator[tuple[str, str, Array, Array]]:
    """Kind, words, information (m, m) and prior (m,) after each cure.

    The first unknowns are those of `arm`, of which the samples told (s, s).
    """
    touches = _touches(bound, x)
    if len(bound.samples) > 1:
        yield from _more_of_each(bound, x, told)
        return
    if touches is None:
        more = EXTRA_TOUCHES / len(bound.samples[0])
        yield "same", f"{EXTRA_TOUCHES} more samples of the same kind", (1 + more) * told, arm.prior_std
        yield "noise", f"{EXTRA_TOUCHES} samples with half the noise", (1 + 4 * more) * told, arm.prior_std
        return
    known = Known.of(bound, x, told, touches.labels)
    for offer in offers(bound, touches):
        if (rows := touches.on(offer.cell)) is None:
            continue
        try:
            information, prior_std = known.plus(offer.problem, offer.cell, rows, offer.noise)
        except CasacalError:  # such as a plunger that would lie in the face
            continue
        yield offer.kind, offer.words, information, prior_std


def _more_of_each(bound: BoundProblem, x: Array, told: Array) -> Iterator[tuple[str, str, Array, Array]]:
    """More of what each of several instruments has measured: as much as its rows tell of the shared unknowns now."""
    for i, name in enumerate(bound.problem.names):
        others = np.flatnonzero(bound.measured.instruments != i)
        arm, at = seen(bound.take(others), x)
        more = EXTRA_TOUCHES / max(len(bound.samples[i]), 1)
        words = f"{EXTRA_TOUCHES} more samples of the {name}"
        yield f"same as {name}", words, told + more * (told - arm.information(at)), arm.prior_std


def _touches(bound: BoundProblem, x: Array) -> Touches | None:
    """The arm before its faces; None where no such thing can be said."""
    try:
        touches = Touches.of(bound, x)
    except CasacalError:
        return None
    return touches if touches is not None and touches.tilt < MOST_TILT else None


def _spread(covariance: Array, along: Array) -> float:
    """Standard deviation of a combination (s,) of unknowns, some of which may be unbounded."""
    lost = ~np.isfinite(np.diagonal(covariance))
    if along[lost].any():
        return float("inf")
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    return math.sqrt(max(float(along @ held @ along), 0.0))


def _ratio(after: float, before: float) -> float:
    return 1.0 if not np.isfinite(after) or before == 0 else after / before

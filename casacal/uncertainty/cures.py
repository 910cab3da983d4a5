"""What to do next, best first: extra touches, simulated, put on top of the samples there are, and judged at the tip.

Every figure is worked out at the estimate, as the tip error to expect is: the arm as calibrated touches its faces as
they were found, and the linearised touches are added to what the samples know, everything free.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.marginal import Seen, seen
from casacal.least_squares.linalg import posterior_covariance
from casacal.uncertainty.bounds import bayesian_bound
from casacal.uncertainty.expectation import expected_accuracy
from casacal.uncertainty.extra_touches import EXTRA_TOUCHES, Known, Touches
from casacal.uncertainty.identifiability import NullDirection, WeakDirection, prior_scale
from casacal.uncertainty.offers import offers
from casacal.uncertainty.workspace import workspace_joints

GAIN = 0.95
"""Expected tip error over that without a cure, above which it is not worth recommending."""
SETTLES = 0.5
"""Part of a direction's standard deviation below which a cure settles it."""
LOWERS = 0.95
"""The same below which a cure helps at all."""
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
    if not np.isfinite(x).all():
        return ()
    arm, at = seen(bound, x)
    joints = workspace_joints(bound.problem.robot)
    tips, slopes = arm.tips(at, joints), arm.tip_jacobian(at, joints)
    found: dict[str, tuple[str, float, Array]] = {}
    for kind, words, information, prior_std in _outcomes(bound, arm, x, at):
        if not np.isfinite(information).all():
            continue
        widened = np.hstack([slopes, np.zeros((len(slopes), len(prior_std) - at.size))])
        error = bayesian_bound(information, prior_std, widened, tips)
        if kind not in found or error < found[kind][1]:  # of the same at several places, the best
            covariance = posterior_covariance(information, prior_std)[: at.size, : at.size]
            found[kind] = (words, error, covariance)
    now = expected_accuracy(arm, at)[1]
    same = found["same"][1] if "same" in found else now
    made = [
        Cure(words, EXTRA_TOUCHES, error, error < GAIN * (now if kind == "same" else min(now, same)), covariance)
        for kind, (words, error, covariance) in found.items()
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
    cure, part = min(left, key=lambda each: each[1], default=(None, 1.0))
    return NO_CURE if cure is None or part > LOWERS else f"{cure.words} (in part)"


def _outcomes(bound: BoundProblem, arm: Seen, x: Array, at: Array) -> Iterator[tuple[str, str, Array, Array]]:
    """Kind, words, information (m, m) and prior (m,) after each cure; the first unknowns are those of `arm`."""
    touches = Touches.of(bound, x)
    if touches is None:
        told, more = arm.information(at), EXTRA_TOUCHES / len(bound.samples[0])
        yield "same", f"{EXTRA_TOUCHES} more samples of the same kind", (1 + more) * told, arm.prior_std
        words = f"{EXTRA_TOUCHES} samples with half the noise"
        yield "noise", words, (1 + 4 * more) * told, arm.prior_std
        return
    known = Known.of(bound, arm, x, at, [face.label for face in touches.faces])
    for offer in offers(bound, touches):
        rows = touches.on(offer.cell)
        if rows is not None:
            information, prior_std = known.plus(offer.problem, rows, offer.noise)
            yield offer.kind, offer.words, information, prior_std


def _spread(covariance: Array, along: Array) -> float:
    """Standard deviation of a combination (s,) of unknowns, some of which may be unbounded."""
    lost = ~np.isfinite(np.diagonal(covariance))
    if along[lost].any():
        return float("inf")
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    return float(np.sqrt(max(along @ held @ along, 0.0)))


def _ratio(after: float, before: float) -> float:
    return 1.0 if not np.isfinite(after) or before == 0 else after / before

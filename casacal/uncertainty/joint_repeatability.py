"""What joints do not repeat: errors of single touches that grow with how much a touch sees of the joints.

Nothing in the samples repeats it, so that it is noise; but a touch far from the base has more of it than one close by.
Its variance, t^2 g^2 with g the standard deviation of the residual where every joint errs by one radian, stands beside
what was stated of the instrument. How much of the noise it is, is found by restricted likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import OTHERS, REPEATABILITY, by_face, of_repeats
from casacal.least_squares.linalg import posterior_covariance
from casacal.uncertainty.marginal_likelihood import Told

EXPECTED = 15e-6
"""What joints of an industrial arm do not repeat, rad; 15 to 30 urad are usual, some 0.05 mm at the tip."""

DOUBT = 2.5
"""Times by which that may well be off."""

KNOWN = 1.3
"""Times by which the rest of the noise may well exceed what was stated, where the joints explain the noise."""

PARTS = (0.5, 0.8, 1.0, 1.2)
"""Parts of the noise beyond what was stated that are tried as the joints'; with weights of its own it may be more."""

WORTH_A_LOOK = 1.0
"""Standard deviations by which touches that see more of the joints must err more, for more to be tried."""

WORTH = 2.0
"""Gain in the logarithm of the likelihood from which noise that is alike for all rows is put down to the joints."""

SMALLEST = 1e-3
"""Part of a row's variance that its own residual must hold to be judged by it."""

MOST_ROWS = 4096
"""Rows, evenly over all, at which is looked whether more should be tried."""


def joints_err(bound: BoundProblem, x: Array, told: Told) -> bool:
    """Whether rows that see more of the joints may err more than others where a fit stands.

    A score test of the variance: squares of what is left, over what is expected of them, against g^2 / noise^2.

    Args:
        bound: with effects at their sizes, x0 zero.
        x: where the rows were linearised (n,).
        told: what they say there.

    """
    held = posterior_covariance(told.information, bound.prior_std)
    if not np.isfinite(held).all():  # something that neither rows nor prior hold: what is left of a row is not known
        return False
    step = held @ told.toward - x
    count = len(bound.measured)
    few = np.unique(np.linspace(0, count - 1, min(count, MOST_ROWS)).astype(np.intp))
    part = bound if few.size == count else bound.take(few)
    jacobian = part.jacobian(x)
    free = 1.0 - np.einsum("ij,ij->i", jacobian @ held, jacobian)
    seen = (part.joint_noise / part.noise) ** 2
    judged = free > SMALLEST
    if not judged.any():
        return False
    squares = (part.residual(x) + jacobian @ step)[judged] ** 2 / free[judged]
    apart = seen[judged] - seen[judged].mean()
    spread = math.sqrt(2 * float(apart @ apart))
    return spread > 0 and float(apart @ squares) > WORTH_A_LOOK * float(squares.mean()) * spread


def with_joints(whole: BoundProblem, found: BoundProblem) -> Iterator[BoundProblem]:
    """The rows with parts of the noise, as it was found beyond what was stated, put down to the joints."""
    seen, scale = whole.joint_noise, found.scale
    shared = of_repeats(scale)
    level, own = (float((each.noise**2).mean()) for each in (found, found.with_noise(shared)))
    if not (level > own and np.isfinite(seen).all() and (seen > 0).any()):
        return
    for part in PARTS:
        joints = part * (level - own)
        size = math.sqrt(joints / float((seen**2).mean()))
        yield whole.with_noise({OTHERS: math.sqrt(max(level - joints, own) / own), REPEATABILITY: size, **shared})


def repeats_to(bound: BoundProblem) -> float:
    """What joints do not repeat, as it was found, rad; zero where it was not told from other noise."""
    return bound.scale.get(REPEATABILITY, 0.0)


def is_usual(bound: BoundProblem, most: float) -> bool:
    """Whether what joints of any arm do not repeat explains the noise, but for at most some times what was stated."""
    return 0 < repeats_to(bound) <= EXPECTED * DOUBT and max(by_face(bound.scale).values(), default=1.0) <= most


def beforehand(bound: BoundProblem) -> float:
    """Logarithm of how likely such noise is before any row is seen, against what is expected of it: log-normal."""
    joints = math.log(repeats_to(bound) / EXPECTED) / math.log(DOUBT)
    rest = math.log(max(by_face(bound.scale).values(), default=1.0)) / math.log(KNOWN)
    return -(joints**2 + rest**2) / 2

"""What repeats and single touches say of the noise: pure error, and what the joints do not repeat."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import OTHERS, REPEATABILITY, BoundProblem, by_face, of_repeats
from casacal.least_squares.linalg import posterior_covariance
from casacal.least_squares.result import Result
from casacal.samples.repeats import Repeats
from casacal.uncertainty.effect_sizes import NormalEquations
from casacal.uncertainty.figures import effective_unknowns, ratio_interval

LACKING = 0.01
"""Chance of so large an F below which repeats are taken to share an error that the model does not describe."""

EXACT = 1e-18  # variance of repeats over that between places, below which they do not scatter at all: rounding


@dataclass(frozen=True)
class PureError:
    """What repeated touches say of the noise; all ratios are over what was stated."""

    places: int
    """Postures that were touched more than once."""
    ratio: float
    """Scatter of repeats about their mean."""
    low: float
    high: float
    """Its 95 % interval."""
    f: float
    """Mean square between postures, after the fit, over that within them."""
    chance: float
    """Chance of so large an F where the model describes all but the scatter of repeats."""
    shared: float
    """Part of the variance of a touch that its repeats share; zero where F is no surprise."""


def repeats_in(bound: BoundProblem) -> Repeats:
    """Which whitened rows repeat one another, component by component of the residual."""
    again = bound.repeats
    width = int(bound.components.max(initial=1))
    sizes = np.zeros((len(again.sizes), width), dtype=np.intp)
    np.add.at(sizes, (again.codes[bound.sample_of], bound.component_of), 1)
    there = np.cumsum((sizes > 0).ravel()) - 1  # samples of one instrument may have fewer components than another's
    codes = there[again.codes[bound.sample_of] * width + bound.component_of]
    return Repeats(codes, sizes[sizes > 0])


def pure_error(result: Result, again: Repeats) -> PureError | None:
    """Pure error and lack of fit at a result; None where nothing was touched twice, or read the same, or all is one.

    Residuals within a group differ by pure error alone; between groups there is also what the model leaves out, a
    random effect of variance t^2 shared by a group: E[between] = s^2 + k t^2, k the groups' mean size (Searle 1971).
    """
    from scipy.special import fdtrc

    bound = result.problem
    assert isinstance(bound, BoundProblem)
    if not again.any or len(again.sizes) < 2:
        return None
    scale = bound.scale
    of_a_touch = bound.residual(result.x) * bound.noise_factors(scale)
    faces = bound.noise_factors(by_face(scale))
    r = of_a_touch / faces
    mean = again.summed(r) / again.sizes
    within, freedom = float(((r - mean[again.codes]) ** 2).sum()), float(len(r) - len(mean))
    left = max(len(mean) - effective_unknowns(bound, result.x), 1.0)
    between = float((again.sizes * mean**2).sum()) / left
    noise = within / freedom
    if not noise > EXACT * between:  # copies, which tell nothing of scatter
        return None
    f = between / noise
    chance = float(fdtrc(left, freedom, f))
    size = (len(r) - float((again.sizes**2).sum()) / len(r)) / max(len(mean) - 1, 1)
    effect = max(between - noise, 0.0) / size
    shared = effect / (effect + noise) if chance < LACKING and effect > 0 else 0.0
    total = float(((of_a_touch - (again.summed(of_a_touch) / again.sizes)[again.codes]) ** 2).sum())
    ratio, low, high = ratio_interval(total, freedom)
    return PureError(int((bound.repeats.sizes > 1).sum()), ratio, low, high, f, chance, shared)


EXPECTED = 15e-6
"""What joints of an industrial arm do not repeat, rad; 15 to 30 urad are usual, some 0.05 mm at the tip."""

DOUBT = 2.5  # times by which that may well be off
KNOWN = 1.3  # times by which the rest of the noise may well exceed what was stated, where the joints explain the noise

PARTS = (0.5, 0.8, 1.0, 1.2)
"""Parts of the noise beyond what was stated that are tried as the joints'; with weights of its own it may be more."""

WORTH_A_LOOK = 1.0
"""Standard deviations by which touches that see more of the joints must err more, for more to be tried."""

WORTH = 2.0
"""Gain in the logarithm of the likelihood from which noise that is alike for all rows is put down to the joints."""

SMALLEST = 1e-3  # part of a row's variance that its own residual must hold to be judged by it
MOST_ROWS = 4096  # rows, evenly over all, at which is looked whether more should be tried


def joints_err(bound: BoundProblem, x: Array, told: NormalEquations) -> bool:
    """Whether rows that see more of the joints may err more than others where a fit stands.

    A score test of the variance: squares of what is left, over what is expected of them, against g^2 / noise^2. bound:
    with effects at their sizes. told: what its rows say at x (n,), where they were linearised.
    """
    held = posterior_covariance(told.information, bound.prior_information)
    if not np.isfinite(held).all():  # something that neither rows nor prior hold: what is left of a row is not known
        return False
    step = held @ told.toward - (x - bound.x0)
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

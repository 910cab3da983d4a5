"""Pure error from repeated touches, and whether the fit misses more than it explains: the F test for lack of fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import by_face, factors
from casacal.least_squares.result import Result
from casacal.samples.repeats import Repeats
from casacal.uncertainty.figures import ratio_interval
from casacal.uncertainty.leverage import effective_unknowns

LACKING = 0.01
"""Chance of so large an F below which repeats are taken to share an error that the model does not describe."""

EXACT = 1e-18
"""Variance of repeats over that between places, below which they do not scatter at all: rounding."""


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
    """Pure error and lack of fit at a result; None where nothing was touched twice, or read the same each time.

    Residuals within a group differ by pure error alone; between groups there is also what the model leaves out, a
    random effect of variance t^2 shared by a group: E[between] = s^2 + k t^2, k the groups' mean size (Searle 1971).
    """
    from scipy.special import fdtrc

    bound = result.problem
    assert isinstance(bound, BoundProblem)
    if not again.any:
        return None
    scale = bound.scale
    of_a_touch = bound.residual(result.x) * factors(bound, scale)
    faces = factors(bound, by_face(scale))
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


def condensed(result: Result, again: Repeats) -> tuple[Array, float]:
    """Whitened residuals, one of each group of repeats, and their degrees of freedom."""
    problem = result.problem
    assert isinstance(problem, BoundProblem)
    free = max(len(again.sizes) - effective_unknowns(problem, result.x), 1.0)
    return again.condensed(problem.residual(result.x)), free

"""Pure error from repeated touches, and whether the fit misses more than it explains: the F test for lack of fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import by_face, factors
from casacal.least_squares.result import Result
from casacal.samples.repeats import Repeats, repeats_of
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
    samples = bound.block.samples
    again = repeats_of(samples, bound.problem.instrument.groups)
    per_row = bound.rows // len(samples)
    codes = (again.codes[:, None] * per_row + np.arange(per_row)).ravel()
    return Repeats(codes, np.repeat(again.sizes, per_row))


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
    column, samples, per_row = (
        bound.problem.instrument.groups,
        bound.block.samples,
        bound.rows // len(bound.block.samples),
    )
    plain = by_face(scale)
    of_a_touch = bound.residual(result.x) * np.repeat(factors(samples, column, scale), per_row)
    faces = np.repeat(factors(samples, column, plain), per_row)
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
    return PureError(int((again.sizes > 1).sum()) // per_row, ratio, low, high, f, chance, shared)


def condensed(result: Result, again: Repeats) -> tuple[Array, float]:
    """Whitened residuals, one of each group of repeats, and their degrees of freedom."""
    problem = result.problem
    assert isinstance(problem, BoundProblem)
    free = max(len(again.sizes) - effective_unknowns(problem, result.x), 1.0)
    return again.condensed(problem.residual(result.x)), free

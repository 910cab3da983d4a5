"""How many touches a calibration is worth: what a tolerance takes, or as many as tell more than averaged noise."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from casacal.array_types import Array
from casacal.errors import CasacalError, came
from casacal.planning.choice import Choice, pool_of, refuse_several, wanted_joints
from casacal.planning.plan import bound_pool
from casacal.planning.route import touches_needed
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.cell import Disturbances
from casacal.uncertainty.expectation import Box
from casacal.values import is_real

POOL = 1000  # touches among which is chosen
SPARE = 1.5  # times as many as there must be, so that rows also tell the noise and single bad ones show
AVERAGED = 0.8  # error over that of two thirds as many, from which little but noise is averaged: sqrt(2/3) = 0.82
ON_TOP = 24  # touches that are made on top of others at least: a quarter of an hour of work
MOST = 120  # touches to be fitted that nobody is told to make unasked


def touches_for(
    problem: Problem,
    cell: Disturbances | None = None,
    tolerance: float | None = None,
    *,
    box: Box | None = None,
    targets: Array | None = None,
    after: Samples | None = None,
    loose: Mapping[str, float] | None = None,
    most: int = 240,
) -> int:
    """About the fewest touches to be fitted that bring the expected tip error below a tolerance, mm RMS.

    Without a tolerance, as many as tell more than the noise of the others averaged: where noise alone is left, half as
    many again leave sqrt(2/3) of the error. Then never fewer than half as many again as `calibrate` takes at least,
    and, unless that is more, at most 120.

    box, targets, after, loose: as for `plan`. Raises CasacalError where so many as `most` miss the tolerance.
    """
    refuse_several(problem, "A plan is for one instrument", "Plan for", box, targets)
    if tolerance is not None and not (is_real(tolerance) and 0 < tolerance < math.inf):
        shown = f"{tolerance:g}" if is_real(tolerance) else came(tolerance)
        raise CasacalError(f"Got {shown} as the tolerance", "Give a positive number of mm")
    pool = pool_of(problem, cell, POOL, 0)
    bound = bound_pool(problem, pool, after, loose)
    choice = Choice.of(bound, wanted_joints(bound, box, targets), count=len(pool), loose=loose)
    rng = np.random.default_rng(0)
    if tolerance is None:  # from the least on, until more of them only average noise
        count = ON_TOP if after is not None else math.ceil(SPARE * touches_needed(problem, pool))
        left = choice.error(choice.best_of(count, 1, rng))
        while count < MOST:
            more = min(math.ceil(count * 1.5), MOST)
            then = choice.error(choice.best_of(more, 1, rng))
            if then > AVERAGED * left:
                break
            count, left = more, then
        return count
    count = 3 if after is not None else 12
    while count < most:
        if choice.error(choice.best_of(count, 1, rng)) <= tolerance:
            return count
        count = min(max(math.ceil(count * 1.25), count + 1), most)
    left = choice.error(choice.best_of(most, 1, rng))
    if left > tolerance:
        what = f"{most} best touches leave {left:.3g} mm, more than {tolerance:g} mm"
        raise CasacalError(what, "Ask for less, measure with less noise, or add a face, a step or another instrument")
    return most

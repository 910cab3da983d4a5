"""Levenberg-Marquardt on the joint step, damped in the prior's metric (M6).

Minimises f(x) = 1/2 |r(x)|^2 + 1/2 |(x - x0) / s|^2. In prior-scaled coordinates (`start_std` where the prior is flat)
each step solves (H + mu I) step = -g with H = J'J + Lambda. Scaling flat unknowns by their columns (More 1978) instead
would damp directions that only the prior holds, such as a shift of arm and planes together, a million times more than
the others.

This is the corrected form of eqs (27)-(29) of arXiv:2208.02652: minus sign (E14), one joint step (E15), unit normals
(E16), gain-ratio damping (E13).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares, Normal
from casacal.least_squares.result import Result, Status

Array: TypeAlias = NDArray[np.float64]

FASTEST_DECREASE = 1 / 3
"""Largest fall of the damping in one step: Nielsen, Damping parameter in Marquardt's method, 1999, eq (2.16)."""

UNSEEN = 1e-9
"""A fall of the log posterior below this part of (1 + cost) cannot be told from rounding."""

STUCK_DAMPING = 1e20


class Point(NamedTuple):
    """A place on the way: x, the data's normal equations there, and the whole objective."""

    x: Array
    normal: Normal
    cost: float


def lm(
    problem: LeastSquares,
    *,
    start: Array | None = None,
    max_steps: int = 100,
    tolerance: float = 1e-9,
    damping: float = 1e-3,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Minimise f by damped Gauss-Newton steps in all unknowns at once.

    Args:
        problem: what to minimise.
        start: first x (n,); default the prior's mean x0.
        max_steps: steps tried at most.
        tolerance: stop when the step, in posterior standard deviations, sqrt(step' H step), falls below it.
        damping: first mu.
        loss: what replaces r^2 / 2 in f, such as `huber()`; the covariance then counts rows by their weights.
        progress: called with (step, cost) after each accepted step.

    """
    here = _point(problem, np.array(problem.x0 if start is None else start, dtype=np.float64), loss)
    mu, growth, tried, evaluations, last_unseen, last_length = damping, 2.0, 0, 1, math.inf, 0.0
    trace = [(here.cost, mu, math.nan, math.nan)]
    status = Status.MAX_STEPS if math.isfinite(here.cost) else Status.NOT_FINITE
    while status is Status.MAX_STEPS and tried < max_steps:
        step = problem.damped_step(here.x, here.normal, mu)
        if step is None:
            mu, growth = mu * growth, growth * 2
            continue
        length = math.sqrt(max(step.squared_length, 0.0))
        # so near the minimum the cost differs by rounding alone: the step is judged by its length instead
        hidden = step.predicted <= UNSEEN * (1 + here.cost)
        if hidden and length**2 <= tolerance * last_length:
            # steps shrink at least in proportion, so the next would be negligible: this one needs no look from its end
            here, tried, status = here._replace(x=step.x), tried + 1, Status.CONVERGED
            trace.append((here.cost, mu, 1.0, length))
            break
        there, tried = _point(problem, step.x, loss), tried + 1
        evaluations += 1
        unseen = math.isfinite(there.cost) and hidden
        usable = math.isfinite(there.cost) and step.predicted > 0
        gain = (here.cost - there.cost) / step.predicted if usable else -math.inf
        if gain > 0 or unseen:
            here = there
            status = _ended(length, tolerance, last_unseen if unseen else math.inf)
            last_unseen = length if unseen else math.inf
            last_length = length
            mu *= FASTEST_DECREASE if unseen else max(FASTEST_DECREASE, 1 - (2 * gain - 1) ** 3)
            growth = 2.0
            if progress is not None:
                progress(tried, here.cost)
        else:
            mu, growth = mu * growth, growth * 2
            status = Status.STUCK if mu > STUCK_DAMPING else status
        trace.append((here.cost, mu, gain, length))
    return _result(problem, here, status, trace, tried, evaluations, loss)


def _result(
    problem: LeastSquares,
    here: Point,
    status: Status,
    trace: list[tuple[float, float, float, float]],
    tried: int,
    evaluations: int,
    loss: Loss | None,
) -> Result:
    return Result(
        method="lm",
        problem=problem,
        x=here.x,
        information=here.normal.information,
        status=status,
        trace=dict(zip(("cost", "damping", "gain_ratio", "step"), np.array(trace).T, strict=True)),
        steps=tried,
        residual_rows=evaluations * problem.rows,
        jacobian_rows=evaluations * problem.rows,
        loss=loss,
    )


def _point(problem: LeastSquares, x: Array, loss: Loss | None) -> Point:
    normal = problem.normal(x, loss)
    return Point(x, normal, normal.cost + problem.prior_cost(x))


def _ended(length: float, tolerance: float, last_unseen: float) -> Status:
    """Whether a step of this length ends the search; steps below the cost's rounding must keep shrinking."""
    if length <= tolerance:
        return Status.CONVERGED
    return Status.PRECISION if length > last_unseen / 2 and last_unseen < math.inf else Status.MAX_STEPS

"""Levenberg-Marquardt on the joint step, damped in the prior's metric (M6).

Minimises f(x) = 1/2 |r(x)|^2 + 1/2 |(x - x0) / s|^2. In prior-scaled coordinates (`start_std` where the prior is flat)
each step solves (H + mu I) step = -g with H = J'J + Lambda. Scaling flat unknowns by their columns (More 1978) instead
would damp directions that only the prior holds, such as a shift of arm and planes together, a million times more than
the others.

This is the corrected form of eqs (25)-(29) of arXiv:2208.02652: minus sign (E14), one joint step (E15), unit normals
(E16), gain-ratio damping (E13). What the paper leaves open is decided in `lm_decisions`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from casacal.array_types import Array
from casacal.estimators.lm_decisions import Damping, Point, Shortest, acceptable, gain_ratio, given_up, next_move
from casacal.estimators.nominal import nothing_unknown
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result, Status

MAX_STEPS = 1000  # enough for the longest curved valleys of NIST's regressions; an arm needs five


def lm(
    problem: LeastSquares,
    *,
    start: Array | None = None,
    max_steps: int = MAX_STEPS,
    tolerance: float = 1e-9,
    damping: float = 1e-3,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Minimise f by damped Gauss-Newton steps in all unknowns at once; ends on any input, after `max_steps` at most.

    Args:
        start: first x (n,); default the prior's mean x0, or the minimum of the loss after which this one comes.
        max_steps: steps tried at most.
        tolerance: stop when the undamped step, in posterior standard deviations, sqrt(step' H step), falls below it.
        damping: first mu.
        loss: what replaces r^2 / 2 in f, such as `huber()`; the covariance then counts rows by their weights.
        progress: called with (step, cost) after each accepted step.

    The trace holds the objective after each step.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "lm")
    if start is None and loss is not None and loss.after is not None:
        start = lm(problem, max_steps=max_steps, loss=loss.after).x
    with np.errstate(over="ignore", invalid="ignore"):  # a status says what is not finite
        here = _point(problem, np.array(problem.x0 if start is None else start, dtype=np.float64), loss)
        level, last, shortest, tried, evaluations = Damping(damping), None, Shortest(), 0, 1
        trace = [(here.cost, level.mu, math.nan, math.nan)]
        status = None if here.usable else Status.NOT_FINITE
        while status is None and tried < max_steps:
            move, tried = next_move(problem, here, level, last, loss), tried + 1
            if move is None:
                level, ratio, length = level.rejected(), math.nan, math.nan
                status = Status.STUCK if level.stuck else None
            elif move.negligible(last, tolerance):
                here, ratio, length, status = here._replace(x=move.step.x), 1.0, move.length, Status.CONVERGED
            else:
                shortest = shortest.after(move, here)
                there, evaluations = _point(problem, move.step.x, loss), evaluations + 1
                ratio, length = gain_ratio(here, there, move.step), move.length
                if acceptable(move, there, ratio):
                    here, level, last = there, level.accepted(1.0 if move.hidden else ratio), move
                    if progress is not None:
                        progress(tried, here.cost)
                    if move.hidden and shortest.last is not None:
                        here, status = shortest.last, Status.PRECISION
                else:
                    level, status = level.rejected(), given_up(move, here, shortest)
            trace.append((here.cost, level.mu, ratio, length))
    return Result(
        method="lm",
        problem=problem,
        x=here.x,
        information=here.normal.information,
        status=status or Status.MAX_STEPS,
        trace=dict(zip(("cost", "damping", "gain_ratio", "step"), np.array(trace).T, strict=True)),
        steps=tried,
        residual_rows=evaluations * problem.rows,
        jacobian_rows=evaluations * problem.rows,
        loss=loss,
    )


def _point(problem: LeastSquares, x: Array, loss: Loss | None) -> Point:
    normal = problem.normal(x, loss)
    return Point(x, normal, normal.cost + problem.prior_cost(x))

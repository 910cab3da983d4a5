"""Levenberg-Marquardt on the joint step, damped in the prior's metric (M6).

Minimises f(x) = 1/2 |r(x)|^2 + 1/2 |(x - x0) / s|^2. In prior-scaled coordinates (`start_std` where the prior is flat)
each step solves (H + mu I) step = -g with H = J'J + Lambda. Scaling flat unknowns by their columns (More 1978) instead
would damp directions that only the prior holds, such as a shift of arm and planes together, a million times more than
the others.

This is the corrected form of eqs (25)-(29) of arXiv:2208.02652: minus sign (E14), one joint step (E15), unit normals
(E16), gain-ratio damping (E13). Three decisions that the paper does not take stand here by name: how to damp
(`Damping`), whether to accept (`gain_ratio`, `acceptable`), when to stop (`Move.negligible`, `stop`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from casacal.array_types import Array
from casacal.estimators.nominal import nothing_unknown
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares, Normal, Step
from casacal.least_squares.result import Result, Status

FASTEST_DECREASE = 1 / 3
"""Largest fall of the damping in one step: Nielsen, Damping parameter in Marquardt's method, 1999, eq (2.16)."""

UNSEEN = 1e-9
"""A fall of the log posterior below this part of (1 + cost) cannot be told from rounding."""

STUCK_DAMPING = 1e20
"""Damping beyond which no step is long enough to be seen."""


@dataclass(frozen=True)
class Damping:
    """How to damp: mu, the constant lambda of eqs (25)-(29), here led by the gain ratio (E13; Nielsen 1999)."""

    mu: float
    growth: float = 2.0
    """What the next rejected step multiplies mu by: Nielsen's nu."""

    def accepted(self, ratio: float) -> Damping:
        """After a step with this gain ratio: a third where the model was right, up to double where it was not."""
        return Damping(self.mu * max(FASTEST_DECREASE, 1 - (2 * ratio - 1) ** 3))

    def rejected(self) -> Damping:
        """After a step that was not taken: more, and more each time."""
        return Damping(self.mu * self.growth, self.growth * 2)

    @property
    def stuck(self) -> bool:
        """Whether there is nothing left to try."""
        return self.mu > STUCK_DAMPING


class Point(NamedTuple):
    """A place on the way: x, the data's normal equations there, and the whole objective."""

    x: Array
    normal: Normal
    cost: float

    @property
    def sloped(self) -> bool:
        """Whether its derivatives are finite, so that steps can start here."""
        return bool(np.isfinite(self.normal.gradient).all() and np.isfinite(self.normal.information).all())


class Move(NamedTuple):
    """A step by its length in posterior standard deviations, sqrt(step' H step), and whether its fall is hidden.

    So near the minimum the cost differs by rounding alone: a hidden step is judged by its length instead.
    """

    length: float
    hidden: bool

    @staticmethod
    def of(step: Step, here: Point) -> Move:
        """The move that a step from a point makes."""
        return Move(math.sqrt(max(step.squared_length, 0.0)), step.predicted <= UNSEEN * (1 + here.cost))

    def negligible(self, last: Move | None, tolerance: float) -> bool:
        """Whether the next would be, as steps shrink at least in proportion: this one needs no look from its end."""
        return self.hidden and self.length**2 <= tolerance * (0.0 if last is None else last.length)


def gain_ratio(here: Point, there: Point, step: Step) -> float:
    """The fall of f over the fall that its quadratic model foretold (Nielsen 1999); -inf where either is no number."""
    if not (math.isfinite(there.cost) and step.predicted > 0):
        return -math.inf
    return (here.cost - there.cost) / step.predicted


def acceptable(move: Move, there: Point, ratio: float) -> bool:
    """Whether to accept: where f falls, or where its fall is hidden."""
    return ratio > 0 or (move.hidden and math.isfinite(there.cost))


def stop(move: Move, last: Move | None, tolerance: float) -> Status | None:
    """Whether an accepted step ends the search: it is short, or hidden steps no longer become shorter."""
    if move.length <= tolerance:
        return Status.CONVERGED
    stands = move.hidden and last is not None and last.hidden and move.length > last.length / 2
    return Status.PRECISION if stands else None


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
    """Minimise f by damped Gauss-Newton steps in all unknowns at once; ends on any input, after `max_steps` at most.

    Args:
        problem: what to minimise.
        start: first x (n,); default the prior's mean x0.
        max_steps: steps tried at most.
        tolerance: stop when the step, in posterior standard deviations, sqrt(step' H step), falls below it.
        damping: first mu.
        loss: what replaces r^2 / 2 in f, such as `huber()`; the covariance then counts rows by their weights.
        progress: called with (step, cost) after each accepted step.

    Returns:
        x (n,), deviations from nominal in the units of `problem.units`, its covariance (n, n), the objective after each
        step, and a status that says how it ended.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "lm")
    here = _point(problem, np.array(problem.x0 if start is None else start, dtype=np.float64), loss)
    level, last, tried, evaluations = Damping(damping), None, 0, 1
    trace = [(here.cost, level.mu, math.nan, math.nan)]
    status = None if math.isfinite(here.cost) else Status.NOT_FINITE
    while status is None and tried < max_steps:
        step, tried = problem.damped_step(here.x, here.normal, level.mu), tried + 1
        if step is None or not step.finite:
            level, ratio, length = level.rejected(), math.nan, math.nan
            status = Status.NOT_FINITE if not here.sloped else Status.STUCK if level.stuck else None
        elif (move := Move.of(step, here)).negligible(last, tolerance):
            here, ratio, length, status = here._replace(x=step.x), 1.0, move.length, Status.CONVERGED
        else:
            there, evaluations = _point(problem, step.x, loss), evaluations + 1
            ratio, length = gain_ratio(here, there, step), move.length
            if acceptable(move, there, ratio):
                here, level = there, level.accepted(1.0 if move.hidden else ratio)
                status, last = stop(move, last, tolerance), move
                if progress is not None:
                    progress(tried, here.cost)
            else:
                level = level.rejected()
                status = Status.STUCK if level.stuck else None
        trace.append((here.cost, level.mu, ratio, length))
    return _result(problem, here, status or Status.MAX_STEPS, trace, tried, evaluations, loss)


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

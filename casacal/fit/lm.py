"""Levenberg-Marquardt on the joint step, damped in the prior's metric (M6): its decisions, then its loop.

Minimises f(x) = 1/2 |r(x)|^2 + 1/2 |W (x - x0)|^2. In prior-scaled coordinates (`start_std` where the prior is flat)
each step solves (H + mu I) step = -g with H = J'J + Lambda. Scaling flat unknowns by their columns (More 1978) instead
would damp directions that only the prior holds, such as a shift of arm and planes together, a million times more.

This is the corrected form of eqs (25)-(29) of arXiv:2208.02652: minus sign (E14), one joint step (E15), unit normals
(E16), gain-ratio damping (E13). How to damp, which step to try, whether to accept it and when to stop the paper leaves
open. Lengths are in posterior standard deviations, sqrt(step' H step).

Damping shortens steps, so a short damped step proves nothing: only the undamped one tells how far the minimum is, and
near the minimum it is the one that is taken. Where the normal equations are no longer safe, steps come from singular
values, and directions that neither data nor prior hold are left alone.

Constraints hold at every x on the way (`LeastSquares.constrained_step`), also where the first does not meet them.

It stops where the undamped step falls below `tolerance` or its fall is lost in rounding after a step that converged
(`Move.negligible`); where undamped steps no longer shorten, at the shortest (`Shortest.last`); where no damping lowers
f (`Damping.stuck`, `given_up`); where f is not finite (`Point.usable`); and after `max_steps`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from casacal.fit.least_squares import DampedStep, LeastSquares, Normal, Result, Status, nothing_unknown
from casacal.kernels.losses import Loss
from casacal.values import Array

FASTEST_DECREASE = 1 / 3  # of the damping in a step: Nielsen, Damping parameter in Marquardt's method, 1999, eq (2.16)

ROUNDING = 1e-11
"""Part of (1 + f) below which a fall of f is lost in rounding: of metres in readings of 10 um, 1e-12 still is noise."""
SHORT = 0.1  # posterior standard deviations below which the undamped step is worth a look

CLOSE = 5.0  # posterior standard deviations of a step after which the next is often short: they shrink by their square

NEAR = 1e-3  # posterior standard deviations from the minimum that are as good as none, where rounding hides the rest

PATIENCE = 5  # undamped steps that may fail to be the shortest: rounding shortens none, slow convergence shortens each

STUCK_DAMPING = 1e50  # damping beyond which there is nothing left to try


@dataclass(frozen=True)
class Damping:
    """Damping mu, the constant lambda of eqs (25)-(29), here led by the gain ratio (E13; Nielsen 1999)."""

    mu: float
    growth: float = 2.0  # factor of mu at the next rejected step: Nielsen's nu

    def accepted(self, ratio: float) -> Damping:
        """After a step with this gain ratio: a third where the model was right, up to double where it was not."""
        return Damping(self.mu * max(FASTEST_DECREASE, 1 - (2 * ratio - 1) ** 3))

    def rejected(self) -> Damping:
        """After a rejected step: mu grows by `growth`, which doubles each time."""
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
    def usable(self) -> bool:
        """Whether cost and slopes are finite, so that steps can start here; what spoils a slope spoils the gradient."""
        return math.isfinite(self.cost) and math.isfinite(self.normal.gradient @ self.normal.gradient)


class Move(NamedTuple):
    """A step, whether it is undamped, and whether the fall it predicts is hidden by rounding.

    Its length is in posterior standard deviations, sqrt(step' H step); a hidden step is judged by that alone.
    """

    step: DampedStep
    undamped: bool
    hidden: bool

    @property
    def length(self) -> float:
        """Posterior standard deviations that it leads away."""
        return math.sqrt(max(self.step.squared_length, 0.0))

    def negligible(self, last: Move | None, tolerance: float) -> bool:
        """Whether it, or the next as steps shrink at least in proportion, is too short to need a look from its end."""
        if not self.undamped or self.length <= tolerance:
            return self.undamped
        return self.hidden and last is not None and last.undamped and self.length**2 <= tolerance * last.length


class Shortest(NamedTuple):
    """The shortest undamped step so far, where it began, and how many since then were no shorter."""

    length: float = math.inf
    at: Point | None = None
    since: int = 0

    def after(self, move: Move, here: Point) -> Shortest:
        """Record after one more move from `here`: the shortest move yet, or one more since."""
        if not move.undamped:
            return self
        return Shortest(move.length, here) if move.length < self.length else self._replace(since=self.since + 1)

    @property
    def last(self) -> Point | None:
        """Start of the shortest step, once `PATIENCE` steps show that rounding lets none be shorter."""
        return self.at if self.since >= PATIENCE else None


def gain_ratio(here: Point, there: Point, step: DampedStep) -> float:
    """The fall of f over the fall that its quadratic model foretold (Nielsen 1999); -inf where either is no number."""
    if not (there.usable and step.predicted > 0):
        return -math.inf
    return (here.cost - there.cost) / step.predicted


def acceptable(move: Move, there: Point, ratio: float) -> bool:
    """Whether to accept: where f falls, or where the step is undamped and its fall is hidden."""
    return ratio > 0 or (move.undamped and move.hidden and there.usable)


def given_up(move: Move, here: Point, shortest: Shortest) -> Status | None:
    """Status if a rejected step ends the search: its predicted fall is below the last digit of f; None otherwise."""
    if move.step.predicted > sys.float_info.epsilon * here.cost:
        return None
    return Status.PRECISION if shortest.length <= NEAR else Status.STUCK


def next_move(problem: LeastSquares, here: Point, level: Damping, last: Move | None, loss: Loss | None) -> Move | None:
    """The undamped step where that is short and none was just rejected, else the damped one; None without either."""
    eager = level.growth == Damping.growth
    near = last is not None and (last.undamped or last.length <= CLOSE)
    if eager and near and (move := _undamped(problem, here, loss)) is not None:
        return move
    damped = _step(problem, here, level.mu, loss)
    if damped is None:
        return None
    # no undamped step is shorter than a damped one
    short = not near and damped.squared_length <= SHORT**2
    if eager and short and (move := _undamped(problem, here, loss)) is not None:
        return move
    return Move(damped, False, _hidden(damped, here))


def _undamped(problem: LeastSquares, here: Point, loss: Loss | None) -> Move | None:
    """The undamped step, None unless it is short."""
    step = _step(problem, here, 0.0, loss)
    return None if step is None or step.squared_length > SHORT**2 else Move(step, True, _hidden(step, here))


def _hidden(step: DampedStep, here: Point) -> bool:
    return step.predicted <= ROUNDING * (1 + here.cost)


def _step(problem: LeastSquares, here: Point, damping: float, loss: Loss | None) -> DampedStep | None:
    """A damped step from normal equations where these are safe, else from singular values; None unless it is finite."""
    if problem.constraints is not None:
        return problem.constrained_step(here.x, here.normal, damping, loss)
    step = problem.damped_step(here.x, here.normal, damping)
    if step is None:
        step = problem.revealing_step(here.x, here.normal, damping, loss)
    return step if step is not None and step.finite else None


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
        first = problem.feasible(np.array(problem.x0 if start is None else start, dtype=np.float64))
        here = _point(problem, first, loss)
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

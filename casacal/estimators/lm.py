"""Levenberg-Marquardt on the joint step, damped in the prior's metric (M6)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.least_squares import LeastSquares, Normal
from casacal.linalg import damped_step, posterior_covariance
from casacal.result import Result, Status

Array: TypeAlias = NDArray[np.float64]

FASTEST_DECREASE = 1 / 3
"""Largest fall of the damping in one step: Nielsen, Damping parameter in Marquardt's method, 1999, eq (2.16)."""

UNSEEN = 1e-9
"""A fall of the log posterior below this part of (1 + cost) cannot be told from rounding."""

STUCK_DAMPING = 1e20


def lm(
    problem: LeastSquares,
    *,
    start: Array | None = None,
    max_steps: int = 100,
    tolerance: float = 1e-9,
    damping: float = 1e-3,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Minimise f(x) = 1/2 |r(x)|^2 + 1/2 |(x - x0) / s|^2 by damped Gauss-Newton steps in all unknowns at once.

    In prior-scaled coordinates (`start_std` where the prior is flat) each step solves (H + mu I) step = -g with
    H = J'J + Lambda. Scaling flat unknowns by their columns (More 1978) instead would damp directions that only the
    prior holds, such as a shift of arm and planes together, a million times more than the others.

    The corrected form of eqs (27)-(29) of arXiv:2208.02652: minus sign (E14), one joint step (E15), unit normals
    (E16), gain-ratio damping (E13).

    Args:
        problem: what to minimise.
        start: first x (n,); default the prior's mean x0.
        max_steps: evaluations of residual and Jacobian at most.
        tolerance: stop when the step, in posterior standard deviations, sqrt(step' H step), falls below it.
        damping: first mu.
        progress: called with (step, cost) after each accepted step.

    """
    x = np.array(problem.x0 if start is None else start, dtype=np.float64)
    normal = problem.normal(x)
    cost = normal.cost + problem.prior_cost(x)
    mu, growth, evaluations, last_unseen = damping, 2.0, 1, math.inf
    trace = [(cost, mu, math.nan, math.nan)]
    status = Status.MAX_STEPS if math.isfinite(cost) else Status.NOT_FINITE
    while status is Status.MAX_STEPS and evaluations <= max_steps:
        information, gradient = scaled_system(problem, normal, x)
        step = damped_step(information, gradient, mu)
        if step is None:
            mu, growth = mu * growth, growth * 2
            continue
        length = math.sqrt(float(step @ information @ step))
        trial = x + problem.start_std * step
        trial_normal = problem.normal(trial)
        evaluations += 1
        trial_cost = trial_normal.cost + problem.prior_cost(trial)
        predicted = float(step @ (mu * step - gradient)) / 2
        gain = (cost - trial_cost) / predicted if predicted > 0 and math.isfinite(trial_cost) else -math.inf
        # so near the minimum the cost differs by rounding alone: the step is judged by its length instead
        unseen = math.isfinite(trial_cost) and predicted <= UNSEEN * (1 + cost)
        if gain > 0 or unseen:
            x, normal, cost = trial, trial_normal, trial_cost
            mu *= FASTEST_DECREASE if unseen else max(FASTEST_DECREASE, 1 - (2 * gain - 1) ** 3)
            growth = 2.0
            if length <= tolerance:
                status = Status.CONVERGED
            elif unseen and length > last_unseen / 2:
                status = Status.PRECISION
            last_unseen = length if unseen else math.inf
            if progress is not None:
                progress(evaluations, cost)
        else:
            mu, growth = mu * growth, growth * 2
            if mu > STUCK_DAMPING:
                status = Status.STUCK
        trace.append((cost, mu, gain, length))
    columns = np.array(trace).T
    names = ("cost", "damping", "gain_ratio", "step")
    return Result(
        method="lm",
        problem=problem,
        x=x,
        covariance=posterior_covariance(normal.information, problem.prior_std),
        status=status,
        trace=dict(zip(names, columns, strict=True)),
        steps=evaluations - 1,
        residual_rows=evaluations * problem.rows,
        jacobian_rows=evaluations * problem.rows,
    )


def scaled_system(problem: LeastSquares, normal: Normal, x: Array) -> tuple[Array, Array]:
    """Information H (n, n) and gradient g (n,) of the whole objective at x, in coordinates (x - x0) / start_std."""
    scale = problem.start_std
    information = scale[:, None] * normal.information * scale
    information[np.diag_indices_from(information)] += scale**2 * problem.prior_information
    gradient = scale * (normal.gradient + problem.prior_information * (x - problem.x0))
    return information, gradient

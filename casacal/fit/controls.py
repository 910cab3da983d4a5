"""Controls for comparison: faces alone, a step along null directions, and SciPy's optimiser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casacal.errors import ProblemError
from casacal.fit.least_squares import Conditioned, LeastSquares, Result, Status, nothing_unknown
from casacal.fit.lm import lm
from casacal.linalg import right_directions

UNMOVED = 1.01  # residual RMS over that before the step, beyond which it is halved: the plane must not notice
HALVINGS = 60
UNSEEN = 0.3
"""Singular value of the whitened Jacobian, in prior standard deviations, below which a direction counts as unseen: one
prior standard deviation along it moves all residuals together by less than a third of one residual's noise."""


def plane_only(problem: LeastSquares, *, max_steps: int = 100, tolerance: float = 1e-9) -> Result:
    """Minimise f in the unknowns that `problem.datum` marks, the others held at the prior's mean.

    What a calibration must beat: it shows how much of a residual a better plane alone removes. The covariance of
    the held unknowns is their prior's. Arguments as for `lm`.
    """
    part = Conditioned(problem, problem.datum, problem.x0)
    fitted = lm(part, max_steps=max_steps, tolerance=tolerance)
    x, fitted_alone = part.expand(fitted.x), problem.datum.astype(np.float64)
    information = problem.normal(x).information * np.outer(fitted_alone, fitted_alone)
    return replace(fitted, method="plane-only", problem=problem, x=x, information=information, belief=None)


def null_step(problem: LeastSquares, *, seed: int = 0, size: float = 2.0) -> Result:
    """Minimise f, then step at random in the null and weak directions of the Jacobian there.

    The residuals hardly change; where the model bends so much that they do, the step is halved until they do not. What
    it does to the tip is what a plane residual cannot show.

    Args:
        seed: of the step.
        size: standard deviation of the step along each such direction, in prior standard deviations (flat: start_std),
            before any halving.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "null-step")
    best = lm(problem)
    values, right = right_directions(problem.jacobian(best.x) * problem.start_std)
    unseen = right[values < UNSEEN]
    step = problem.start_std * (np.random.default_rng(seed).normal(scale=size, size=len(unseen)) @ unseen)
    before, halvings = float(np.linalg.norm(problem.residual(best.x))), 0
    while np.linalg.norm(problem.residual(best.x + step)) > UNMOVED * before and halvings < HALVINGS:
        step, halvings = step / 2, halvings + 1
    return replace(best, method="null-step", x=best.x + step)


TOLERANCE = 1e-14


def scipy_least_squares(problem: LeastSquares, *, max_evaluations: int = 200) -> Result:
    """Minimise f by `scipy.optimize.least_squares` (trust region, exact Jacobian), the prior as further residuals.

    `max_evaluations` are of all residuals.
    """
    if not problem.unknowns:
        return nothing_unknown(problem, "trf")
    if problem.constraints is not None:
        raise ProblemError("scipy_least_squares takes no constraints, and this problem has some", "Use lm or ipopt")
    from scipy.optimize import least_squares  # a third of a second that other methods need not spend

    scale, pull = problem.start_std, problem.prior_rows * problem.start_std
    outcome = least_squares(
        lambda y: np.concatenate([problem.residual(problem.x0 + scale * y), pull @ y]),
        np.zeros(problem.unknowns),
        lambda y: np.vstack([problem.jacobian(problem.x0 + scale * y) * scale, pull]),
        method="trf",
        **dict.fromkeys(("xtol", "ftol", "gtol"), TOLERANCE),
        max_nfev=max_evaluations,
    )
    status = Status.CONVERGED if outcome.success else Status.MAX_STEPS
    return Result(
        method="scipy",
        problem=problem,
        x=problem.x0 + scale * outcome.x,
        status=status if np.isfinite(outcome.cost) else Status.NOT_FINITE,
        trace={"cost": np.array([outcome.cost])},
        steps=int(outcome.nfev),
        residual_rows=int(outcome.nfev) * problem.rows,
        jacobian_rows=int(outcome.njev) * problem.rows,
    )

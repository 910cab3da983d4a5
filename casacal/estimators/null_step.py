"""The control that lies: a random step from the minimum along what the samples hardly see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casacal.estimators.lm import lm
from casacal.least_squares import LeastSquares
from casacal.result import Result

WEAK = 1.0
"""Whitened singular value, in prior standard deviations, below which the prior knows more than the samples."""


def null_step(problem: LeastSquares, *, seed: int = 0, size: float = 1.0) -> Result:
    """Minimise f, then step at random in the null and weak directions of the Jacobian there.

    The residuals hardly change. What the step does to the tip is what a plane residual cannot show.

    Args:
        problem: what to minimise.
        seed: of the step.
        size: standard deviation of the step along each such direction, in prior standard deviations (flat: start_std).

    """
    best = lm(problem)
    _, values, right = np.linalg.svd(problem.jacobian(best.x) * problem.start_std, full_matrices=True)
    values = np.concatenate([values, np.zeros(problem.unknowns - len(values))])
    unseen = right[values < WEAK]
    step = np.random.default_rng(seed).normal(scale=size, size=len(unseen)) @ unseen
    return replace(best, method="null-step", x=best.x + problem.start_std * step)

"""The control M0: only the planes are fitted, robot and tool stay nominal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casacal.estimators.lm import lm
from casacal.least_squares.information import with_diagonal
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.restricted import Restricted
from casacal.least_squares.result import Result


def plane_only(problem: LeastSquares, *, max_steps: int = 100, tolerance: float = 1e-9) -> Result:
    """Minimise f in the unknowns that `problem.datum` marks, the others held at the prior's mean.

    What a calibration must beat: it shows how much of a residual a better plane alone removes. The covariance of
    the held unknowns is their prior's. Arguments as for `lm`.
    """
    part = Restricted(problem, problem.datum, problem.x0)
    fitted = lm(part, max_steps=max_steps, tolerance=tolerance)
    x, fitted_alone = part.expand(fitted.x), problem.datum.astype(np.float64)
    information = with_diagonal(problem.normal(x).information, fitted_alone, np.zeros(x.size))
    return replace(fitted, method="plane-only", problem=problem, x=x, information=information, belief=None)

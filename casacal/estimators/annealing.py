"""Simulated annealing (M1): SciPy's dual annealing on the common objective."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from casacal.array_types import Array
from casacal.estimators.box import BUDGET, WIDTH, Search
from casacal.estimators.nominal import nothing_unknown
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result


class _BudgetSpentError(Exception):
    """Ends a refinement in the middle: SciPy counts its own moves alone."""


def annealing(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int = BUDGET,
    width: float = WIDTH,
    local_search: bool = False,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box x0 +- width * start_std by generalised simulated annealing, one candidate after another.

    Args:
        problem: what to minimise.
        seed: of all random numbers.
        budget: rows of residuals to evaluate at most.
        width: half width of the box, standard deviations.
        local_search: whether SciPy refines accepted candidates with L-BFGS-B, from exact gradients; a gradient counts
            as one more candidate.
        progress: called with (candidates, best cost) at each new best.

    Returns:
        The best candidate as x (n,), deviations from nominal in the units of `problem.units`; the covariance (n, n) is
        from the curvature there. The status is `BUDGET` where all went well: such a method gives no sign that it has
        arrived at the minimum.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "annealing")
    from scipy.optimize import dual_annealing  # a third of a second that other methods need not spend

    search = Search(problem, budget=budget, width=width)
    bounds = [(-1.0, 1.0)] * problem.unknowns

    def noted(_: Array, cost: float, __: int) -> None:
        if progress is not None:
            progress(search.spent, cost)

    def afford() -> None:
        if search.spent + search.gradients >= search.candidates:
            raise _BudgetSpentError

    def cost(point: Array) -> float:
        afford()
        return float(search.costs(np.asarray(point)[None])[0])

    def gradient(point: Array) -> Array:
        afford()
        return search.gradient(np.asarray(point))

    with contextlib.suppress(_BudgetSpentError):
        dual_annealing(
            cost,
            bounds,
            maxiter=search.candidates,
            maxfun=search.candidates,
            no_local_search=not local_search,
            minimizer_kwargs={"method": "L-BFGS-B", "jac": gradient, "bounds": bounds},
            x0=np.zeros(problem.unknowns),
            rng=np.random.default_rng(seed),
            callback=noted,
        )
    return search.result("annealing", search.spent)

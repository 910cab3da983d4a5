"""Differential evolution (M4): SciPy's, a whole generation at once, on the common objective."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from casacal.array_types import Array
from casacal.estimators.box import BUDGET, WIDTH, Search
from casacal.estimators.nominal import nothing_unknown
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result

POPULATION = 64


def evolution(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int = BUDGET,
    width: float = WIDTH,
    population: int = POPULATION,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box x0 +- width * start_std by differential evolution (best/1/bin), without SciPy's polishing.

    Args:
        problem: what to minimise.
        seed: of all random numbers.
        budget: rows of residuals to evaluate at most; a population larger than it allows is made smaller.
        width: half width of the box, standard deviations.
        population: candidates per generation.
        progress: called with (candidates, best cost) after each generation.

    Returns:
        The best candidate as x (n,), deviations from nominal in the units of `problem.units`; the covariance (n, n) is
        from the curvature there. The status is `BUDGET` where all went well: such a method gives no sign that it has
        arrived at the minimum.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "evolution")
    from scipy.optimize import differential_evolution  # a third of a second that other methods need not spend

    search = Search(problem, budget=budget, width=width)
    size = max(min(population, search.candidates // 2), 5)
    rng = np.random.default_rng(seed)
    start = rng.uniform(-1, 1, size=(size, problem.unknowns))
    start[0] = 0.0

    def noted(_: Array, convergence: float) -> None:
        del convergence
        if progress is not None:
            progress(search.spent, search.best_cost)

    outcome = differential_evolution(
        lambda points: search.costs(np.asarray(points).T),
        [(-1.0, 1.0)] * problem.unknowns,
        maxiter=max(search.candidates // size - 1, 1),
        init=start,
        tol=0.0,
        polish=False,
        vectorized=True,
        updating="deferred",
        rng=rng,
        callback=noted,
    )
    return search.result("evolution", int(outcome.nit))

"""Particle swarm (M2): global best with inertia, on the common objective."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from casacal.estimators.box import BUDGET, WIDTH, Search
from casacal.estimators.nominal import nothing_unknown
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result

PARTICLES = 64
INERTIA, ATTRACTION = 0.7298, 1.49618
"""Clerc and Kennedy, The particle swarm: explosion, stability and convergence, 2002."""


def swarm(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int = BUDGET,
    width: float = WIDTH,
    particles: int = PARTICLES,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box x0 +- width * start_std: each particle is drawn to its own best place and to the swarm's.

    v <- w v + c u1 (own best - x) + c u2 (swarm's best - x), x <- x + v, u1 and u2 uniform in 0 ... 1 for each
    coordinate. A particle that leaves the box stops at its wall.

    Args:
        problem: what to minimise.
        seed: of all random numbers.
        budget: rows of residuals to evaluate at most; a swarm larger than it allows is made smaller.
        width: half width of the box, standard deviations.
        particles: their number.
        progress: called with (candidates, best cost) after each step.

    Returns:
        The best candidate as x (n,), deviations from nominal in the units of `problem.units`; the covariance (n, n) is
        from the curvature there. The status is `BUDGET` where all went well: such a method gives no sign that it has
        arrived at the minimum.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "swarm")
    search = Search(problem, budget=budget, width=width)
    rng = np.random.default_rng(seed)
    count = min(particles, search.candidates)
    places = rng.uniform(-1, 1, size=(count, problem.unknowns))
    places[0] = 0.0
    speeds = rng.uniform(-1, 1, size=places.shape) / 2
    best_places, best_costs, steps = places.copy(), search.costs(places), 0
    while search.spent + count <= search.candidates:
        leader = best_places[int(np.argmin(best_costs))]
        own, common = rng.random(places.shape), rng.random(places.shape)
        speeds = INERTIA * speeds + ATTRACTION * (own * (best_places - places) + common * (leader - places))
        moved = places + speeds
        places = np.clip(moved, -1, 1)
        speeds[moved != places] = 0.0
        costs = search.costs(places)
        better = costs < best_costs
        best_places[better], best_costs[better] = places[better], costs[better]
        steps += 1
        if progress is not None:
            progress(search.spent, search.best_cost)
    return search.result("swarm", steps)

"""The population methods on the common objective: annealing (M1), particle swarm (M2), differential evolution (M4).

All search the same box with the same budget of rows; what they return is told at `annealing`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from casacal.errors import ProblemError
from casacal.fit.least_squares import LeastSquares, Result, Status, nothing_unknown
from casacal.kernels.losses import Loss
from casacal.values import Array

BUDGET = 1_000_000  # rows of residuals that a population method may evaluate unless told otherwise
WIDTH = 4.0  # half width of the box, in prior standard deviations (`start_std` where the prior is flat)
POPULATION = 64  # candidates of a generation, particles of a swarm
INERTIA, ATTRACTION = 0.7298, 1.49618
"""Clerc and Kennedy, The particle swarm: explosion, stability and convergence, 2002."""


class Search:
    """The objective over the box -1 ... 1 in each unknown, counting candidates and remembering the best."""

    def __init__(self, problem: LeastSquares, *, budget: int, width: float, loss: Loss | None) -> None:
        if budget < problem.rows or not width > 0:
            raise ProblemError(
                f"A budget of {budget} rows and a box of {width:g} standard deviations were given",
                f"Give at least the {problem.rows} rows of one candidate, and a positive width",
            )
        if problem.constraints is not None:
            named = ", ".join(problem.constraints.names)
            what = f"Methods that search a box meet no constraint but by luck, and this problem has some ({named})"
            raise ProblemError(what, "Use lm, sckf, sckf_lm, ekf or ipopt")
        self.problem, self.scale, self.loss = problem, width * problem.start_std, loss
        self.candidates = max(budget // problem.rows, 1)
        """Number of candidates that the budget allows."""
        self.spent, self.gradients = 0, 0
        self.best_cost, self.best = np.inf, problem.x0.copy()
        self.history: list[tuple[int, float]] = []

    def costs(self, points: Array) -> Array:
        """Objective (m,) at points (m, n) of the box; infinite where it is not finite."""
        states = self.problem.x0 + self.scale * points
        found = self.problem.costs(states, self.loss)
        found = np.where(np.isfinite(found), found, np.inf)
        self.spent += len(states)
        lowest = int(np.argmin(found))
        if found[lowest] < self.best_cost:
            self.best_cost, self.best = float(found[lowest]), states[lowest].copy()
        self.history.append((self.spent, self.best_cost))
        return np.asarray(found)

    def gradient(self, point: Array) -> Array:
        """Exact gradient (n,) of the objective at one point (n,) of the box."""
        state = self.problem.x0 + self.scale * point
        self.gradients += 1
        pull = self.problem.prior_information @ (state - self.problem.x0)
        return np.asarray(self.scale * (self.problem.normal(state, self.loss).gradient + pull))

    def result(self, method: str, steps: int) -> Result:
        """The best candidate, with the curvature there as covariance."""
        counts, costs = np.array(self.history).T
        return Result(
            method=method,
            problem=self.problem,
            x=self.best,
            information=self.problem.normal(self.best, self.loss).information,
            status=Status.BUDGET if np.isfinite(self.best_cost) else Status.NOT_FINITE,
            trace={"cost": costs, "candidates": counts},
            steps=steps,
            residual_rows=(self.spent + self.gradients) * self.problem.rows,
            jacobian_rows=(self.gradients + 1) * self.problem.rows,
            loss=self.loss,
        )


class _BudgetSpentError(Exception):
    """Ends a refinement in the middle: SciPy counts its own moves alone."""


def annealing(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int = BUDGET,
    width: float = WIDTH,
    local_search: bool = False,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box x0 +- width * start_std by generalised simulated annealing, one candidate after another.

    Args:
        seed: of all random numbers.
        budget: rows of residuals to evaluate at most.
        width: half width of the box, standard deviations.
        local_search: whether SciPy refines accepted candidates with L-BFGS-B, from exact gradients; a gradient counts
            as one more candidate.
        loss: what replaces r^2 / 2 in f, such as `huber()`.
        progress: called with (candidates, best cost) at each new best.

    Returns the best candidate, with the covariance from the curvature there. The status is `BUDGET` where all went
    well: such a method gives no sign that it has arrived at the minimum.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "annealing")
    from scipy.optimize import dual_annealing  # a third of a second that other methods need not spend

    search = Search(problem, budget=budget, width=width, loss=loss)
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


def swarm(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int = BUDGET,
    width: float = WIDTH,
    particles: int = POPULATION,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box x0 +- width * start_std: each particle is drawn to its own best place and to the swarm's.

    v <- w v + c u1 (own best - x) + c u2 (swarm's best - x), x <- x + v, u1 and u2 uniform in 0 ... 1 for each
    coordinate. A particle that leaves the box stops at its wall.

    Args:
        problem, seed, width, loss: as for `annealing`.
        budget: rows of residuals to evaluate at most; a swarm larger than it allows is made smaller.
        particles: their number.
        progress: called with (candidates, best cost) after each step.

    Returns as `annealing`.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "swarm")
    search = Search(problem, budget=budget, width=width, loss=loss)
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


def evolution(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int = BUDGET,
    width: float = WIDTH,
    population: int = POPULATION,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box x0 +- width * start_std by differential evolution (best/1/bin), without SciPy's polishing.

    Args:
        problem, seed, width, loss: as for `annealing`.
        budget: rows of residuals to evaluate at most; a population larger than it allows is made smaller.
        population: candidates per generation.
        progress: called with (candidates, best cost) after each generation.

    Returns as `annealing`.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "evolution")
    from scipy.optimize import differential_evolution  # a third of a second that other methods need not spend

    search = Search(problem, budget=budget, width=width, loss=loss)
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

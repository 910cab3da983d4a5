"""The population methods on the common objective: annealing (M1), particle swarm (M2), differential evolution (M4).

All search the same box with the same budget of rows; what they return is told at `annealing`. Unknowns that only say
where the touched face or the device stands (`LeastSquares.datum`) are put by `Search` where they fit each candidate.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable

import numpy as np

from casacal.errors import ProblemError, came
from casacal.fit.least_squares import LeastSquares, Result, Status, nothing_unknown
from casacal.kernels.losses import Loss
from casacal.values import Array, Index, is_finite

BUDGET = 1_000_000  # rows of residuals that a population method may evaluate unless told otherwise
WIDTH = 4.0  # half width of the box, in prior standard deviations (`start_std` where the prior is flat)
SLOPES = 3  # rows of residuals that a row of the Jacobian counts as: 2.5 in time, by studies/paper
LEAST = 2 * SLOPES  # candidates that a budget must allow: slopes, the drawing twice, and one that is tried
REWEIGHTED = 4  # solutions with new weights by which faces are placed under a loss
PATIENCE, FALL = 3_000, 0.01  # evaluations in which the objective falls by no more, after which a search stops
TEMPERATURE = 5.0
"""Of annealing: f is minus a log posterior, which a walk at temperature one samples; from SciPy's 5230 most budgets
end before steps are shorter than the box."""
INERTIA, ATTRACTION, INFORMED = 1 / (2 * math.log(2)), 0.5 + math.log(2), 3
"""Of a swarm: M. Clerc, Standard Particle Swarm Optimisation, hal-00764996, 2012, for 2006 and 2007."""
POPULATION, FEWEST, MEMORY, ARCHIVE, BEST, SPREAD = 50, 4, 6, 2.6, 0.11, 0.1
"""Of evolution: Tanabe and Fukunaga, Improving the search performance of SHADE using linear population size reduction,
CEC 2014; but their first population, 18 per unknown, is for 10,000 candidates per unknown, twenty times ours."""


class SearchEndedError(Exception):
    """The budget is spent, or nothing falls any more."""


class Search:
    """The objective over a box about x0, in units of `start_std`: places the datum, counts, remembers the best.

    At a point the datum moves from its best known place by a Gauss-Newton step, with the Jacobian at x0: a plane's
    residual is nearly linear in where the plane is. One evaluation of the residuals gives the step, and the objective
    after it but for what is not linear; where that is lower than the best, a second one gives the objective itself.

    Args:
        budget: rows of residuals to evaluate at most, rows of the Jacobian counted `SLOPES` times; None: until
            `PATIENCE` evaluations have lowered the objective by less than `FALL`.
        exact: whether every point is evaluated a second time, as what follows gradients needs.
        progress: called with (evaluations, best cost) at each new best.

    """

    def __init__(
        self,
        problem: LeastSquares,
        *,
        budget: int | None = BUDGET,
        width: float = WIDTH,
        loss: Loss | None = None,
        exact: bool = False,
        progress: Callable[[int, float], None] | None = None,
    ) -> None:
        if budget is not None and not (is_finite(budget) and float(budget).is_integer()):
            raise ProblemError(f"Got {came(budget)} as the budget", "Give a whole number of rows, or None for no limit")
        if (budget is not None and budget < LEAST * problem.rows) or not width > 0:
            raise ProblemError(
                f"A budget of {budget} rows and a box of {width:g} standard deviations were given",
                f"Give at least {LEAST * problem.rows} rows, {LEAST} times those of one candidate; or budget=None, to "
                "search until nothing falls any more; and a positive width",
            )
        if problem.constraints is not None:
            named = ", ".join(problem.constraints.names)
            what = f"Methods that search a box meet no constraint but by luck, and this problem has some ({named})"
            raise ProblemError(what, "Use lm, sckf, sckf_lm, ekf or ipopt")
        self.problem, self.width, self.loss, self.exact, self.progress = problem, width, loss, exact, progress
        placed = problem.datum if not problem.datum.all() else np.zeros(problem.unknowns, dtype=bool)
        self.placed: Index = np.flatnonzero(placed)
        self.searched: Index = np.flatnonzero(~placed)
        self.unknowns = self.searched.size  # number of unknowns that are searched
        self.allowed = math.inf if budget is None else budget // problem.rows  # evaluations in the budget
        self.evaluations, self.slopes_taken, self.last_fall = 0, 0, (0, math.inf)
        self.best_cost, self.best = math.inf, problem.x0.copy()
        self.history: list[tuple[int, float]] = []
        if self.placed.size:
            self.slopes_taken += 1
            slopes = np.vstack([problem.jacobian(problem.x0), problem.prior_rows])[:, self.placed]
            self._slopes = slopes * problem.start_std[self.placed]
            self._inverse = np.linalg.pinv(self._slopes)
        self.costs(np.zeros((1, self.unknowns)))

    @property
    def spent(self) -> int:
        """Evaluations so far, those of the Jacobian counted `SLOPES` times."""
        return self.evaluations + SLOPES * self.slopes_taken

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """Points (count, n): the drawing, and others drawn from the prior, cut at the walls of the box."""
        normal = rng.normal(size=(count, self.problem.unknowns)) @ self.problem.prior_root.T
        normal[0] = 0.0
        return np.clip(normal[:, self.searched], -self.width, self.width)

    def costs(self, points: Array) -> Array:
        """Objective (m,) at points (m, n), the datum at its best; infinite where it is not finite.

        Where the datum is placed and the objective is not below the best, it is what the step promises.
        """
        idle = self.spent - self.last_fall[0] > PATIENCE
        if self.spent + len(points) > self.allowed or (idle and self.allowed == math.inf):
            raise SearchEndedError
        states = self.states(points)
        found = self._placed(states) if self.placed.size else self.problem.costs(states, self.loss)
        self.evaluations += 0 if self.placed.size else len(points)
        found = np.where(np.isfinite(found), found, np.inf)
        lowest = int(np.argmin(found))
        if found[lowest] < self.best_cost:
            self.best_cost, self.best = float(found[lowest]), states[lowest].copy()
            if self.progress is not None:
                self.progress(self.spent, self.best_cost)
        if not self.best_cost > self.last_fall[1] - FALL:
            self.last_fall = (self.spent, self.best_cost)
        self.history.append((self.spent, self.best_cost))
        return np.asarray(found)

    def gradient(self, point: Array) -> Array:
        """Gradient (n,) of the objective at one point (n,), the datum at its best: there it has none of its own."""
        if self.spent + 2 + SLOPES > self.allowed:
            raise SearchEndedError
        (state,) = states = self.states(point[None])
        if self.placed.size:
            self._step(states[0])
        self.evaluations, self.slopes_taken = self.evaluations + 1, self.slopes_taken + 1
        pull = self.problem.prior_information @ (state - self.problem.x0)
        whole = self.problem.normal(state, self.loss).gradient + pull
        return np.asarray((self.problem.start_std * whole)[self.searched])

    def states(self, points: Array) -> Array:
        """All unknowns (m, n) at points, the datum where it was best so far."""
        states = np.tile(self.best, (len(points), 1))
        own = self.searched
        states[:, own] = self.problem.x0[own] + self.problem.start_std[own] * points
        return states

    def _placed(self, states: Array) -> Array:
        """Move the datum of states (m, n) to where it fits best, and return the objective (m,) there.

        Where the promise is below the best, or all are to be exact, it is evaluated; a step that fails is undone.
        """
        before = states.copy()
        here, promised = np.array([self._step(state) for state in states]).T
        better = np.flatnonzero(np.isfinite(promised) & ((promised < self.best_cost) | self.exact))
        better = better[np.argsort(promised[better])][: int(min(self.allowed - self.spent, len(states)))]
        promised[np.isfinite(promised) & (promised < self.best_cost)] = self.best_cost  # what no row is left to try
        if better.size:
            there = self.problem.costs(states[better], self.loss)
            self.evaluations += better.size
            stays = ~(there <= here[better])
            states[better[stays]] = before[better[stays]]
            promised[better] = np.where(stays, here[better], there)
        return np.asarray(promised)

    def _step(self, state: Array) -> tuple[float, float]:
        """Move the datum of one state (n,), in place; the objective before, and what it promises to be after."""
        problem, count = self.problem, self.problem.rows
        whole = np.concatenate([problem.residual(state), problem.prior_rows @ (state - problem.x0)])
        self.evaluations += 1
        if not np.isfinite(whole).all():
            return math.inf, math.inf
        step = -self._inverse @ whole
        if self.loss is not None:
            for _ in range(REWEIGHTED):
                root = np.ones(whole.size)
                root[:count] = np.sqrt(self.loss.weight((whole + self._slopes @ step)[:count]))
                step = -np.linalg.lstsq(root[:, None] * self._slopes, root * whole, rcond=None)[0]
        state[self.placed] += problem.start_std[self.placed] * step
        return self._cost(whole), self._cost(whole + self._slopes @ step)

    def _cost(self, whole: Array) -> float:
        """Objective from the residuals and the whitened deviations from the prior, one after another."""
        r, away = np.split(whole, [self.problem.rows])
        return float(r @ r if self.loss is None else 2 * self.loss.cost(r).sum()) / 2 + float(away @ away) / 2

    def result(self, method: str, steps: int) -> Result:
        """The best candidate, with the curvature there as covariance."""
        counts, costs = np.array(self.history).T
        moved = bool((self.best != self.problem.x0)[self.searched].any())
        status = Status.STALLED if self.allowed == math.inf else Status.BUDGET
        status = status if moved else Status.UNMOVED
        return Result(
            method=method,
            problem=self.problem,
            x=self.best,
            information=self.problem.normal(self.best, self.loss).information,
            status=status if math.isfinite(self.best_cost) else Status.NOT_FINITE,
            trace={"cost": costs, "candidates": counts},
            steps=steps,
            residual_rows=self.evaluations * self.problem.rows,
            jacobian_rows=(self.slopes_taken + 1) * self.problem.rows,
            loss=self.loss,
        )


def annealing(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int | None = BUDGET,
    width: float = WIDTH,
    local_search: bool = False,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box x0 +- width * start_std by generalised simulated annealing, one candidate after another.

    Args:
        seed: of all random numbers.
        budget: rows of residuals to evaluate at most, or None to search until nothing falls: as `Search`.
        width: half width of the box, standard deviations.
        local_search: whether SciPy refines accepted candidates with L-BFGS-B, from exact gradients.
        loss: what replaces r^2 / 2 in f, such as `huber()`.
        progress: called with (evaluations, best cost) at each new best.

    Returns the best candidate, with the covariance from the curvature there. The status is `BUDGET` where all went
    well, `STALLED` without a budget: such a method gives no sign that it has arrived at the minimum; `UNMOVED` where no
    candidate was better than the arm as drawn.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "annealing")
    from scipy.optimize import dual_annealing  # a third of a second that other methods need not spend

    search = Search(problem, budget=budget, width=width, loss=loss, exact=local_search, progress=progress)
    bounds, most = [(-width, width)] * search.unknowns, 10**9
    with contextlib.suppress(SearchEndedError):
        dual_annealing(
            lambda point: float(search.costs(np.asarray(point)[None])[0]),
            bounds,
            maxiter=most,
            maxfun=most,
            initial_temp=TEMPERATURE,
            no_local_search=not local_search,
            minimizer_kwargs={"method": "L-BFGS-B", "jac": lambda point: search.gradient(np.asarray(point))}
            | {"bounds": bounds},
            x0=np.zeros(search.unknowns),
            rng=np.random.default_rng(seed),
        )
    return search.result("annealing", search.evaluations)


def swarm(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int | None = BUDGET,
    width: float = WIDTH,
    particles: int | None = None,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box by the standard particle swarm of 2007: each particle is drawn to its own best place and another.

    v <- w v + c u1 (own best - x) + c u2 (informants' best - x), x <- x + v, u1 and u2 uniform in 0 ... 1 for each
    coordinate. Each particle informs itself and three others, drawn anew after a step that brought no better place. A
    particle that leaves the box stops at its wall. It starts spread as the prior.

    Args:
        problem, seed, budget, width, loss, progress: as for `annealing`.
        particles: their number; None for 10 + 2 sqrt(n), n the unknowns that are searched.

    Returns as `annealing`.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "swarm")
    _refuse_few("particles", particles, 2)
    search = Search(problem, budget=budget, width=width, loss=loss, progress=progress)
    rng, steps = np.random.default_rng(seed), 0
    count = int(min(particles or 10 + int(2 * math.sqrt(search.unknowns)), search.allowed - search.spent))
    places = search.drawn(rng, count)
    speeds = (search.drawn(rng, count) - places) / 2
    best_places, best_costs, reached, informs = places.copy(), np.full(count, np.inf), np.inf, np.eye(count, dtype=bool)
    with contextlib.suppress(SearchEndedError):
        while True:
            costs = search.costs(places)
            better = costs < best_costs
            best_places[better], best_costs[better] = places[better], costs[better]
            if not best_costs.min() < reached:
                informs = (rng.random((count, count)) < 1 - (1 - 1 / count) ** INFORMED) | np.eye(count, dtype=bool)
            reached = best_costs.min()
            leaders = best_places[np.argmin(np.where(informs, best_costs[:, None], np.inf), axis=0)]
            own, common = rng.random(places.shape), rng.random(places.shape)
            speeds = INERTIA * speeds + ATTRACTION * (own * (best_places - places) + common * (leaders - places))
            moved = places + speeds
            places = np.clip(moved, -width, width)
            speeds[moved != places] = 0.0
            steps += 1
    return search.result("swarm", steps)


def evolution(
    problem: LeastSquares,
    *,
    seed: int = 0,
    budget: int | None = BUDGET,
    width: float = WIDTH,
    population: int = POPULATION,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Search the box by differential evolution that learns its two constants, L-SHADE. It starts spread as the prior.

    The constants of the classical one would have to be tuned to each arm: 24 unknowns known some a thousand times
    better than others are slow to it. The population shrinks as the budget is spent; without one it keeps its size.

    Args:
        problem, seed, budget, width, loss, progress: as for `annealing`.
        population: candidates of the first generation, at most a tenth of those that the budget allows.

    Returns as `annealing`.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "evolution")
    _refuse_few("candidates", population, FEWEST)
    search = Search(problem, budget=budget, width=width, loss=loss, progress=progress)
    rng, steps, k = np.random.default_rng(seed), 0, 0
    size = first = int(max(min(population, search.allowed // 10), FEWEST))
    points, lost = search.drawn(rng, size), np.zeros((0, search.unknowns))
    memory = np.full((MEMORY, 2), 0.5)  # of the factor, and of the rate of crossing
    with contextlib.suppress(SearchEndedError):
        costs = search.costs(points)
        while True:
            told = memory[rng.integers(MEMORY, size=size)]
            factors = np.zeros(size)  # Cauchy's about those in memory: drawn again where not positive, at most one
            while (bad := factors <= 0).any():
                factors[bad] = told[bad, 0] + SPREAD * rng.standard_cauchy(int(bad.sum()))
            factors, rates = np.minimum(factors, 1.0), np.clip(rng.normal(told[:, 1], SPREAD), 0, 1)
            tried = _crossed(rng, points, lost, np.argsort(costs), factors, rates, width)
            found = search.costs(tried)
            steps += 1
            better = found < costs
            if better.any():
                gain, good = costs[better] - found[better], np.stack([factors, rates], axis=1)[better]
                gain = gain / gain.sum() if np.isfinite(gain).all() else np.full(gain.size, 1 / gain.size)
                memory[k % MEMORY] = (gain @ good**2) / np.maximum(gain @ good, np.finfo(float).tiny)
                k, lost = k + 1, np.vstack([lost, points[better]])
            points[found <= costs] = tried[found <= costs]
            costs = np.minimum(found, costs)
            size = max(round(first + (FEWEST - first) * search.spent / search.allowed), FEWEST)
            kept = np.argsort(costs)[:size]
            points, costs = points[kept], costs[kept]
            lost = lost[rng.permutation(len(lost))[: int(ARCHIVE * size)]]
    return search.result("evolution", steps)


def _refuse_few(what: str, count: object, least: int) -> None:
    """Raise ProblemError for a population that is none; None leaves its size to the method."""
    if count is not None and not (isinstance(count, (int, np.integer)) and count >= least):
        raise ProblemError(f"{count!r} {what} were asked for", f"Give a whole number, {least} or more")


def _crossed(
    rng: np.random.Generator, points: Array, lost: Array, order: Index, factors: Array, rates: Array, width: float
) -> Array:
    """Trial points (m, n), current-to-pbest/1/bin; `order` sorts points, best first; `lost` were replaced by better."""
    size, n = points.shape
    each, leading = np.arange(size), order[rng.integers(max(round(BEST * size), 2), size=size)]
    one = (each + rng.integers(1, size, size=size)) % size
    pool, other = np.vstack([points, lost]), each.copy()
    while (bad := (other == each) | (other == one)).any():
        other[bad] = rng.integers(len(pool), size=int(bad.sum()))
    moved = points + factors[:, None] * (points[leading] - points + points[one] - pool[other])
    moved = np.where(np.abs(moved) > width, (points + np.sign(moved) * width) / 2, moved)
    crosses = rng.random(points.shape) < rates[:, None]
    crosses[each, rng.integers(n, size=size)] = True
    return np.where(crosses, moved, points)

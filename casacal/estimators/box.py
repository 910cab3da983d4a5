"""What the population methods share: the box they search, their budget, and what they return."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result, Status

BUDGET = 1_000_000
"""Rows of residuals that a population method may evaluate unless told otherwise."""
WIDTH = 4.0
"""Half width of the box, in prior standard deviations (`start_std` where the prior is flat)."""


class Search:
    """The objective over the box -1 ... 1 in each unknown, counting candidates and remembering the best."""

    def __init__(self, problem: LeastSquares, *, budget: int, width: float) -> None:
        if budget < problem.rows or not width > 0:
            raise ProblemError(
                f"A budget of {budget} rows and a box of {width:g} standard deviations were given",
                f"Give at least the {problem.rows} rows of one candidate, and a positive width",
            )
        self.problem, self.scale = problem, width * problem.start_std
        self.candidates = max(budget // problem.rows, 1)
        """How many candidates the budget allows."""
        self.spent, self.gradients = 0, 0
        self.best_cost, self.best = np.inf, problem.x0.copy()
        self.history: list[tuple[int, float]] = []

    def costs(self, points: Array) -> Array:
        """Objective (m,) at points (m, n) of the box; infinite where it is not finite."""
        states = self.problem.x0 + self.scale * points
        found = self.problem.costs(states)
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
        pull = self.problem.prior_information * (state - self.problem.x0)
        return np.asarray(self.scale * (self.problem.normal(state).gradient + pull))

    def result(self, method: str, steps: int) -> Result:
        """The best candidate, with the curvature there as covariance."""
        counts, costs = np.array(self.history).T
        return Result(
            method=method,
            problem=self.problem,
            x=self.best,
            information=self.problem.normal(self.best).information,
            status=Status.BUDGET if np.isfinite(self.best_cost) else Status.NOT_FINITE,
            trace={"cost": costs, "candidates": counts},
            steps=steps,
            residual_rows=(self.spent + self.gradients) * self.problem.rows,
            jacobian_rows=(self.gradients + 1) * self.problem.rows,
        )

"""What to touch when a plan is at its end: the best next one, and how many more it takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.estimators.sckf import Belief
from casacal.measuring.belief import error_below, spectrum
from casacal.measuring.known import Known
from casacal.measuring.touch import Touch
from casacal.planning.clearance import Clearance
from casacal.planning.exchange import gains
from casacal.planning.pool import pool_of
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.values import Value

POOL = 600
"""Touches among which the next one is looked for."""

MOST = 200
"""More touches than nobody makes."""


@dataclass(frozen=True, eq=False)
class Pool(Value):
    """Touches that could be made: rows of the arm as drawn, their whitened slopes (N, m, n) in units of the belief."""

    samples: Samples
    slopes: Array

    @staticmethod
    def of(known: Known, samples: Samples) -> Pool:
        """Those of faces that the belief knows."""
        bound = known.bound
        keys = [(key, u.per) for key, u in bound.problem.instrument.unknowns.items() if u.per is not None]
        have, there = {slot.name for slot in bound.slots}, np.ones(len(samples), dtype=bool)
        for key, per in keys:
            labels = samples.labels[per]
            named = [f"{key}.{bound.problem.instrument.instance(key, name)}" in have for name in labels.names]
            there &= np.array(named)[labels.codes]
        rows = samples.take(np.flatnonzero(there))
        return Pool(rows, _slopes(bound.on(rows), known))

    def most_telling(self, known: Known, field: Array) -> int:
        """The number of the touch that lowers the tip error most."""
        covariance = known.belief.root @ known.belief.root.T
        return int(np.argmax(gains(self.slopes, covariance, field.T @ field)))

    def best(self, known: Known, field: Array) -> Touch:
        """The touch that lowers the tip error most."""
        k = self.most_telling(known, field)
        columns = {name: float(values[k]) for name, values in self.samples.columns.items()}
        labels = {name: values[k] for name, values in self.samples.labels.items()}
        return Touch(self.samples.joints[k], columns, labels)

    def needed(self, known: Known, field: Array, tolerance: float) -> int | None:
        """How many more touches, each the best after the one before it, bring the error below a tolerance; None: none.

        None of so many as `MOST` does.
        """
        covariance, weight = known.belief.root @ known.belief.root.T, field.T @ field
        for count in range(MOST + 1):
            if error_below(spectrum(Belief(known.belief.mean, _root(covariance)), field)) <= tolerance:
                return count
            slope = self.slopes[int(np.argmax(gains(self.slopes, covariance, weight)))]
            across = slope @ covariance
            told = np.eye(len(slope)) + across @ slope.T
            covariance = covariance - across.T @ np.linalg.solve(told, across)
        return None


def could_be(problem: Problem, cell: Disturbances | None, clearance: Clearance | None) -> Samples:
    """Touches that the arm as drawn can make; raises SimulationError where faces are out of reach."""
    return pool_of(problem, cell, POOL, 7, clearance)


def _slopes(bound: BoundProblem, known: Known) -> Array:
    slopes = bound.jacobian(known.x) * bound.start_std
    return np.asarray(slopes.reshape(len(bound.block.samples), -1, bound.unknowns))


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

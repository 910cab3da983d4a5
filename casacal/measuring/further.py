"""What is known of the tip while touches come in, and which touch lowers its error most."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.estimators.sckf import Belief
from casacal.measuring.known import Known
from casacal.measuring.touch import Touch, rows_of
from casacal.planning.choice import pool_of
from casacal.planning.clearance import Clearance
from casacal.planning.exchange import gains
from casacal.problem.cell import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.workspace import up_to_base, workspace_joints
from casacal.values import Value

SURE = 0.95
"""Part of all arms whose error stays below what is promised."""


def wanted_field(bound: BoundProblem, joints: Array) -> Array:
    """Moves (3 M, n) of the tip at joint values (M, q), apart from the position of the base, per unit of the belief."""
    frame = workspace_joints(bound.problem.robot)
    sets = [(bound.tip_jacobian(bound.x0, q), bound.tips(bound.x0, q)) for q in (joints, frame)]
    return np.asarray(up_to_base(*sets[0], *sets[1]) * bound.start_std)


def spectrum(belief: Belief, field: Array) -> Array:
    """Weights (n,) of the squared RMS tip error as a sum of squares of independent unit normals, mm^2."""
    moves = field @ belief.root
    weights = np.linalg.eigvalsh(moves.T @ moves) * 3 / len(field)
    return np.asarray(np.maximum(weights, 0.0))


def expected_error(weights: Array) -> float:
    """Root of the mean squared tip error, mm."""
    return math.sqrt(float(weights.sum()))


def error_below(weights: Array, sure: float = SURE) -> float:
    """The RMS tip error (mm) below which a part of all arms stays.

    By the first three moments of the sum, between which lies a gamma distribution (Pearson's third).
    """
    from scipy.special import gammaincinv

    mean, variance, third = (float((weights**k).sum()) for k in (1, 2, 3))
    if not variance > 0:
        return 0.0
    spread, skew = math.sqrt(2 * variance), 8 * third / (2 * variance) ** 1.5
    shape = 4 / skew**2
    return math.sqrt(max(mean + spread * (float(gammaincinv(shape, sure)) - shape) / math.sqrt(shape), 0.0))


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Rows linear about a belief, in its units: residuals (touches, m), slopes (touches, m, n), whitened; noise, mm."""

    residual: Array
    slope: Array
    noise: Array

    @staticmethod
    def of(known: Known, belief: Belief, touches: Sequence[Touch]) -> LinearRows:
        """Of touches, about a mean."""
        bound, count = known.bound.on(rows_of(touches)), len(touches)
        x = bound.x0 + bound.start_std * belief.mean
        slopes = (bound.jacobian(x) * bound.start_std).reshape(count, -1, bound.unknowns)
        return LinearRows(bound.residual(x).reshape(count, -1), slopes, bound.block.noise)

    def without(self, k: int) -> LinearRows:
        """All but one."""
        return LinearRows(*(np.delete(part, k, axis=0) for part in (self.residual, self.slope, self.noise)))

    def evidence(self, mean: Array) -> float:
        """Logarithm, less a constant for each row, with the unit prior about -mean of the shift integrated out."""
        r, j = self.residual.ravel(), self.slope.reshape(-1, mean.size)
        information, gradient = np.eye(mean.size) + j.T @ j, j.T @ r + mean
        chi_square = r @ r + mean @ mean - gradient @ np.linalg.solve(information, gradient)
        return -float(chi_square + np.linalg.slogdet(information)[1]) / 2


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

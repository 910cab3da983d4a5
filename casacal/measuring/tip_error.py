"""The tip error that a belief leaves where the tip is wanted: to expect, and below which it stays 19 times of 20."""

from __future__ import annotations

import math

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.estimators.sckf import Belief
from casacal.uncertainty.workspace import up_to_base, workspace_joints

SURE = 0.95
"""Part of all arms whose error stays below what is promised."""


def wanted_field(bound: BoundProblem, joints: Array) -> Array:
    """Moves (3 M, n) of the tip at joint values (M, q), apart from where the base stands, per unit of the belief."""
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

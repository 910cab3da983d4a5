"""Whether unknowns moved farther, all together, than their priors allow: the chi-square of the prior's term.

Where all is as stated the estimate is spread about the nominal with the prior's covariance less the posterior's, so
that the squared moves in prior standard deviations sum up to the number of unknowns that the samples decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.marginal import Seen
from casacal.uncertainty.figures import chance_beyond


@dataclass(frozen=True)
class PriorMoves:
    """How far the arm and its tool moved, all together."""

    factor: float
    """Root mean square move over what the priors allow: one where they fit this arm."""
    decided: float
    """Unknowns that the samples decide, of those with a prior."""
    chance: float
    """Chance of moves as large as these, where priors and model are right."""


def prior_moves(bound: Seen, x: Array, covariance: Array) -> PriorMoves:
    """Moves of all unknowns with a finite prior, but for those that only say where the touched thing stands.

    The sum of squares is one of independent normal numbers, weighted with eigenvalues; two moments of it are matched
    (Satterthwaite).

    Args:
        bound: the problem.
        x: its estimate (n,).
        covariance: of that estimate (n, n).

    """
    own = np.flatnonzero(np.isfinite(bound.prior_std) & ~bound.datum)
    std, spread = bound.prior_std[own], covariance[np.ix_(own, own)]
    if not np.isfinite(spread).all():  # what nothing holds drags others along
        return PriorMoves(0.0, 0.0, 1.0)
    weights = np.clip(np.linalg.eigvalsh(np.eye(own.size) - spread / np.outer(std, std)), 0.0, 1.0)
    total, decided = float((((x - bound.x0)[own] / std) ** 2).sum()), float(weights.sum())
    if decided <= 0:
        return PriorMoves(0.0, 0.0, 1.0)
    freedom = decided**2 / float((weights**2).sum())
    return PriorMoves(math.sqrt(total / decided), decided, chance_beyond(freedom * total / decided, freedom))

"""Whether unknowns moved farther, all together, than their priors allow: the chi-square of the prior's term.

Where all is as stated the estimate is spread about the nominal with the prior's covariance less the posterior's, so
that the squared moves in prior standard deviations sum up to the number of unknowns that the samples decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.marginal import Seen
from casacal.uncertainty.figures import chance_beyond

DULL = 1e-3
"""Part of a prior's variance that samples must take away from a direction before it can be said to move."""


@dataclass(frozen=True)
class PriorMoves:
    """How far the arm and its tool moved, all together."""

    factor: float
    """Root mean square move over what the priors allow: one where they fit this arm."""
    decided: float
    """Unknowns that the samples decide, of those with a prior."""
    chance: float
    """Chance of moves as large as these, where priors and model are right."""


def chance_of_move(bound: Seen, x: Array, covariance: Array, own: NDArray[np.intp]) -> float:
    """Chance that some unknowns (k,) move as far as they did: chi-square of x'(P - C)^+ x, P their priors' covariance.

    What the samples do not see has not moved and does not count. One where a prior is flat.
    """
    prior, spread = bound.prior_std[own], covariance[np.ix_(own, own)]
    if not own.size or not np.isfinite(prior).all() or not np.isfinite(spread).all():
        return 1.0
    gained, moved = np.eye(own.size) - spread / np.outer(prior, prior), (x - bound.x0)[own] / prior
    values, along = np.linalg.eigh(gained)
    seen = values > DULL
    if not seen.any():
        return 1.0
    return chance_beyond(float((((along[:, seen].T @ moved) ** 2) / values[seen]).sum()), float(seen.sum()))


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

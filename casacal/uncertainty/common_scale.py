"""Whether all lengths came out too large or too small by one part, as an instrument of a wrong scale makes them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from casacal.array_types import Array
from casacal.binding.seen import ArmAlone, Seen
from casacal.uncertainty.prior_moves import DULL
from casacal.uncertainty.workspace import scale_direction

FEWEST = 4  # directions that rows must see before some of them can say how far the others may move
RANGE = np.geomspace(1e-2, 1e2, 121)  # times the priors that arms may differ from their drawing
ROUNDING = 1e-12
BEYOND = 700.0  # whose exponential is still a number


@dataclass(frozen=True, eq=False)
class CommonScale:
    """By what part of one all lengths are too large together, and the chance of so much if nothing scales them.

    off: by how much unknowns (s,) are elsewhere for it.
    """

    part: float
    chance: float
    off: Array


def common_scale(bound: Seen, x: Array, covariance: Array) -> CommonScale | None:
    """The scale that the moves of an estimate x (s,) have in common; None where rows see too little of them.

    What rows say of the unknowns, apart from priors, is z ~ N(0, N + t^2 A + B): N its own error, A and B what the
    priors of the arm and of all else allow, t how much of its priors this arm uses. A common scale e adds e g to it, g
    the lengths in prior standard deviations. Twice the logarithm of the ratio of the likelihoods with e and without,
    each at its best t, is turned into Student's t: so it does not matter how well the arm's priors fit, only whether
    its lengths move together where its angles and offsets do not. A dial whose gain is declared has that in B.
    """
    own = np.flatnonzero(np.isfinite(bound.prior_std) & ~bound.datum)
    std = bound.prior_std[own]
    spread = covariance[np.ix_(own, own)] / np.outer(std, std)
    grown = scale_direction(bound.whole)[bound.free] if isinstance(bound, ArmAlone) else scale_direction(bound)
    growth = grown[own] / std
    if not (np.isfinite(spread).all() and np.isfinite(x[own]).all() and growth.any()):
        return None
    left, along = np.linalg.eigh(spread)
    seen = left < 1 - DULL
    left, along = np.clip(left[seen], ROUNDING, None), along[:, seen]
    moved, towards = (x - bound.x0)[own] / std, along.T @ growth
    if len(left) < FEWEST or float(np.linalg.norm(towards)) < ROUNDING:
        return None
    said = along.T @ moved / (1 - left)
    arm = np.isin(own, [j for _, unit, _, j in bound.parameters() if j is not None and unit in ("mm", "rad")])
    fixed = np.diag(left / (1 - left)) + along[~arm].T @ along[~arm]
    free = along[arm].T @ along[arm]

    def likelihoods(t: float) -> tuple[float, float, float]:
        root = np.linalg.cholesky(fixed + t**2 * free)
        z, g = np.linalg.solve(root, np.column_stack([said, towards])).T
        plain = -float(np.log(np.diag(root)).sum()) - float(z @ z) / 2
        return plain, plain + float(z @ g) ** 2 / float(g @ g) / 2, float(z @ g) / float(g @ g)

    tried = [likelihoods(t) for t in RANGE]
    best = max(range(len(RANGE)), key=lambda k: tried[k][1])
    ratio, part = 2 * (tried[best][1] - max(each[0] for each in tried)), tried[best][2]
    freedom = len(left) - 1
    student = math.sqrt(freedom * math.expm1(min(max(ratio, 0.0) / (freedom + 1), BEYOND)))
    allowed = np.where(arm, RANGE[best] ** 2, 1.0)
    rest = allowed * (along @ np.linalg.solve(fixed + RANGE[best] ** 2 * free, said - part * towards))
    off = np.zeros(bound.unknowns)
    off[own] = (moved - rest) * std
    return CommonScale(part, 2 * float(stdtr(freedom, -student)), off)

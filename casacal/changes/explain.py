"""Which cause explains the rows: each fitted with the earlier posterior as the prior, weighed by its evidence.

The evidence of a cause is the likelihood at its best, less what its freedom costs (Occam's factor, with changes of a
usual size, so that six numbers must explain more than one). A row that is off is a cause like any other, and which of N
rows it is costs the logarithm of N.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.changes.causes import Cause
from casacal.changes.look import Look
from casacal.changes.state import Posterior, Prior
from casacal.uncertainty.fresh_rows import chances, likelihood, occam
from casacal.verification.fresh import Fresh

OFF = 100.0
"""Times its noise by which a row that is off usually is: a turn of a pointer that was not counted, 1 mm of 0.01 mm."""

SURE = 0.95
"""Part of the evidence from which on one cause is the one."""

STEPS = 60
"""Of the fit of a cause: the right one needs five, and a wrong one may creep along a valley for ever."""

NAMED = 0.02
"""Part of the evidence below which a cause is none of those that remain."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause at its best, or a row that is off.

    shift, std: of its unknowns (k,), with standard deviations; none of a row. share: part of the evidence. left: chance
    of what it leaves unexplained. p: chance of as much explained where nothing changed.
    """

    cause: Cause | None
    row: int
    shift: Array
    std: Array
    p: float
    left: float
    evidence: float
    share: float
    posterior: Posterior | None


def prior_of(look_fresh: Fresh, unknowns: int) -> Prior:
    """The earlier posterior of fresh rows, among so many unknowns of the shifted ones, shifts held at zero."""
    bound, known = look_fresh.bound, look_fresh.known
    more = unknowns - bound.unknowns
    free = np.flatnonzero(~known)
    firm = np.isfinite(bound.prior_std[free])
    at = np.concatenate([np.where(known, look_fresh.at, look_fresh.x), np.zeros(more)])
    guess = np.where(firm, bound.x0[free] - at[free], 0.0)
    made = Prior.of(
        at[: bound.unknowns], known, look_fresh.covariance, (guess, bound.prior_std[free], bound.start_std[free])
    )
    ways = np.vstack([made.ways, np.zeros((more, made.ways.shape[1]))])
    return Prior(at, ways, made.mean, made.stds, made.start)


def explanations(look: Look, *, linear: bool = False) -> list[Explanation]:
    """All causes that show in the rows, and single rows, the likeliest first.

    linear: causes to first order, which says nothing of where they leave the arm.
    """
    found = [*(_linear(look) if linear else _causes(look)), *_rows(look)]
    if not found:
        return []
    best = max(each.evidence for each in found)
    weights = [math.exp(each.evidence - best) for each in found]
    total = sum(weights)
    shared = [
        Explanation(e.cause, e.row, e.shift, e.std, e.p, e.left, e.evidence, w / total, e.posterior)
        for e, w in zip(found, weights, strict=True)
    ]
    return sorted(shared, key=lambda each: -each.share)


def contenders(found: list[Explanation]) -> list[Explanation]:
    """The likeliest ones that together are sure, and whatever is nearly as likely as the last of them."""
    chosen, total = list[Explanation](), 0.0
    for each in found:
        if total >= SURE or (chosen and each.share < NAMED):
            break
        chosen.append(each)
        total += each.share
    return chosen


def _causes(look: Look) -> list[Explanation]:
    prior, nothing = prior_of(look.fresh, look.shifted.unknowns), look.tests.whitened.chi_square
    freedom, noise = look.tests.whitened.freedom, look.tests.noise
    found = []
    for k, cause in enumerate(look.causes):
        if not look.seen(k):
            continue
        ways, used = ways_of(look, k)
        posterior = prior.with_ways(ways, np.ones(ways.shape[1])).given(look.shifted, most=STEPS, strict=False)
        n, chi = ways.shape[1], posterior.chi_square
        place = slice(len(posterior.v) - n, None)
        shift = used @ posterior.v[place]
        std = np.sqrt(np.maximum(np.diagonal(used @ posterior.covariance[place, place] @ used.T), 0.0))
        evidence = likelihood(chi, freedom, noise) - occam(look.slopes[k], cause.sizes)
        p = float(chances(np.array(max(nothing - chi, 0.0)), float(n), noise))
        left = float(chances(np.array(chi), float(freedom - n), noise))
        found.append(Explanation(cause, -1, shift, std, p, left, evidence, 0.0, posterior))
    return found


def _linear(look: Look) -> list[Explanation]:
    tests, found = look.tests, list[Explanation]()
    falls = tests.falls(tests.whitened.residual[None])[0][0]
    for k, cause in enumerate(look.causes):
        if look.seen(k):
            n, chi = int(tests.freedoms[k]), tests.whitened.chi_square - float(falls[k])
            evidence = likelihood(chi, tests.whitened.freedom, tests.noise) - occam(look.slopes[k], cause.sizes)
            left = float(chances(np.array(chi), float(tests.whitened.freedom - n), tests.noise))
            none, p = np.zeros(0), float(look.by_cause[k])
            found.append(Explanation(cause, -1, none, none, p, left, evidence, 0.0, None))
    return found


def ways_of(look: Look, k: int) -> tuple[Array, Array]:
    """Directions (n, r) in all unknowns along which a cause shows, and the same in its own (k, r)."""
    cause = look.causes[k]
    _, _, rows = np.linalg.svd(look.slopes[k] * cause.sizes, full_matrices=False)
    used = cause.sizes[:, None] * rows[: int(look.tests.freedoms[k])].T
    ways = np.zeros((look.shifted.unknowns, used.shape[1]))
    ways[cause.columns] = used
    return ways, used


def _rows(look: Look) -> list[Explanation]:
    tests = look.tests
    falls, nothing = tests.falls(tests.whitened.residual[None])[1][0], tests.whitened.chi_square
    judged = np.flatnonzero(tests.row_freedoms > 0)
    found = []
    for k in judged.tolist():
        n, chi = int(tests.row_freedoms[k]), nothing - float(falls[k])
        per_row = tests.rows.shape[2]
        alone = np.zeros((len(tests.whitened.residual), per_row))
        alone[k * per_row + np.arange(per_row), np.arange(per_row)] = 1.0
        cost = occam(tests.whitened.of_columns(alone), np.full(per_row, OFF)) + math.log(judged.size)
        evidence = likelihood(chi, tests.whitened.freedom, tests.noise) - cost
        left = float(chances(np.array(chi), float(tests.whitened.freedom - n), tests.noise))
        none = np.zeros(0)
        found.append(Explanation(None, k, none, none, float(look.by_row[k]), left, evidence, 0.0, None))
    return found

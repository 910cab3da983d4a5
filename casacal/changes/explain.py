"""Which cause explains the rows: each fitted with the earlier posterior as the prior, weighed by its evidence.

The evidence of a cause is the likelihood at its best, less what its freedom costs (Occam's factor, with changes of a
usual size, so that six numbers must explain more than one). A row that is off is a cause like any other, and which of N
rows it is costs the logarithm of N.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.changes.causes import Cause
from casacal.changes.look import Look, alone
from casacal.changes.posterior import Posterior, Prior
from casacal.uncertainty.fresh_rows import chance, likelihood, occam

OFF = 100.0
"""Times its noise by which a row that is off usually is: a turn of a pointer that was not counted, 1 mm of 0.01 mm."""

SURE = 0.95  # part of the evidence from which on one cause is the one
STEPS = 60  # of the fit of a cause: the right one needs five, and a wrong one may creep along a valley for ever
NAMED = 0.02  # part of the evidence below which a cause is none of those that remain


@dataclass(frozen=True, eq=False)
class Fitted:
    """A cause at its best: its unknowns (k,) with standard deviations, everything, and the ways (n, r) that show."""

    shift: Array
    std: Array
    posterior: Posterior
    ways: Array


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause, or a row that is off.

    share: part of the evidence. left: chance of what it leaves unexplained. p: chance of as much explained where
    nothing changed. fitted: of a cause, but to first order.
    """

    cause: Cause | None
    row: int
    p: float
    left: float
    evidence: float
    share: float = 0.0
    fitted: Fitted | None = None


def explanations(look: Look, *, linear: bool = False) -> list[Explanation]:
    """All causes that show in the rows, and single rows, the likeliest first.

    linear: causes to first order, which says nothing of where they leave the arm.
    """
    tests, prior = look.tests, None if linear else Prior.of(look.fresh, look.shifted.unknowns)
    by_cause, by_row, nothing = tests.found
    p_cause, p_row, _ = tests.p
    found = []
    for k, cause in enumerate(look.causes):
        if not look.seen(k):
            continue
        n, cost = int(tests.freedoms[k]), occam(look.slopes[k], cause.sizes)
        if prior is None:
            left, evidence = _judged(look, nothing - float(by_cause[k]), n, cost)
            found.append(Explanation(cause, -1, float(p_cause[k]), left, evidence))
            continue
        used = _shown(look, k)
        ways = np.zeros((look.shifted.unknowns, n))
        ways[cause.columns] = used
        posterior = prior.with_ways(ways, np.ones(n)).given(look.shifted, most=STEPS, strict=False)
        covariance = posterior.covariance[-n:, -n:]
        std = np.sqrt(np.maximum(np.diagonal(used @ covariance @ used.T), 0.0))
        left, evidence = _judged(look, posterior.chi_square, n, cost)
        p = chance(max(nothing - posterior.chi_square, 0.0), n, tests.noise)
        fitted = Fitted(used @ posterior.v[-n:], std, posterior, ways)
        found.append(Explanation(cause, -1, p, left, evidence, fitted=fitted))
    per_row = tests.rows.shape[2]
    for k in np.flatnonzero(tests.row_freedoms > 0).tolist():
        cost = occam(alone(tests.fresh, k, per_row), np.full(per_row, OFF)) + math.log(tests.judged)
        left, evidence = _judged(look, nothing - float(by_row[k]), int(tests.row_freedoms[k]), cost)
        found.append(Explanation(None, k, float(p_row[k]), left, evidence))
    best = max((each.evidence for each in found), default=0.0)
    weights = [math.exp(each.evidence - best) for each in found]
    shared = [replace(each, share=weight / sum(weights)) for each, weight in zip(found, weights, strict=True)]
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


def _judged(look: Look, chi_square: float, freedom: int, cost: float) -> tuple[float, float]:
    """Chance of the chi-square that is left, and the evidence, after so many directions of such a cost were fitted."""
    tests = look.tests
    whole = tests.fresh.freedom
    return chance(chi_square, whole - freedom, tests.noise), likelihood(chi_square, whole, tests.noise) - cost


def _shown(look: Look, k: int) -> Array:
    """Directions (k, r) in a cause's own unknowns along which it shows."""
    sizes = look.causes[k].sizes
    _, _, rows = np.linalg.svd(look.slopes[k] * sizes, full_matrices=False)
    return np.asarray(sizes[:, None] * rows[: int(look.tests.freedoms[k])].T)

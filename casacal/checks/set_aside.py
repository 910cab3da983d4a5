"""Rows that do not belong, set aside so that the others can be fitted: few, each with its line and why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.binding.bound_problem import BoundProblem, bind
from casacal.checks.check import strays
from casacal.checks.finding import Finding
from casacal.checks.outliers import GROSS, robust_fit, single_rows, studentised_outliers
from casacal.errors import CasacalError
from casacal.samples.samples import Samples
from casacal.uncertainty.prior_scatter import prior_scatter

MOST = 0.1
"""Part of the rows that may be set aside; where more are wrong, it is not single rows that are."""

ROUNDS = 3
"""Fits without the rows found before: large outliers hide small ones."""


def gross(bound: BoundProblem) -> tuple[NDArray[np.bool_], tuple[Finding, ...]]:
    """Rows (N,) of samples that chance does not explain, and what is wrong with them; none where they are many.

    First those far off their face with the arm as drawn, then those that a robust fit cannot explain. A plain fit says
    whether it is worth looking for these, so that clean samples cost one fit.

    Args:
        bound: a problem with one instrument and the samples that are to be fitted.

    """
    samples, none = bound.block.samples, np.zeros(len(bound.block.samples), dtype=bool)
    bad, findings = _off_their_face(bound, samples)
    for _ in range(ROUNDS):
        if bad.sum() > MOST * len(samples) or not _bindable(bound, bad):
            return none, ()
        kept = np.flatnonzero(~bad)
        rest = bound if not bad.any() else bind(bound.problem, samples.take(kept))
        if rest.rows <= rest.unknowns or (fitted := robust_fit(rest)) is None:
            break
        rest, result = fitted
        found = studentised_outliers(rest, result).rows if result.converged else ()
        if not found:
            break
        findings += single_rows(rest, result)
        bad[kept[list(found)]] = True
    if bad.sum() > MOST * len(samples) or not _bindable(bound, bad):
        return none, ()
    return bad, tuple(findings)


def _bindable(bound: BoundProblem, bad: NDArray[np.bool_]) -> bool:
    """Whether every face keeps as many rows as it needs for unknowns of its own."""
    if not bad.any():
        return True
    try:
        bind(bound.problem, bound.block.samples.take(np.flatnonzero(~bad)))
    except CasacalError:
        return False
    return True


def _off_their_face(bound: BoundProblem, samples: Samples) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Rows that lie nowhere near their face, and why; a quick look decides whether faces are fitted robustly."""
    scatter = prior_scatter(bound, flat_counts=True).rms
    worst = float(np.abs(bound.plain_residual(bound.x0)).max(initial=0.0))
    if not worst > GROSS * scatter:
        return np.zeros(len(samples), dtype=bool), []
    return strays(bound.problem, samples, scatter)

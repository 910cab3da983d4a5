"""Rows that do not belong, set aside so that the others can be fitted: few, each with its line and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.all_rows import each_alone
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.noise_scale import times
from casacal.checks.check import strays
from casacal.checks.finding import Finding
from casacal.checks.outliers import (
    GROSS,
    Outliers,
    most_by_chance,
    robust_fit,
    single_rows,
    studentised_outliers,
)
from casacal.errors import CasacalError
from casacal.estimators import lm
from casacal.least_squares.result import Result
from casacal.uncertainty.prior_moves import prior_scatter

MOST = 0.1
"""Part of the rows that may be set aside; where more are wrong, it is not single rows that are."""

ROUNDS = 3
"""Fits without the rows found before: large outliers hide small ones."""

WORTH_ANOTHER_LOOK = 10.0
"""Standard deviations from a fit without it up to which a row is asked once more whether it belongs."""


def gross(bound: BoundProblem, *, drawn: BoundProblem | None = None) -> tuple[NDArray[np.bool_], tuple[Finding, ...]]:
    """Rows (N,) of samples that chance does not explain, and what is wrong with them; none where they are many.

    First those far off their face with the arm as drawn, then those that a robust fit cannot explain. A plain fit says
    whether it is worth looking for these, so that clean samples cost one fit.

    Args:
        bound: a problem and the samples that are to be fitted; with effects beside the geometry, their sizes and the
            noise as found.
        drawn: the same rows under the geometry alone, which says what lies far off with the arm as drawn.

    """
    none = np.zeros(len(bound.measured), dtype=bool)
    stray, findings = _off_their_face(drawn or bound)
    bad = stray.copy()
    for _ in range(ROUNDS):
        rest = _without(bound, bad)
        if rest is None:
            return none, ()
        found = _outliers(rest)
        if not found.any():
            break
        bad[np.flatnonzero(~bad)[found]] = True
    if (bad & ~stray).any():
        bad = _taken_back(bound, bad, stray)
    rest = _without(bound, bad)
    if rest is not None and any(bound.beside):  # where much is known beside the geometry, others may expect a row so
        bad &= stray | ~_expected(*_judged(rest, bound))
        rest = _without(bound, bad)
    if rest is None:
        return none, ()
    if (bad & ~stray).any():
        findings += _told(*_judged(rest, bound), np.flatnonzero(bad & ~stray))
    return bad, tuple(findings)


def _without(bound: BoundProblem, bad: NDArray[np.bool_]) -> BoundProblem | None:
    """The other rows; None where these are too few in all, or on a face for unknowns of its own."""
    if not bad.any():
        return bound
    if bad.sum() > MOST * len(bad):
        return None
    rest = bound.measured.take(np.flatnonzero(~bad)).sets
    try:
        return bound.on(*rest) if any(bound.beside) else bind(bound.problem, *rest)
    except CasacalError:
        return None


def _outliers(bound: BoundProblem) -> NDArray[np.bool_]:
    """Rows (N,) that a robust fit of them all cannot explain."""
    found = np.zeros(len(bound.measured), dtype=bool)
    if bound.rows > _geometry(bound) and (fitted := robust_fit(bound)) is not None and fitted[1].converged:
        found[list(studentised_outliers(*fitted).rows)] = True
    return found


def _geometry(bound: BoundProblem) -> int:
    """How many unknowns the rows must hold: those of effects stand at zero unless rows say more."""
    return bound.beside.count("")


def _taken_back(bound: BoundProblem, bad: NDArray[np.bool_], stray: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Rows (N,) that stay aside; what only looked odd beside a gross row comes back."""
    rest = _without(bound, bad)
    if rest is None:
        return bad
    judged, result = _judged(rest, bound)
    again = bad & ~stray & (_sizes(judged, result) < WORTH_ANOTHER_LOOK)
    more = _without(bound, bad & ~again)
    if not again.any() or more is None:
        return bad
    held: NDArray[np.bool_] = bad & ~again
    held[np.flatnonzero(~held)[_outliers(more)]] = True
    held &= bad
    return held


def _expected(judged: BoundProblem, result: Result) -> NDArray[np.bool_]:
    """Rows (N,) that stand where chance may put them for a fit, whether it has seen them or not."""
    return np.asarray(_sizes(judged, result) <= _most(judged))


def _sizes(judged: BoundProblem, result: Result) -> Array:
    """How far rows (N,) are off, in standard deviations of their noise."""
    return judged.largest(np.abs(judged.residual(result.x)))


def _most(judged: BoundProblem) -> float:
    """How far chance may put the farthest of them."""
    return most_by_chance(judged.rows, judged.rows - _geometry(judged))


def _told(judged: BoundProblem, result: Result, rows: NDArray[np.intp]) -> list[Finding]:
    """What is wrong with rows that a fit has not seen."""
    worst = float(_sizes(judged, result)[rows].max())
    return single_rows(judged, result, Outliers(tuple(rows.tolist()), worst, _most(judged), 1.0))


def _judged(rest: BoundProblem, whole: BoundProblem) -> tuple[BoundProblem, Result]:
    """All rows with the noise that the rest shows, and a fit of the rest alone."""
    result = lm(rest)
    noise = 1.4826 * float(np.median(np.abs(rest.residual(result.x))))
    return rest.on(*whole.samples).with_noise(times(rest.scale, max(noise, 1.0))), result


def _off_their_face(bound: BoundProblem) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Rows that lie nowhere near their face, and why; a quick look decides whether faces are fitted robustly."""
    scatter = prior_scatter(bound, flat_counts=True).rms
    worst = float(np.abs(bound.plain_residual(bound.x0)).max(initial=0.0))
    if not worst > GROSS * scatter:
        return np.zeros(len(bound.measured), dtype=bool), []
    bad, findings = [], []
    for alone in each_alone(bound.problem, bound.samples):
        mine, told = strays(alone.problem, alone.samples, scatter)
        bad.append(mine)
        findings += [replace(each, instrument=alone.name) for each in told]
    return np.concatenate(bad), findings

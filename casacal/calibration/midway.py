"""Rows that fit up to some line and not beyond it: at which line, and what seems to have changed there.

Labels exchanged from some row on, a dial turned round, columns swapped: each part may fit by itself, and no mistake
made in all rows explains them.
"""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from casacal.calibration.cause import explained
from casacal.calibration.faults import MOST_FACES, SUSPICIOUS, exchanged
from casacal.calibration.finding import Finding, misfit
from casacal.data.samples import Samples, joined
from casacal.errors import CasacalError
from casacal.fit.bound_problem import bind
from casacal.fit.lm import lm
from casacal.model.problem import Problem
from casacal.uncertainty.figures import effective_unknowns
from casacal.wording import times

SOMETHING = "something changed"
FEWEST = 20  # rows that must fit by themselves; fewer fit to anything
FEW_LEFT = 5  # rows beyond the line; fewer are single rows
UNEXPECTED = 25.0  # chi-square of a row that those before it do not expect: five standard deviations
LEFT_OVER = 5.0  # rows beyond what their fit needs that the good ones must have
FAR_OFF = 5.0  # standard deviations by which most of the others must lie off

TRIMMED = 0.85  # part of the rows that a robust fit takes for good which surely are: it bears a tenth of others


def changed_midway(problem: Problem, samples: Samples) -> Finding | None:
    """An error where rows on one side of a line fit by themselves and the others do not fit to them; else None."""
    count = len(samples)
    for backwards in (False, True):
        rows = samples.take(range(count)[:: -1 if backwards else 1])
        place = _first_unexpected(problem, rows)
        if place is None or count - place < FEW_LEFT:
            continue
        good, rest = (samples.take(range(place)), samples.take(range(place, count)))
        if backwards:
            good, rest = samples.take(range(count - place, count)), samples.take(range(count - place))
        if not _surprising(problem, good, rest):
            continue
        line = rest.lines[-1 if backwards else 0]
        where = f"up to line {line}" if backwards else f"from line {line} on"
        base = misfit(problem, rest)
        if (named := _exchanged(problem, good, rest)) is not None:
            about, cause, fix = named
        elif base > SUSPICIOUS and (own := explained(problem, rest, base, whole=rest)) is not None:
            about, cause, fix = own.finding.about, own.finding.cause, f"Mend these rows alone: {own.finding.fix}"
        else:
            about, cause = SOMETHING, "they fit by themselves too, but not to the others"
            if base > SUSPICIOUS:
                cause = f"they do not fit ({times(base)} times the stated noise by themselves)"
            fix = "Find out what was changed there: arm, base, tool, dial, faces or the recording; measure those rows "
            fix += "again"
        alone = "the later lines fit by themselves" if backwards else "the lines before fit by themselves"
        return Finding("error", f"{about} {where}", f"{alone}, and {where} {cause}", fix)
    return None


def _first_unexpected(problem: Problem, samples: Samples) -> int | None:
    """How many rows fit before the first that those before it do not expect; None where too few do."""
    fits, fails = FEWEST, len(samples)
    if fits >= fails or misfit(problem, samples.take(range(fits))) > SUSPICIOUS:
        return None
    while fails - fits > 1:
        middle = (fits + fails) // 2
        good = misfit(problem, samples.take(range(middle))) <= SUSPICIOUS
        fits, fails = (middle, fails) if good else (fits, middle)
    before = math.inf
    for place in range(max(FEWEST, int(TRIMMED * fits)), fails + 1):
        try:
            found = lm(bind(problem, samples.take(range(place))))
        except CasacalError:  # a face of too few rows so far
            continue
        if 2 * (found.cost - before) > UNEXPECTED * max(2 * before / place, 1.0):
            return place - 1
        before = found.cost
    return fits


def _surprising(problem: Problem, good: Samples, rest: Samples) -> bool:
    """Whether good rows, more than their fit needs, do not expect most of the others by far.

    Where the model is wrong everywhere, or the noise is, the first rows fit as well, if they are few.
    """
    whole = bind(problem, joined(good, rest))
    part, later = whole.take(range(len(good))), whole.take(range(len(good), len(whole.measured)))
    found = lm(part)
    if not found.converged or part.rows - effective_unknowns(part, found.x) < LEFT_OVER:
        return False
    jacobian, covariance = later.jacobian(found.x), found.covariance
    known = np.isfinite(np.diagonal(covariance))  # but for faces that the good rows do not show
    spread = np.einsum("ij,jk,ik->i", jacobian[:, known], covariance[np.ix_(known, known)], jacobian[:, known])
    told = (jacobian[:, ~known] == 0).all(axis=1)
    off = np.abs(later.residual(found.x)[told]) / np.sqrt(1 + spread[told])
    return bool(off.size) and float(np.median(off)) > FAR_OFF


def labels_exchanged(problem: Problem, samples: Samples, moved: Samples) -> Finding | None:
    """An error where faces only seem to have moved, as two labels were exchanged from some row on; else None.

    moved: the rows with the faces named otherwise from there on.
    """
    column = problem.instrument.groups
    later = np.flatnonzero(moved.faces(column).codes >= len(samples.faces(column).names))
    if not later.size:
        return None
    good, rest = samples.take(range(int(later[0]))), samples.take(range(int(later[0]), len(samples)))
    named = _exchanged(problem, good, rest)
    if named is None:
        return None
    about, cause, fix = named
    where = f"from line {rest.lines[0]} on"
    return Finding("error", f"{about} {where}", f"{where} {cause}", fix)


def _exchanged(problem: Problem, good: Samples, rest: Samples) -> tuple[str, str, str] | None:
    """Name, cause and cure of two labels that are exchanged in some rows alone; None where none are."""
    column = problem.instrument.groups
    names = () if column is None else rest.faces(column).names
    for one, two in combinations(names if len(names) <= MOST_FACES else (), 2):
        mended = exchanged(rest, column=column or "", names={one: two, two: one})
        if misfit(problem, joined(good, mended)) <= SUSPICIOUS:
            cause = f"'{one}' and '{two}' seem to be exchanged"
            return "labels exchanged", cause, "Correct the labels there"
    return None

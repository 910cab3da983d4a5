"""Rows that fit up to some line and not beyond it: at which line, and what seems to have changed there.

A joint whose encoder slipped, labels exchanged from some row on, a dial turned round, a value that a recorder repeats:
each part may fit by itself, and no mistake made in all rows explains them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from casacal.calibration.faults import MOST_FACES, SUSPICIOUS, explained, fitted_sizes
from casacal.calibration.finding import Finding, misfit
from casacal.data.columns import Labels
from casacal.data.samples import Samples, joined
from casacal.errors import CasacalError
from casacal.fit.bound_problem import bind
from casacal.fit.lm import lm
from casacal.model.problem import Problem
from casacal.uncertainty.figures import effective_unknowns
from casacal.wording import times

SOMETHING = "something changed"
FEWEST = 20  # rows that must fit by themselves; fewer fit to much
FEW_LEFT = 5  # rows beyond the line; fewer are single rows
UNEXPECTED = 25.0  # chi-square of a row that those before it do not expect: five standard deviations
LEFT_OVER = 5.0  # rows beyond what their fit needs that the good ones must have
FAR_OFF = 5.0  # standard deviations by which most of the others must lie off
STUCK = 1e-9  # rad or mm within which a joint does not move

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
        about, cause, fix = _what_changed(problem, good, rest)
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


def _what_changed(problem: Problem, good: Samples, rest: Samples) -> tuple[str, str, str]:
    """Name, cause and cure of what is otherwise in some rows than in the good ones."""
    for i in np.flatnonzero(np.ptp(rest.joints, axis=0) < STUCK).tolist():
        if np.ptp(good.joints[:, i]) > STUCK:
            cause = f"joint {i + 1} shows one and the same value, as of an encoder or a recorder that hangs"
            return f"joint {i + 1} stuck", cause, "Measure these rows again"
    base, tried = misfit(problem, rest), list[tuple[float, str, str, str]]()
    for about, change, cause, fix in _changes(problem, good, rest):
        tried.append((misfit(problem, change), about, cause, fix))
    if tried and (best := min(tried))[0] <= SUSPICIOUS:
        return best[1:]
    if base > SUSPICIOUS and (own := explained(problem, rest, base, whole=rest)) is not None:
        return own.finding.about, own.finding.cause, f"Mend these rows alone: {own.finding.fix}"
    cause = (
        f"they do not fit ({times(base)} times the stated noise by themselves)"
        if base > SUSPICIOUS
        else ("they fit by themselves too, but not to the others")
    )
    fix = "Find out what was changed there: arm, base, tool, dial, faces or the recording; measure those rows again"
    return SOMETHING, cause, fix


def _changes(problem: Problem, good: Samples, rest: Samples) -> Iterator[tuple[str, Samples, str, str]]:
    """Name, all rows with it undone, cause and cure of what may be otherwise in some rows alone."""
    for i in np.flatnonzero(problem.robot.revolute).tolist():
        undone: Callable[..., Samples] = partial(_slipped_back, good, rest, joint=i)
        (size,) = fitted_sizes(problem, joined(good, rest), lambda _, by, undone=undone: undone(by))
        if size:
            cause = f"joint {i + 1} seems to have slipped by {math.degrees(size):+.3g} degrees"
            yield f"joint {i + 1} slipped", undone(size), cause, "Master that joint, and measure again"
    column = problem.instrument.groups
    names = () if column is None else rest.faces(column).names
    for one, two in combinations(range(len(names)), 2) if len(names) <= MOST_FACES else ():
        labels = rest.faces(column)
        codes = labels.codes.copy()
        codes[labels.codes == one], codes[labels.codes == two] = two, one
        mended = replace(rest, labels={**rest.labels, column or "": Labels(names, codes)})
        cause = f"'{names[one]}' and '{names[two]}' seem to be exchanged"
        yield "labels exchanged", joined(good, mended), cause, "Correct the labels there"


def _slipped_back(good: Samples, rest: Samples, by: float, *, joint: int) -> Samples:
    """All rows with a joint's angle in some of them less by so much."""
    joints = rest.joints.copy()
    joints[:, joint] -= by
    return joined(good, replace(rest, joints=joints))

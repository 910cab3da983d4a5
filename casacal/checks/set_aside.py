"""Rows that do not belong, set aside so that the others can be fitted: few, each with its line and why."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind, each_alone
from casacal.binding.noise_scale import times
from casacal.binding.nominal import nominal_tips
from casacal.checks.finding import Finding
from casacal.checks.outliers import Outliers, most_by_chance, robust_fit, single_rows, studentised_outliers
from casacal.errors import CasacalError, SamplesError
from casacal.estimators import lm
from casacal.least_squares.result import Result
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.prior_moves import prior_scatter
from casacal.unknowns.fits import fitted_plane
from casacal.wording import counted

MOST = 0.1  # part of the rows that may be set aside; where more are wrong, it is not single rows that are
ROUNDS = 3  # fits without the rows found before: large outliers hide small ones

WORTH_ANOTHER_LOOK = 10.0
"""Standard deviations from a fit without it up to which a row is asked once more whether it belongs."""
SUBSETS = 300  # random planes through three tips tried for the least median of squares
JUDGES = 5_000  # tips, drawn at random, whose median judges them
GROSS = 8.0  # times the robust scatter beyond which a nominal tip is not on its plane at all
ONES_OWN = 2  # rows whose joints may be another row's, pasted or shifted by one, rather than their labels wrong
MOST_STRAYS = 0.3  # beyond this fraction of the rows, it is not single rows that are wrong


def gross(bound: BoundProblem, *, drawn: BoundProblem | None = None) -> tuple[NDArray[np.bool_], tuple[Finding, ...]]:
    """Rows (N,) of samples that chance does not explain, and what is wrong with them; none where they are many.

    First those far off their face with the arm as drawn, then those that a robust fit cannot explain. A plain fit says
    whether it is worth looking for these, so that clean samples cost one fit.

    bound: the rows to be fitted; with effects beside the geometry, their sizes and the noise as found. drawn: the same
    under the geometry alone, which says what lies far off with the arm as drawn.

    Raises SamplesError where it is half the rows of one of several instruments.
    """
    none = np.zeros(len(bound.measured), dtype=bool)
    drawn = drawn or bound
    stray, findings = off_their_face(drawn, prior_scatter(drawn, flat_counts=True).rms)
    bad = stray.copy()
    for _ in range(ROUNDS):
        rest = _without(bound, bad)
        if rest is None:
            return none, ()
        found = _outliers(rest)
        if not found.any():
            break
        bad[np.flatnonzero(~bad)[found]] = True
        _refuse_contradiction(bound, bad)
    if (bad & ~stray).any():
        bad = _taken_back(bound, bad, stray)
    rest = _without(bound, bad)
    if rest is not None and any(bound.beside):  # where much is known beside the geometry, others may expect a row so
        judged, result = _judged(rest, bound)
        bad &= stray | (_sizes(judged, result) > _most(judged))
        rest = _without(bound, bad)
    if rest is None:
        return none, ()
    if (bad & ~stray).any():
        judged, result = _judged(rest, bound)
        rows = np.flatnonzero(bad & ~stray)
        worst = float(_sizes(judged, result)[rows].max())
        findings += single_rows(judged, result, Outliers(tuple(rows.tolist()), worst, _most(judged), 1.0))
    return bad, tuple(findings)


def _refuse_contradiction(bound: BoundProblem, bad: NDArray[np.bool_]) -> None:
    """Raise SamplesError where half the rows of one of several instruments do not belong: these are not single rows."""
    if bad.sum() > MOST * len(bad):  # too many for single rows anyway: none is set aside, and the check finds the cause
        return
    starts = np.cumsum([0, *map(len, bound.samples)])
    for k, (name, some) in enumerate(zip(bound.problem.names, bound.samples, strict=True)):
        off = int(bad[starts[k] : starts[k + 1]].sum())
        if len(bound.samples) > 1 and 2 * off >= len(some):
            what = f"the instruments contradict each other: {off} of {counted(len(some), 'row')} of {name} lie far off"
            fix = f"Check unit, sign, frame and tool of {name}, and what is shared with it; or leave its rows out"
            raise SamplesError(some.file, f"{what} where the others put the arm", fix)


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
    # what the rows must hold is the geometry: unknowns of effects stand at zero unless rows say more
    if bound.rows > bound.beside.count("") and (fitted := robust_fit(bound)) is not None and fitted[1].converged:
        found[list(studentised_outliers(*fitted).rows)] = True
    return found


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


def _sizes(judged: BoundProblem, result: Result) -> Array:
    """How far rows (N,) are off, in standard deviations of their noise."""
    return judged.largest(np.abs(judged.residual(result.x)))


def _most(judged: BoundProblem) -> float:
    """How far chance may put the farthest of them."""
    return most_by_chance(judged.rows, judged.rows - judged.beside.count(""))


def _judged(rest: BoundProblem, whole: BoundProblem) -> tuple[BoundProblem, Result]:
    """All rows with the noise that the rest shows, and a fit of the rest alone."""
    result = lm(rest)
    noise = 1.4826 * float(np.median(np.abs(rest.residual(result.x))))
    return rest.on(*whole.samples).with_noise(times(rest.scale, max(noise, 1.0))), result


def off_their_face(bound: BoundProblem, scatter: float) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Rows that lie nowhere near their face, and why; a quick look decides whether faces are fitted robustly.

    scatter: distance (mm) that prior errors of the arm explain.
    """
    worst = float(np.abs(bound.plain_residual(bound.x0)).max(initial=0.0))
    if not worst > GROSS * scatter:
        return np.zeros(len(bound.measured), dtype=bool), []
    bad, findings = [], []
    for alone in each_alone(bound.problem, bound.samples):
        mine, told = strays(alone.problem, alone.samples, scatter)
        bad.append(mine)
        findings += [replace(each, instrument=alone.name) for each in told]
    return np.concatenate(bad), findings


def strays(problem: Problem, samples: Samples, scatter: float) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Rows (N,) far off their plane before any fit, with what that means; none where most rows are off.

    Least median of squares per label (Rousseeuw 1984), which survives almost half of the rows being wrong.
    problem: with one instrument. scatter: distance (mm) that prior errors of the arm explain.
    """
    bad, planes = np.zeros(len(samples), dtype=bool), dict[str, Array]()
    if problem.instrument.probe is None:
        return bad, []
    tips, faces = nominal_tips(problem, 0, samples), samples.faces(problem.instrument.groups)
    for label, rows in faces.rows().items():
        if len(rows) >= 8:
            planes[label], size = _median_plane(tips[rows])
            bad[rows] = np.abs(tips[rows] @ planes[label][:3] - planes[label][3]) > GROSS * max(size, scatter)
    if not bad.any() or bad.mean() > MOST_STRAYS:
        return np.zeros(len(samples), dtype=bool), []
    home, lost = defaultdict[tuple[str, str], list[int]](list), list[int]()
    for i in np.flatnonzero(bad).tolist():
        fits = [name for name, plane in planes.items() if abs(tips[i] @ plane[:3] - plane[3]) < GROSS * scatter]
        if fits and faces[i] not in fits:
            home[faces[i], fits[0]].append(samples.lines[i])
        else:
            lost.append(samples.lines[i])
    findings = []
    for (label, its), lines in home.items():
        cause = f"{counted(len(lines))} labelled '{label}' fit{'s' if len(lines) == 1 else ''} '{its}'"
        fix = "Correct the labels" + (", or the joints, if they are another row's" if len(lines) <= ONES_OWN else "")
        findings.append(Finding("error", "labels exchanged", cause, fix, tuple(lines)))
    if lost:
        cause = "the tips are far from every plane, even with the arm as drawn"
        fix = "Check joints and readings of these rows, or remove them"
        findings.append(Finding("error", "outliers", cause, fix, tuple(lost)))
    return bad, findings


def _median_plane(tips: Array) -> tuple[Array, float]:
    """Plane (n, c) with the smallest median distance of the tips, and their robust scatter."""
    rng = np.random.default_rng(0)
    best, plane = math.inf, np.array([0.0, 0.0, 1.0, 0.0])
    judges = tips if len(tips) <= JUDGES else tips[rng.choice(len(tips), JUDGES, replace=False)]
    for _ in range(SUBSETS):
        a, b, c = judges[rng.choice(len(judges), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            continue
        normal = normal / length
        middle = float(np.median(np.abs((judges - a) @ normal)))
        if middle < best:
            best, plane = middle, np.array([*normal, normal @ a])
    near = np.abs(tips @ plane[:3] - plane[3]) <= 2.5 * 1.4826 * best + 1e-9
    fitted = fitted_plane(tips[near])
    refined = np.array([*fitted.normal, fitted.normal @ fitted.centre])
    return refined, 1.4826 * float(np.median(np.abs(tips @ fitted.normal - refined[3])))

"""Single rows that do not belong: gross ones before a fit, studentised residuals after it, exchanged labels."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import times
from casacal.binding.nominal import nominal_tips
from casacal.checks.dial import lost_turns
from casacal.checks.finding import Finding
from casacal.estimators import lm
from casacal.least_squares.losses import huber
from casacal.least_squares.result import Result
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.figures import leverages
from casacal.unknowns.fits import fitted_plane
from casacal.wording import counted

SUBSETS = 300  # random planes through three tips tried for the least median of squares
JUDGES = 5_000  # tips, drawn at random, whose median judges them
GROSS = 8.0  # times the robust scatter beyond which a nominal tip is not on its plane at all
FEWEST_OF_A_FACE = 12  # rows of a face that can tell how rough it is
WORTH_A_LOOK = 0.05
"""Chance of the largest residual of a plain fit, were all normal, below which a robust fit looks for outliers."""
ONES_OWN = 2  # rows whose joints may be another row's, pasted or shifted by one, rather than their labels wrong
CHANCE = 1e-4  # chance that a clean set has any row called an outlier (Bonferroni)


def gross_rows(problem: Problem, samples: Samples, scatter: float) -> tuple[NDArray[np.bool_], dict[str, Array]]:
    """Rows (N,) whose nominal tip lies far off its plane, and a robust plane (n, c) of each label.

    Least median of squares per label (Rousseeuw 1984), which survives almost half of the rows being wrong.

    Args:
        problem: with a touched plane.
        samples: its rows.
        scatter: distance (mm) that prior errors of the arm explain.

    """
    tips, faces = nominal_tips(problem, 0, samples), samples.faces(problem.instrument.groups)
    bad, planes = np.zeros(len(samples), dtype=bool), {}
    for label, rows in faces.rows().items():
        if len(rows) < 8:
            continue
        plane, size = _median_plane(tips[rows])
        planes[label] = plane
        bad[rows] = np.abs(tips[rows] @ plane[:3] - plane[3]) > GROSS * max(size, scatter)
    return bad, planes


def exchanged_labels(
    problem: Problem, samples: Samples, bad: NDArray[np.bool_], planes: dict[str, Array], scatter: float
) -> list[Finding]:
    """Gross rows that lie on another label's plane, and gross rows that lie on none."""
    tips, faces = nominal_tips(problem, 0, samples), samples.faces(problem.instrument.groups)
    home: dict[tuple[str, str], list[int]] = defaultdict(list)
    lost = []
    for i in np.flatnonzero(bad).tolist():
        label = faces[i]
        fits = [name for name, plane in planes.items() if abs(tips[i] @ plane[:3] - plane[3]) < GROSS * scatter]
        if fits and label not in fits:
            home[label, fits[0]].append(samples.lines[i])
        else:
            lost.append(samples.lines[i])
    findings = [
        Finding(
            "error", "labels exchanged",
            f"{counted(len(lines))} labelled '{label}' fit{'s' if len(lines) == 1 else ''} '{fits}'",
            "Correct the labels" + (", or the joints, if they are another row's" if len(lines) <= ONES_OWN else ""),
            tuple(lines),
        )
        for (label, fits), lines in home.items()
    ]  # fmt: skip
    if lost:
        findings.append(
            Finding(
                "error", "outliers", "the tips are far from every plane, even with the arm as drawn",
                "Check joints and readings of these rows, or remove them", tuple(lost),
            )
        )  # fmt: skip
    return findings


@dataclass(frozen=True)
class Outliers:
    """Rows of a robust fit that chance does not explain: places (m,) in the samples, the worst first, and sizes."""

    rows: tuple[int, ...]
    worst: float  # size of the largest, in standard deviations
    limit: float  # size that chance explains
    scale: float  # robust noise over what was used, of all rows


def robust_fit(bound: BoundProblem) -> tuple[BoundProblem, Result] | None:
    """A fit that gross rows hardly pull, with the noise that the others show; None where no row is worth a look.

    Huber's bends come with the noise: with a stated one that is far too small, the fit would hang on to some rows and
    call the others gross.
    """
    from scipy.special import ndtri

    size = np.abs(bound.residual(lm(bound).x))
    noise = 1.4826 * float(np.median(size))
    if not float(size.max(initial=0.0)) > -float(ndtri(WORTH_A_LOOK / (2 * bound.rows))) * noise:
        return None
    used = bound.with_noise(times(bound.scale, max(noise, 1.0)))
    return used, lm(used, loss=huber())


def studentised_outliers(bound: BoundProblem, result: Result) -> Outliers:
    """Rows whose deleted residual is larger than chance allows, at a robust fit.

    Externally studentised: r_k over its own standard deviation with the row's leverage taken out, the noise from the
    other rows (Cook and Weisberg 1982). The robust scale keeps several outliers from hiding each other.
    """
    r = bound.residual(result.x)
    leverage = np.minimum(leverages(bound, result), 0.999)
    free = max(float(bound.rows - leverage.sum()), 1.0)
    alike = np.abs(r) / np.sqrt(1 - leverage)  # of the same spread, also where faces of few rows take much of it
    scale = max(1.4826 * float(np.median(alike)), 1e-12)
    size = alike / _scale_of_rows(bound, alike, scale)
    limit = most_by_chance(bound.rows, free)
    bad = np.flatnonzero(size > limit)
    rows = tuple(dict.fromkeys(bound.sample_of[bad[np.argsort(-size[bad])]].tolist()))
    return Outliers(rows, float(size.max()), limit, scale)


def most_by_chance(rows: int, free: float) -> float:
    """Size (standard deviations) of the largest of so many residuals that chance explains, the noise from `free`."""
    from scipy.special import stdtrit  # Student's quantile, without the half second that importing scipy.stats takes

    return float(stdtrit(max(free, 1.0), 1 - CHANCE / (2 * rows)))


def _scale_of_rows(bound: BoundProblem, sizes: Array, scale: float) -> Array:
    """Robust noise (rows,): that of all rows, or of the row's own face where that is rougher."""
    faces = bound.faces
    own = np.full(len(faces.names), scale)
    for k, rows in enumerate(faces.rows().values()):
        if rows.size >= FEWEST_OF_A_FACE:
            own[k] = max(1.4826 * float(np.median(sizes[bound.residuals_of(rows)])), scale)
    return own[faces.codes][bound.sample_of]


def single_rows(bound: BoundProblem, result: Result, found: Outliers) -> list[Finding]:
    """Errors on rows that chance does not explain: lost turns of the pointer, and what is left.

    Args:
        bound: with all rows.
        result: a fit that these rows hardly pull.
        found: the rows.

    """
    if not found.rows:
        return []
    findings = []
    for i, own in enumerate(bound.measured.apart(np.array(found.rows, dtype=np.intp))):
        if own.size:
            findings += _of_instrument(bound, result, found, i, own.tolist())
    return findings


def _of_instrument(bound: BoundProblem, result: Result, found: Outliers, i: int, own: list[int]) -> list[Finding]:
    """The same of rows of instrument `i`, numbered within it."""
    samples = bound.samples[i]
    name = bound.problem.names[i] if len(bound.samples) > 1 else ""
    turns = lost_turns(bound, result, own, found.scale, i)
    findings = [
        Finding(
            "error",
            "lost revolution",
            f"with {by:+.3g} mm added to the reading {'this row fits' if len(rows) == 1 else 'these rows fit'}: "
            f"{counted(abs(turned), 'turn')} of a pointer that shows {abs(by / turned):g} mm",
            "Measure again, or correct the reading if the pointer was misread",
            tuple(sorted(samples.lines[k] for k in rows)),
            name,
        )
        for (by, turned), rows in turns.items()
    ]
    explained = {k for rows in turns.values() for k in rows}
    lines = tuple(sorted(samples.lines[k] for k in own if k not in explained))
    if lines:
        cause = (
            f"{counted(len(lines))} off by up to {found.worst:.0f} standard deviations; more than {found.limit:.1f} is "
        )
        fix = "Measure them again or remove them; calibrate leaves them out if they are few"
        findings.append(Finding("error", "outliers", f"{cause}not chance", fix, lines, name))
    return findings


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

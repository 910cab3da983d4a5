"""Single rows that do not belong: studentised residuals of a robust fit, and turns of a pointer that were lost."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import times
from casacal.binding.nominal import nominal_sight
from casacal.checks.finding import Finding
from casacal.estimators import lm
from casacal.instruments.description import readings_within
from casacal.least_squares.losses import huber
from casacal.least_squares.result import Result
from casacal.uncertainty.figures import leverages
from casacal.wording import counted

FEWEST_OF_A_FACE = 12  # rows of a face that can tell how rough it is
WORTH_A_LOOK = 0.05
"""Chance of the largest residual of a plain fit, were all normal, below which a robust fit looks for outliers."""
REGION = 0.1  # part of a face's spread of touches within which these are of one region
ALONG = math.cos(math.radians(10))  # of the angle up to which plungers stand alike
SHARED_BY_FEW = 15.0  # standard deviations beyond which a row is wrong even where its neighbours are off as well
CHANCE = 1e-4  # chance that a clean set has any row called an outlier (Bonferroni)


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
    other rows (Cook and Weisberg 1982). The robust scale keeps several outliers from hiding each other. Rows of one
    region that are off together are none: what they share is the arm's or the face's.
    """
    r = bound.residual(result.x)
    leverage = np.minimum(leverages(bound, result), 0.999)
    free = max(float(bound.rows - leverage.sum()), 1.0)
    alike = np.abs(r) / np.sqrt(1 - leverage)  # of the same spread, also where faces of few rows take much of it
    scale = max(1.4826 * float(np.median(alike)), 1e-12)
    size = alike / _scale_of_rows(bound, alike, scale)
    limit = most_by_chance(bound.rows, free)
    bad = np.flatnonzero(size > limit)
    bad = bad[~_of_a_region(bound, np.sign(r) * size, bad)]
    rows = tuple(dict.fromkeys(bound.sample_of[bad[np.argsort(-size[bad])]].tolist()))
    return Outliers(rows, float(size.max()), limit, scale)


def _of_a_region(bound: BoundProblem, sizes: Array, bad: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which of some residuals (m,) are off as most touches of their region are: to the same side, by a third or more.

    sizes: of all residuals (rows,), signed, in standard deviations. A region is a part of one face that was touched
    with the plunger along nearly one line. No region of an arm is off by as much as a misread dial.
    """
    found = np.zeros(bad.size, dtype=bool)
    for i, samples in enumerate(bound.samples):
        own = bound.sample_rows(i)
        here = [k for k in np.flatnonzero(np.abs(sizes[bad]) < SHARED_BY_FEW) if own.start <= bad[k] < own.stop]
        if not here or bound.problem.instruments[i].probe is None:
            continue
        sight, faces = nominal_sight(bound.problem, i, samples), samples.faces(bound.problem.instruments[i].groups)
        signed = sizes[own]
        for k in here:
            row = bad[k] - own.start
            face = faces.codes == faces.codes[row]
            spread = float(np.sqrt(sight.tips[face].var(axis=0).sum()))
            near = face & (np.linalg.norm(sight.tips - sight.tips[row], axis=1) < REGION * spread)
            if sight.plungers is not None:
                near &= sight.plungers @ sight.plungers[row] > ALONG
            near[row] = False
            agree = signed[near] * np.sign(signed[row]) >= abs(signed[row]) / 3
            found[k] = agree.sum() > (~agree).sum()
    return found


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

    bound: with all rows. result: a fit that these rows hardly pull.
    """
    findings = list[Finding]()
    for i, own in enumerate(bound.measured.apart(np.array(found.rows, dtype=np.intp))):
        if own.size:
            findings += _of_instrument(bound, result, found, i, own.tolist())
    return findings


def _of_instrument(bound: BoundProblem, result: Result, found: Outliers, i: int, own: list[int]) -> list[Finding]:
    """The same of rows of instrument `i`, numbered within it."""
    samples = bound.samples[i]
    name = bound.problem.names[i] if len(bound.samples) > 1 else ""
    turns = lost_turns(bound, result, own, found.scale, i)
    findings = []
    for (by, turned), rows in turns.items():
        fits = "this row fits" if len(rows) == 1 else "these rows fit"
        dial = f"{counted(abs(turned), 'turn')} of a pointer that shows {abs(by / turned):g} mm"
        fix = "Measure again, or correct the reading if the pointer was misread"
        lines = tuple(sorted(samples.lines[k] for k in rows))
        cause = f"with {by:+.3g} mm added to the reading {fits}: {dial}"
        findings.append(Finding("error", "lost revolution", cause, fix, lines, name))
    explained = {k for rows in turns.values() for k in rows}
    lines = tuple(sorted(samples.lines[k] for k in own if k not in explained))
    if lines:
        off = f"{counted(len(lines))} off by up to {found.worst:.0f} standard deviations"
        fix = "Measure them again or remove them; calibrate leaves them out where they are few"
        cause = f"{off}; more than {found.limit:.1f} is not chance"
        findings.append(Finding("error", "outliers", cause, fix, lines, name))
    return findings


TURNS_MM = (1.0, 0.5, 2.54, 0.2)
"""What one turn of a pointer shows, by the dials that are sold; several turns are only looked for of the first."""
SHORT_TRAVEL = 2.0  # travel (mm) up to which a dial has turns of less than half a millimetre
MOST_TURNS = 3
SURE = 4.0  # standard deviations within which a reading must then fit
SMALL = 1e-4  # step of the finite difference, mm


def lost_turns(
    bound: BoundProblem, result: Result, rows: Sequence[int], scale: float, i: int = 0
) -> dict[tuple[float, int], list[int]]:
    """Rows that fit with whole turns added to their reading, by what was added (mm) and how many turns that is.

    bound: with a dial that has a reading; nothing is found for any other. result: a robust fit that these rows hardly
    pull. rows: places of outliers in the samples of instrument i. scale: noise of the other rows over what is used.
    """
    probe, samples, own = bound.problem.instruments[i].probe, bound.samples[i], bound.sample_rows(i)
    if probe is None or probe.column is None or own.stop - own.start != len(samples):
        return {}
    reading, sets, (low, high) = samples.columns[probe.column], list(bound.samples), readings_within(probe.travel)
    sets[i] = replace(samples, columns={**samples.columns, probe.column: reading + SMALL})
    here = bound.residual(result.x)[own]
    slopes = (bound.on(*sets).residual(result.x)[own] - here) / SMALL
    found: dict[tuple[float, int], list[int]] = defaultdict(list)
    for k in rows:
        if abs(slopes[k]) < 1e-9:
            continue
        missing, spread = -float(here[k] / slopes[k]), SURE * scale / abs(float(slopes[k]))
        for turn in TURNS_MM:
            count = round(missing / turn)
            sharp = spread < turn / 8 and (turn >= 0.5 or high - low <= SHORT_TRAVEL)
            most = MOST_TURNS if turn == TURNS_MM[0] else 1
            if sharp and 1 <= abs(count) <= most and math.isclose(missing, count * turn, abs_tol=spread):
                found[count * turn, count].append(k)
                break
    return found

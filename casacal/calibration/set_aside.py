"""Single rows that do not belong, set aside where they are few: found by studentised residuals, each with why."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.calibration.finding import Finding
from casacal.data.samples import Samples
from casacal.errors import CasacalError, SamplesError
from casacal.fit.bound_problem import BoundProblem, bind, each_alone, times
from casacal.fit.least_squares import Result
from casacal.fit.lm import lm
from casacal.fit.nominal import nominal_sight, nominal_tips
from casacal.kernels.losses import huber
from casacal.model.geometry import fitted_plane, rigid_fit
from casacal.model.instrument import readings_within
from casacal.model.problem import Problem
from casacal.uncertainty.figures import leverages
from casacal.uncertainty.moves import prior_scatter
from casacal.values import Array, Index, Rows
from casacal.wording import counted, figures

FEWEST_OF_A_FACE = 12  # rows of a face that can tell how rough it is
WORTH_A_LOOK = 0.05  # chance of the largest residual of a plain, normal fit below which a robust fit looks for outliers
REGION = 0.1  # part of a face's spread of touches within which these are of one region
ALONG = math.cos(math.radians(10))  # of the angle up to which plungers stand alike
SHARED_BY_FEW = 15.0  # standard deviations beyond which a row is wrong even where its neighbours are off as well
CHANCE = 1e-4  # chance that a clean set has any row called an outlier (Bonferroni)
FLIPPED_ROWS, OUTLIERS = "orientation flipped", "outliers"
FLIPPED = 0.3  # chord of the least turn by which the two poses of a marker differ
TURNS_MM = (1.0, 0.5, 2.54, 0.2)  # of a pointer, by dials on sale; several turns are only looked for of the first
SHORT_TRAVEL = 2.0  # travel (mm) up to which a dial has turns of less than half a millimetre
MOST_TURNS = 3
SURE = 4.0  # standard deviations within which a reading must then fit
SMALL = 1e-4  # step of the finite difference, mm
MOST = 0.1  # part of the rows that may be set aside; where more are wrong, it is not single rows that are
ROUNDS = 3  # fits without the rows found before: large outliers hide small ones
WORTH_ANOTHER_LOOK = 10.0  # standard deviations from a fit without it up to which a row is tested once more
SUBSETS = 300  # random planes through three tips tried for the least median of squares
JUDGES = 5_000  # tips, drawn at random, whose median judges them
GROSS = 8.0  # times the robust scatter beyond which a nominal tip is not on its plane at all
ONES_OWN = 2  # rows whose joints may be another row's, pasted or shifted by one, rather than their labels wrong
MOST_STRAYS = 0.3  # beyond this fraction of the rows, it is not single rows that are wrong


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
    faces, rough = bound.faces, np.full(len(bound.faces.names), scale)
    for k, rows_of_it in enumerate(faces.rows().values()):
        if rows_of_it.size >= FEWEST_OF_A_FACE:  # a face may be rougher than all rows are
            rough[k] = max(1.4826 * float(np.median(alike[bound.residuals_of(rows_of_it)])), scale)
    size = alike / rough[faces.codes][bound.sample_of]
    limit = most_by_chance(bound.rows, free)
    bad = np.flatnonzero(size > limit)
    bad = bad[~_of_a_region(bound, np.sign(r) * size, bad)]
    rows = tuple(dict.fromkeys(bound.sample_of[bad[np.argsort(-size[bad])]].tolist()))
    return Outliers(rows, float(size.max()), limit, scale)


def _of_a_region(bound: BoundProblem, sizes: Array, bad: Index) -> Rows:
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
    """Largest studentised of `rows` residuals that chance explains, with noise of `free` degrees of freedom."""
    from scipy.special import stdtrit  # Student's quantile, without the half second that importing scipy.stats takes

    return float(stdtrit(max(free, 1.0), 1 - CHANCE / (2 * rows)))


def single_rows(bound: BoundProblem, result: Result, found: Outliers) -> list[Finding]:
    """Errors on rows that chance does not explain: lost turns of the pointer, and what is left.

    bound: with all rows. result: a fit that these rows hardly pull.
    """
    findings = list[Finding]()
    for i, rows_of_it in enumerate(bound.measured.apart(np.array(found.rows, dtype=np.intp))):
        own, samples = rows_of_it.tolist(), bound.samples[i]
        name = bound.problem.names[i] if len(bound.samples) > 1 else ""
        turns = lost_turns(bound, result, own, found.scale, i) if own else {}
        for (by, turned), rows in turns.items():
            fits = "this row fits" if len(rows) == 1 else "these rows fit"
            dial = f"{counted(abs(turned), 'turn')} of a pointer that shows {abs(by / turned):g} mm"
            fix = "Measure again, or correct the reading if the pointer was misread"
            lines = tuple(sorted(samples.lines[k] for k in rows))
            cause = f"with {figures(by, signed=True)} mm added to the reading {fits}: {dial}"
            findings.append(Finding("error", "lost revolution", cause, fix, lines, name))
        explained = {k for rows in turns.values() for k in rows}
        if angle := _turned_alone(bound, result, own, found.limit * found.scale, i):
            cause = f"position fits, and the orientation alone is off, by {angle}, "
            cause += "as of a marker seen another way round"
            fix = "Take the other of the two poses that the marker allows, or remove these rows"
            lines = tuple(sorted(samples.lines[k] for k in own))
            findings.append(Finding("error", FLIPPED_ROWS, cause, fix, lines, name))
            continue
        lines = tuple(sorted(samples.lines[k] for k in own if k not in explained))
        if lines:
            off = f"{counted(len(lines))} off by up to {found.worst:.0f} standard deviations"
            fix = "Measure them again or remove them; calibrate leaves them out where they are few"
            cause = f"{off}; more than {found.limit:.1f} is not chance"
            findings.append(Finding("error", OUTLIERS, cause, fix, lines, name))
    return findings


def _turned_alone(bound: BoundProblem, result: Result, rows: Sequence[int], most: float, i: int) -> str:
    """By how much the orientation is off in some rows of instrument i whose position fits; empty where it is not so."""
    blocks, own = bound.problem.instruments[i].blocks, bound.sample_rows(i)
    units = np.array([block.unit for block in blocks for _ in range(block.size)])
    if not rows or set(units) != {"mm", "rad"} or (own.stop - own.start) % units.size:
        return ""
    sizes = bound.residual(result.x)[own].reshape(-1, units.size)[rows]
    plain = bound.plain_residual(result.x)[own].reshape(-1, units.size)[rows]
    chords = np.linalg.norm(plain[:, units == "rad"], axis=1)
    if np.abs(sizes[:, units == "mm"]).max() > most or chords.min() < FLIPPED:
        return ""
    angles = np.degrees(2 * np.arcsin(np.minimum(chords / 2, 1)))
    return f"{angles.min():.0f} degrees" if np.ptp(angles) < 1 else f"{angles.min():.0f} to {angles.max():.0f} degrees"


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


def gross(bound: BoundProblem, *, drawn: BoundProblem | None = None) -> tuple[Rows, tuple[Finding, ...]]:
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
        if (rest := _without(bound, bad)) is None:
            return none, ()
        found = _outliers(rest)
        if not found.any():
            break
        bad[np.flatnonzero(~bad)[found]] = True
        # too many for single rows anyway: none is set aside, and the check finds the cause
        several = len(bound.samples) > 1 and bad.sum() <= MOST * len(bad)
        for name, some, rows in zip(bound.problem.names, bound.samples, bound.measured.starts, strict=False):
            off = int(bad[rows : rows + len(some)].sum())
            if several and 2 * off >= len(some):
                what = f"the instruments contradict each other: {off} of {counted(len(some), 'row')} of {name}"
                fix = f"Check unit, sign, frame and tool of {name}, and what is shared with it; or leave its rows out"
                raise SamplesError(some.file, f"{what} lie far off where the others put the arm", fix)
    if (bad & ~stray).any():
        bad = _taken_back(bound, bad, stray)
    rest = _without(bound, bad)
    if rest is not None and any(bound.beside):  # where much is known beside the geometry, others may expect a row so
        *_, sizes, most = _judged(rest, bound)
        bad &= stray | (sizes > most)
        rest = _without(bound, bad)
    if rest is None:
        return none, ()
    if (bad & ~stray).any():
        judged, result, sizes, most = _judged(rest, bound)
        rows = np.flatnonzero(bad & ~stray)
        odd = Outliers(tuple(rows.tolist()), float(sizes[rows].max()), most, 1.0)
        findings += single_rows(judged, result, odd)
    return bad, tuple(findings)


def _without(bound: BoundProblem, bad: Rows) -> BoundProblem | None:
    """The problem bound to the other rows; None where these are too few, in all or on a face."""
    if not bad.any():
        return bound
    if bad.sum() > MOST * len(bad):
        return None
    rest = bound.measured.take(np.flatnonzero(~bad)).sets
    try:
        return bound.on(*rest) if any(bound.beside) else bind(bound.problem, *rest)
    except CasacalError:
        return None


def _outliers(bound: BoundProblem) -> Rows:
    """Rows (N,) that a robust fit of them all cannot explain."""
    found = np.zeros(len(bound.measured), dtype=bool)
    # what the rows must hold is the geometry: unknowns of effects stand at zero unless rows say more
    if bound.rows > bound.beside.count("") and (fitted := robust_fit(bound)) is not None:
        outliers = studentised_outliers(*fitted)
        # by half a turn the residual has a kink, where no fit comes to rest
        if fitted[1].converged or {each.about for each in single_rows(*fitted, outliers)} == {FLIPPED_ROWS}:
            found[list(outliers.rows)] = True
    return found


def _taken_back(bound: BoundProblem, bad: Rows, stray: Rows) -> Rows:
    """Rows (N,) that stay aside after those near the fit are tested once more."""
    if (rest := _without(bound, bad)) is None:
        return bad
    *_, sizes, _ = _judged(rest, bound)
    again = bad & ~stray & (sizes < WORTH_ANOTHER_LOOK)
    more = _without(bound, bad & ~again)
    if not again.any() or more is None:
        return bad
    held: Rows = bad & ~again
    held[np.flatnonzero(~held)[_outliers(more)]] = True
    return held & bad


def _judged(rest: BoundProblem, whole: BoundProblem) -> tuple[BoundProblem, Result, Array, float]:
    """All rows with the noise of the rest, a fit of the rest, standardised residuals (N,), the most by chance."""
    result = lm(rest)
    noise = 1.4826 * float(np.median(np.abs(rest.residual(result.x))))
    judged = rest.on(*whole.samples).with_noise(times(rest.scale, max(noise, 1.0)))
    sizes = judged.largest(np.abs(judged.residual(result.x)))
    return judged, result, sizes, most_by_chance(judged.rows, judged.rows - judged.beside.count(""))


def off_their_face(bound: BoundProblem, scatter: float) -> tuple[Rows, list[Finding]]:
    """Rows that lie nowhere near their face, and why; a quick look decides whether faces are fitted robustly.

    scatter: distance (mm) that prior errors of the arm explain.
    """
    worst = float(np.abs(bound.plain_residual(bound.x0)).max(initial=0.0))
    if not worst > GROSS * scatter:
        return np.zeros(len(bound.measured), dtype=bool), []
    bad, findings = [], []
    for alone in each_alone(bound.problem, bound.samples):
        mine, found = strays(alone.problem, alone.samples, scatter)
        bad.append(mine)
        findings += [replace(each, instrument=alone.name) for each in found]
    return np.concatenate(bad), findings


def strays(problem: Problem, samples: Samples, scatter: float) -> tuple[Rows, list[Finding]]:
    """Rows (N,) far off their plane before any fit, with what that means; none where most rows are off.

    Least median of squares per label (Rousseeuw 1984), which survives almost half of the rows being wrong.
    problem: with one instrument. scatter: distance (mm) that prior errors of the arm explain.
    """
    bad, planes = np.zeros(len(samples), dtype=bool), dict[str, Array]()
    if problem.instrument.probe is None:
        return _lost_places(problem, samples, scatter)
    tips, faces = nominal_tips(problem, 0, samples), samples.faces(problem.instrument.groups)
    for label, rows in faces.rows().items():
        if len(rows) >= 8:
            planes[label], size = median_plane(tips[rows])
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
        findings.append(Finding("error", OUTLIERS, cause, fix, tuple(lost)))
    return bad, findings


def _lost_places(problem: Problem, samples: Samples, scatter: float) -> tuple[Rows, list[Finding]]:
    """Rows (N,) whose place, as a device tells it, is far from that of the drawn tip by the best fit of the others."""
    bad, names, instrument = np.zeros(len(samples), dtype=bool), ("x", "y", "z"), problem.instrument
    if not instrument.words.accuracy or any(instrument.columns.get(name) != "length" for name in names):
        return bad, []
    tips, places = nominal_tips(problem, 0, samples), np.column_stack([samples.columns[name] for name in names])
    rng, per = np.random.default_rng(0), (instrument.unknowns[key].per for key in instrument.datum)
    for rows in samples.faces(next(filter(None, per), None)).rows().values():
        best = np.full(len(rows), math.inf)
        for _ in range(SUBSETS if len(rows) >= 8 else 0):
            few = rng.choice(rows, 4, replace=False)
            if (there := rigid_fit(tips[few], places[few])) is not None:
                off = np.linalg.norm(tips[rows] @ there[:3, :3].T + there[:3, 3] - places[rows], axis=1)
                best = min(best, off, key=np.median)
        bad[rows] = np.isfinite(best) & (best > GROSS * max(1.4826 * float(np.median(best)), scatter))
    if not bad.any() or bad.mean() > MOST_STRAYS:
        return np.zeros(len(samples), dtype=bool), []
    cause = f"{counted(int(bad.sum()), 'place')} far from where the arm, as drawn, and the others put it"
    fix = "Remove these lines, or measure them again, if the target was lost; else look at their joint values"
    about = "lost target" if 2 * len(np.unique(places[bad], axis=0)) <= bad.sum() else OUTLIERS
    lines = tuple(samples.lines[k] for k in np.flatnonzero(bad).tolist())
    return bad, [Finding("error", about, cause, fix, lines)]


def median_plane(tips: Array) -> tuple[Array, float]:
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

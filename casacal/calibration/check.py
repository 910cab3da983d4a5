"""All the doctor's checks in order: the rows, the set-up, systematic faults, single rows, the noise, the effects."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from casacal.calibration import before_fit
from casacal.calibration.agreement import disagreement, not_the_same
from casacal.calibration.cause import MisfitCause, cause_of_rows, changed_midway, explained, labels_exchanged
from casacal.calibration.conventions import CONVENTIONS
from casacal.calibration.faults import MOVED, SLIPPED, flips
from casacal.calibration.finding import ALIKE, EXPLAINED, SUSPICIOUS, Finding, misfit, quick_fit, size_of
from casacal.calibration.mirror import DIAL_WAY, either_way, mirror_image
from casacal.calibration.moved import moved_midway
from casacal.calibration.numbers import tool_elsewhere_at, tool_keys, without_its_likes, wrong_number, wrong_scale
from casacal.calibration.set_aside import gross, off_their_face, robust_fit, single_rows, studentised_outliers
from casacal.data.repeats import without_copies
from casacal.data.samples import Measurements, Samples
from casacal.effects.selection import dial_errors, effect_sizes_of, with_effects
from casacal.effects.trusted import beyond, with_constants
from casacal.errors import CasacalError, came
from casacal.fit.bound_problem import BoundProblem, bind, each_alone
from casacal.fit.lm import lm
from casacal.model.problem import Problem
from casacal.uncertainty.figures import noise_interval
from casacal.uncertainty.moves import prior_scatter
from casacal.uncertainty.noise import found_noise
from casacal.values import Index
from casacal.wording import figures, listed, sized, times

COUNTED = "Calibrate anyway: the kit of effects accounts for this"
FIXES = {
    "gain": "Declare gain=dial_gain(0.15), or give its certificate",
    "cycle": "Declare cycle=dial_cycle(3), or use another dial",
    "form": "Clean the faces, or use a better plate",
    "play": "Approach every touch from the same side",
    "give": f"{COUNTED}. Measure with the load that the arm will carry",
    "wave1": COUNTED,
    "wave2": COUNTED,
    "field": "Look for causes that depend on posture, such as hoses, cables or a soft base",
    "drift": "Let the dial warm up, fasten it and the faces, and repeat one touch from time to time",
    "growth": "Let the arm warm up by running its production program before measuring",
}
OTHERWISE = "Look for its cause, or declare it as an effect of the problem"
APART = 1.5  # times the misfit of the instrument that fits worst alone, beyond which all contradict one another
MOST_ROWS = 600  # rows used to look for systematic faults; more add time, not insight
OF_A_FACE = 12  # rows of a face, where faces are many, that tell of systematic faults
SPREAD = 20_000  # rows that tell of the set-up and of what the prior explains; more add memory, not insight
SORTED = 12  # rows whose readings stand in order of size only where somebody sorted them
STUCK = 1e-9  # rad or mm within which a joint does not move
MOST_STRAY = 0.1  # part of the rows beyond which those far off their face are no single rows if the others do not fit
OF_TWO = 3.0  # times what prior errors explain by which the drawn arm must miss before two mistakes are looked for
ORDER = {"error": 0, "warning": 1, "remark": 2}
UNBOUND = "cannot be bound"
OF_ALL = "few rows", before_fit.NO_LENGTH  # of all instruments together: what one cannot observe, another may


def effect_findings(problem: Problem, samples: Samples) -> list[Finding]:
    """Warnings of non-geometric effects that the rows show, with noise and sizes as `calibrate` finds them.

    In blocks, as nothing is worth compiling for one look.
    """
    bound = bind(problem.without_terms, samples, backend="blocks")
    bound = with_effects(bound.with_noise(found_noise(bound).scale), problem)
    fit = lm(bound)
    if not fit.converged:
        return []
    shown = list[tuple[str, str, str, str]]()  # key, words, evidence and size: of the dial, and of the arm
    for error in dial_errors(bound, fit.x):
        if error.shown:
            size = f"{error.shown_size}, which moves the tip by {figures(error.tip_mm, 2)} mm RMS"
            shown.append((error.key, error.words, f"p = {error.chance:.1g}", size))
    for each in effect_sizes_of(bound, fit.x):
        if each.shown and each.size > each.expected_size:
            shown.append((each.key, each.words, f"log likelihood {each.gain:+.0f}", sized(each.size, each.unit)))
    found: dict[str, Finding] = {}
    for key, words, evidence, size in shown:
        fix = FIXES.get(key, OTHERWISE)
        cause = f"the rows show it ({evidence}): its most likely size is {size}"
        found.setdefault(fix, Finding("warning", words, cause, fix))  # one that calls for the same says no more
    return list(found.values())


def contradictions(bound: BoundProblem, measured: Measurements) -> list[Finding]:
    """An error where each instrument fits by itself and all together do not, or not with what they share."""
    problem = bound.problem
    together = misfit(problem, measured)
    sizes = {each.name: misfit(each.problem, each.samples) for each in each_alone(problem, measured.sets)}
    worst = max((size for size in sizes.values() if math.isfinite(size)), default=1.0)
    if together <= max(APART * worst, SUSPICIOUS):
        fit = with_effects(bound.with_noise(found_noise(bound).scale), problem) if problem.shared else bound
        return (not_the_same(fit, lm(fit)) if problem.shared else []) or disagreement(bound)
    shared = "".join(f"; '{key}' is declared as the same for {' and '.join(by)}" for key, by in problem.shared.items())
    alone = f"residuals up to {times(worst)} times the stated noise"
    cause = f"each fits alone ({alone}), but not together ({times(together)} times){shared}"
    fix = "Check that arm, tool and base were the same for all, and that what is declared as shared is one and the "
    fix += "same; too small a stated noise of one instrument can also be the cause"
    return [Finding("error", "instruments contradict each other", cause, fix)]


def check(problem: Problem, samples: Samples | Measurements, *, confirmed: bool = False) -> tuple[Finding, ...]:
    """Findings on samples, worst first: errors, weaknesses, and remarks.

    confirmed: whether poses off the pendant confirmed the joint conventions (`ProblemFile.confirmed`), so that a mirror
    image of the arm need not be mentioned.

    Of several instruments each is looked at by itself, and then whether all agree about one arm.

    Before any fit: repeats, ranges, rounding, set-up, labels, dial sign. With a quick robust fit: systematic faults,
    each found by undoing it, then outliers and noise, then effects beside the geometry. What one cause explains is not
    reported again. Deterministic.
    Raises CasacalError for what is no problem or no samples.
    """
    if not isinstance(problem, Problem):
        raise CasacalError(f"Got {came(problem)} as the problem", "Give a Problem; load_problem(path).problem is one")
    if not isinstance(samples, (Samples, Measurements)):
        raise CasacalError(f"Got {came(samples)} as samples", "Give Samples; problem.read(path) returns them")
    if len(problem.instruments) > 1:
        if not isinstance(samples, Measurements) or samples.names != problem.names:
            fix = f"Give Measurements of {', '.join(problem.names)}"
            raise CasacalError("The samples are not those of the problem's instruments", fix)
        found = _of_several(problem, samples, confirmed)
    else:
        found = _of_one(problem, Measurements.of(samples).sets[0], confirmed)
    return tuple(sorted(without_its_likes(found), key=lambda finding: ORDER[finding.severity]))


def _of_one(problem: Problem, samples: Samples, confirmed: bool) -> list[Finding]:
    """Findings on the samples of a problem's only instrument."""
    drawn = problem
    lost, samples = before_fit.lost_targets(problem, samples)
    if lost and not len(samples):
        return lost
    findings = [*lost, *before_fit.repeated(samples), *before_fit.outside(problem, samples)]
    findings += [*before_fit.lost_labels(problem, samples), *before_fit.odd_labels(problem, samples)]
    samples = without_copies(samples)  # as calibrate takes them
    try:
        bound = bind(problem, samples)
    except CasacalError as error:
        return [Finding("error", UNBOUND, error.what, error.fix), *findings]
    some = bound if len(samples) <= SPREAD else bound.on(samples.take(_evenly(len(samples), SPREAD)))
    scatter = prior_scatter(some, flat_counts=True).rms
    if wrong := [*before_fit.in_metres(problem, samples), *before_fit.upside_down(some, scatter)]:
        return [*wrong, *findings]
    bad, stray = off_their_face(bound, scatter)
    good = samples.take(np.flatnonzero(~bad)) if bad.any() else samples
    few = _few_of_each_face(problem, good)
    base = misfit(problem, few)
    if base > SUSPICIOUS and (freed := _explained_by_constants(problem, few)) is not None:
        problem, base, far = freed
        findings += far
    if base > SUSPICIOUS and bad.sum() > MOST_STRAY * len(samples):
        good, few = samples, _few_of_each_face(problem, samples)
        base = misfit(problem, few)
    gross = float(np.sqrt((some.plain_residual(some.x0) ** 2).mean())) > OF_TWO * scatter
    cause = explained(problem, few, base, gross=gross, whole=samples) if base > SUSPICIOUS else None
    about = "" if cause is None else cause.finding.about
    if about in ("", SLIPPED, MOVED):  # by little, one thing that moved looks like another
        moved = moved_midway(bind(with_constants(problem), few, backend="blocks"))
        if moved is not None and not (about == SLIPPED and moved.about.startswith("joint")):
            return [moved, *findings]
    midway = changed_midway(problem, few) if base > EXPLAINED and cause is None else None  # more than any arm errs
    if cause is not None and about == MOVED:  # what exchanged labels look like
        midway = labels_exchanged(problem, few, cause.undone.samples)
    if midway is not None:
        return [midway, *findings]
    if cause is not None:  # it also explains single rows that lie off
        findings = _with_cause(findings, cause, some, few)
        unsure = cause.finding.about == CONVENTIONS and not confirmed
        return [*findings, *(_image(bind(cause.undone.problem, cause.undone.samples), confirmed) if unsure else [])]
    findings += [*before_fit.rounded(bound), *before_fit.setup_findings(some), *before_fit.sign_before_fit(some)]
    findings += stray if base <= EXPLAINED else []  # else the other rows miss as well, and these are not the cause
    if base > SUSPICIOUS:
        return [_unexplained(problem, samples, base, findings), *findings]
    rest = bind(with_constants(problem), good, backend="blocks")  # for few looks nothing is worth compiling
    findings = _of_fitting_rows(problem, samples, few, base, rest, findings)
    if all(finding.severity != "error" for finding in findings):
        findings += [*effect_findings(drawn, few), *_image(rest, confirmed)]
    return findings


def _explained_by_constants(problem: Problem, samples: Samples) -> tuple[Problem, float, list[Finding]] | None:
    """The problem with its trusted constants unknown, the misfit left, and a warning of each far off; else None.

    A scale that would have to be farther off than its prior covers is a mistake to find.
    """
    if (freed := with_constants(problem)) is problem:
        return None
    fitted, findings = quick_fit(freed, samples, backend="blocks"), list[Finding]()
    if fitted is None or size_of(*fitted) > SUSPICIOUS:
        return None
    for constant, size in beyond(fitted[0], fitted[1].x):
        if constant.scales:
            return None
        cause = f"the rows put {constant.words} {sized(size, constant.unit)} off, and "
        cause += f"{sized(constant.std, constant.unit)} is stated as its error"
        fix = f"State it better: {constant.cure}"
        findings.append(Finding("warning", constant.words, cause, fix))
    return freed, misfit(freed, samples), findings


def _of_fitting_rows(
    problem: Problem, samples: Samples, few: Samples, base: float, rest: BoundProblem, findings: list[Finding]
) -> list[Finding]:
    """The findings so far with those on tool and scale, joint flips, and single rows, of rows that fit on the whole."""
    if (quick := quick_fit(rest.problem, few, backend="blocks")) is not None:
        fitted = quick[0], quick[1].x, quick[1].covariance
        findings += [*tool_elsewhere_at(*fitted), *wrong_scale(*fitted)]
    for fault in flips(problem):
        undone = fault.undo(problem, few)
        if misfit(undone.problem, undone.samples) <= ALIKE * base:
            cause = "these samples would look the same, so they cannot show it"
            findings.append(Finding("remark", f"{fault.about}?", cause, "Check it by hand"))
    findings += _rows(rest)
    two = [each for each in findings if each.about == before_fit.TWO_READINGS]  # of which one is right
    findings = [each for each in findings if each not in two]
    off = np.isin(samples.lines, [line for each in findings if each.severity == "error" for line in each.lines])
    if any(
        each.about == before_fit.TWO_READINGS
        for each in before_fit.outside(problem, samples.take(np.flatnonzero(~off)))
    ):
        findings += two
    cause_of_all = cause_of_rows(problem, samples, off)  # what explains all rows that lie off stands in their place
    return findings if cause_of_all is None else [cause_of_all, *(each for each in findings if not each.lines)]


def _with_cause(findings: list[Finding], cause: MisfitCause, bound: BoundProblem, few: Samples) -> list[Finding]:
    """The cause, then the findings that it does not explain, and weaknesses of the set-up with it undone."""
    undone, found = cause.undone, cause.finding
    remaining = {finding.about for finding in before_fit.outside(undone.problem, undone.samples)}
    explained_too = {finding.about for finding in before_fit.outside(bound.problem, few)} - remaining
    kept = [finding for finding in findings if finding.about not in explained_too]
    if found.about == before_fit.WRONG_SIGN and before_fit.OUTSIDE in explained_too:
        found = replace(found, cause=f"the readings have a minus and should not: {found.cause.partition(': ')[2]}",
                        fix="Write the readings without the minus")  # fmt: skip
    elif found.about == before_fit.WRONG_SIGN:
        causes = [found.cause, *(each.cause for each in before_fit.sign_before_fit(bound))]
        found = replace(found, cause="; ".join(causes))
    faces = few if MOVED in found.about else undone.samples  # which calls those touched later by new names
    weak = before_fit.setup_findings(bind(undone.problem, replace(undone.samples, labels=faces.labels)))
    return [found, *kept, *(finding for finding in weak if finding.about != "few rows")]


def _few_of_each_face(problem: Problem, samples: Samples) -> Samples:
    """About `MOST_ROWS` rows, evenly over their faces, or of some faces where these are many."""
    if len(samples) <= MOST_ROWS:
        return samples
    faces = samples.faces(problem.instrument.groups)
    rows = [some for some in faces.rows().values() if some.size]
    chosen = [rows[k] for k in _evenly(len(rows), MOST_ROWS // OF_A_FACE)]
    kept = [some[_evenly(some.size, MOST_ROWS // len(chosen))] for some in chosen]
    return samples.take(np.sort(np.concatenate(kept)))


def _evenly(count: int, most: int) -> Index:
    """Indices of at most `most` of `count` items, evenly spread."""
    return np.unique(np.linspace(0, count - 1, most).astype(np.intp))


def _unexplained(problem: Problem, samples: Samples, base: float, findings: list[Finding]) -> Finding:
    known = [finding.about for finding in findings if finding.severity == "error"]
    cause = f"the residuals of a robust fit are {times(base)} times the stated noise"
    still = [f"joint {i + 1}" for i in np.flatnonzero(np.ptp(samples.joints, axis=0) < STUCK).tolist()]
    still += [f"column '{name}'" for name, values in samples.columns.items() if np.ptp(values) == 0]
    if still and base > EXPLAINED:
        cause = f"{listed(still)} {'shows' if len(still) == 1 else 'show'} one and the same value in all rows; {cause}"
    column, what = problem.instrument.groups, problem.instrument.words.group
    if column is not None and samples.faces(column).names == (column,) and base > EXPLAINED:
        cause = f"there is no column '{column}', so all rows count as of one {what}; with that, {cause}"
        fix = f"Add the column '{column}' with the {what} of each row; if there is only one, check signs and units"
        return Finding("error", "labels absent", cause, fix)
    for name, values in samples.columns.items():
        ways = set(np.sign(np.diff(values)).tolist()) - {0.0}
        if len(samples) >= SORTED and base > EXPLAINED and len(ways) == 1:
            cause = f"the values of '{name}' stand in order of size, as where a column was sorted by itself; {cause}"
            return Finding("error", "sorted column", cause, "Take the rows as they were measured, joints and all")
    if known:
        cause = f"{cause}; whether {listed(known)} {'is' if len(known) == 1 else 'are'} the cause was not tried"
        return Finding("remark", "misfit", cause, "Correct those first, and check again")
    instrument = problem.instrument
    suspected = [name for name in instrument.columns if any(name in each.columns for each in instrument.suspects)]
    untried = len(suspected) < len(instrument.columns)
    tried = [f"wrong sign or unit{f' of {listed(suspected)}' if untried else ''}"] if suspected or not untried else []
    tried += ["swapped joints", "coupling"]
    tried += ["drift of the readings"] if instrument.probe is not None and instrument.probe.column is not None else []
    tried += ["tool offset"] if tool_keys(problem) else []
    cause = f"{cause}, and no {listed(tried, 'or')} explains it"
    fix = "Check the robot's nominal values and the instrument's noise; "
    fix += "compliance, backlash, a loose joint or a warped face can be the cause"
    if base > EXPLAINED:  # more than any arm errs
        first = f"See that {listed(still)} was read anew in each row. " if still else ""
        fix = f"{first}Check labels, columns and DH table; casacal doctor compares the table with poses on the pendant"
        probe = problem.instrument.probe
        if probe is not None and probe.column is not None:  # what is wrong beside the sign then shows
            turned = problem.with_settings({"sign": -probe.sign})
            better = misfit(turned, _few_of_each_face(problem, samples)) < base
            fix = f"Try the dial's sign first (--set sign={-probe.sign}). {fix}. Do not delete rows" if better else fix
    return Finding("error", "misfit", cause, fix)


def _rows(bound: BoundProblem) -> list[Finding]:
    """Outliers, else a noise that is not as stated."""
    fitted = robust_fit(bound)
    outliers = [] if fitted is None else single_rows(*fitted, studentised_outliers(*fitted))
    if outliers:
        return outliers
    if wrong := wrong_number(bound):
        return wrong
    ratio, low, high = noise_interval(lm(bound))
    if low <= 1.1 and high >= 0.9:
        return []
    cause = f"the residuals are {ratio:.2f} times the stated noise (95 % {low:.2f} to {high:.2f})"
    fix = "Correct noise_std in the problem" if ratio < 1 else "Raise noise_std, or find what the model leaves out"
    return [Finding("warning", "noise", cause, fix)]


def _image(bound: BoundProblem, confirmed: bool) -> list[Finding]:
    """What explains all rows as well: a mirror image of the arm, unless that is settled; a dial that counts back."""
    image = None if confirmed else mirror_image(bound)
    found = [] if image is None else [Finding("remark", "mirror image", *image.cause_and_fix)]
    return [*found, Finding("warning", "direction of the dial", *DIAL_WAY)] if either_way(bound) else found


def _of_several(problem: Problem, measured: Measurements, confirmed: bool) -> list[Finding]:
    """Findings on each instrument's samples, and on all together.

    An instrument whose rows cannot be fitted without the others is looked at row by row alone.
    """
    found = list[Finding]()
    for alone in each_alone(problem, measured.sets):
        of_it = [each for each in check(alone.problem, alone.samples, confirmed=True) if each.about not in OF_ALL]
        fixes = [each.fix.replace("--set ", f"--set {alone.name}.") for each in of_it]
        found += [replace(each, instrument=alone.name, fix=fix) for each, fix in zip(of_it, fixes, strict=True)]
    try:
        bound = bind(problem, *measured.sets)
    except CasacalError as error:
        if any(finding.about == UNBOUND for finding in found):  # said already of the instrument that it is about
            return found
        return [Finding("error", UNBOUND, error.what, error.fix), *found]
    found += before_fit.enough_rows(bound)
    if all(finding.severity != "error" for finding in found):
        try:  # single rows that an instrument of few rows alone does not show, as calibrate sets them aside
            bad, aside = gross(bound)
            bound = bind(problem, *measured.take(np.flatnonzero(~bad)).sets) if bad.any() else bound
        except CasacalError:  # half the rows of an instrument: no single ones
            aside = ()
        found += [*aside, *contradictions(bound, bound.measured)]
        found += _image(bound, confirmed)  # what one instrument alone leaves open, another may tell
    return found

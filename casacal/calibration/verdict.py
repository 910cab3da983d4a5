"""The verdict: how far a result may be used. Terminal, report, result.json and exit code all take it from here."""

from __future__ import annotations

import math

import numpy as np

from casacal.calibration.calibration import FAR, LACK_OF_FIT, MINIMISERS, Calibration
from casacal.calibration.warnings import NOISE_BAND, Doubt, doubts, larger_than_any
from casacal.checks.finding import Finding
from casacal.checks.numbers import SCALE, without_its_likes
from casacal.compensation.result import Verdict
from casacal.uncertainty.prior_moves import prior_scatter
from casacal.wording import chance, counted, listed, mm, sentence, times

GAIN = 0.9  # expected tip error over the one before, above which little was gained
WORSE = 1.1  # residual after over before, on the very rows that were fitted, above which calibrating made the arm worse
EXPLAINED = 0.5  # residual after over before, above which a fit that does not reach the noise has explained nothing
BENT = 10.0  # prior standard deviations by which no arm differs from its drawing; who knows better states wider priors

FARTHEST = 1e5  # mm or rad beyond which a number of an arm wandered off; result.schema.json takes none so large

TOO_LOOSE = 1e-3
"""Chance below which a drawn arm that misses so little contradicts its priors, and these must not decide."""

MEMBER = 1e-3
"""Part of a direction's length above which a parameter takes part in it."""

SHOWN = 0.01  # millimetres below which nobody asks how little a tip errs

LEFT_TO_PRIORS = 0.5
"""Expected tip error over the one before, above which the priors decide more of it than the samples."""


def verdict_of(calibration: Calibration) -> Verdict:
    """Whether to use a result; what speaks against it decides, the weightiest first."""
    calibration = calibration.unjudged
    against = _against(calibration)
    if against:
        return Verdict(
            "do not use", f"Do not use this result: {against[0][0]}.", tuple(reason for _, reason in against)
        )
    if not calibration.fit.unknowns:
        said = "every unknown is held, so nothing was estimated"
        words = f"Use with care: {said}; the residuals are those of the arm as drawn."
        return Verdict("use with care", words, (sentence(said),))
    found, expected, unchecked = doubts(calibration), _expected(calibration), ""
    if calibration.reference is None and calibration.method in MINIMISERS:
        unchecked = " No second solver checked that this is the minimum."
    elif calibration.reference is None:
        clause = "no second solver checked that this is the minimum"
        found.append(Doubt(clause, f"{sentence(clause)} Run it again without --no-reference."))
    before, now = calibration.tip_std
    if now > GAIN * before and calibration.earlier is None:  # what an earlier result knows is no mere prior
        words = "Little was gained: these samples say almost nothing about the tip beyond the priors."
        found.append(Doubt("little was gained", words))
    if found:
        words = f"Use with care: {expected} But {' and '.join(doubt.clause for doubt in found[:2])}."
        return Verdict("use with care", f"{words}{unchecked}", tuple(doubt.sentence for doubt in found))
    return Verdict("calibrated", f"Calibrated: {expected}{unchecked}")


def _expected(calibration: Calibration) -> str:
    """The error to expect, of flange and tip; what matters first."""
    (before, now), (drawn, flange) = calibration.tip_std, calibration.flange_std
    least = "at least " if calibration.noise.low > NOISE_BAND[1] and not calibration.noise.scale else ""
    alone = "" if any(calibration.fit.beside) else " and nothing errs beside the geometry"
    trusted = f"apart from the base's position, if {calibration.assumed} are right{alone}"
    tool = calibration.hidden_tool
    if tool is not None:
        return (
            f"expect a flange error of {least}{mm(flange)} RMS over the workspace (before: {mm(drawn)}), {trusted}. "
            f"The tip error of {mm(now)} is mostly the tool's: these samples hardly show {listed(tool.names)} "
            f"(standard deviation {mm(tool.std_mm)}). Measure it; once it is known, expect {mm(tool.tip_mm)}."
        )
    names = calibration.fit.problem.names
    whose = f" ({names[0]})" if len(names) > 1 else ""
    at_flange = f" and {mm(flange)} at the flange" if math.isfinite(flange) else ""
    return (
        f"expect a tip error{whose} of {least}{mm(now)} RMS over the workspace (before: {mm(before)})"
        f"{at_flange}, {trusted}."
    )


def _against(calibration: Calibration) -> list[tuple[str, str]]:
    """Reasons to refuse a result: for each a clause for the verdict's sentence, and a full sentence."""
    found = [(clause, sentence(clause)) for clause in held_as_drawn(calibration)]  # it may look like wrong samples
    found += [(clause, sentence(clause)) for clause in earlier_contradicted(calibration)]
    found += [(clause, sentence(clause)) for clause in _out_of_reach(calibration)]
    found += [
        (f"the samples look wrong ({error.about})", sentence(str(error).removeprefix("error: ").removesuffix(".")))
        for error in wrong_with_samples(calibration)
    ]
    if not calibration.result.converged:
        found.append(_unfinished(calibration))
    found += [(clause, sentence(clause)) for clause in _missed_minimum(calibration)]
    for look in (unexplained, priors_contradicted) if calibration.earlier is None else ():
        found += [] if found else [(clause, sentence(clause)) for clause in look(calibration)]
    if calibration.result.converged and not math.isfinite(calibration.tip_std[1]):
        clause = "these samples do not bound the tip error"
        found.append((clause, "Neither the samples nor a prior determine every direction that moves the tip."))
    return found


def wrong_with_samples(calibration: Calibration) -> tuple[Finding, ...]:
    """Errors in the rows that were fitted, each known by name; the whole check is asked where there is cause."""
    found = calibration.data_errors if calibration.suspicious else calibration.plain_errors
    own = [each for each in calibration.instrument_findings if each.severity == "error"]
    told = {"misfit", SCALE, *(error.about for error in own)}
    return tuple(without_its_likes([*(error for error in found if error.about not in told), *own]))


def _unfinished(calibration: Calibration) -> tuple[str, str]:
    """Reason of a method that did not finish: unbounded directions where there are any, else its own message."""
    flat = ~np.isfinite(calibration.bare.prior_std)
    null = [np.abs(each.direction) > MEMBER for each in calibration.identifiability.null]
    loose = [members for members in null if flat[members].all()]
    if not loose:
        return "the method did not finish", calibration.result.message
    names = [calibration.bare.names[int(np.flatnonzero(members)[0])] for members in loose]
    them = "it" if len(names) == 1 else "them"
    return (
        f"neither the samples nor a prior hold {counted(len(loose), 'combination')} of parameters",
        f"Give a prior to {listed(names)} (--prior {names[0]}=STD), or hold {them} (--fix).",
    )


def _missed_minimum(calibration: Calibration) -> list[str]:
    """Reasons why the estimate is not the minimum; empty where it is.

    A method that promises the minimum must meet the reference; any other may miss it by what the estimate's own spread
    explains: twice the cost above the minimum is then about chi-square with as many degrees of freedom as unknowns.
    """
    reference = calibration.reference
    if reference is None or reference.agrees or not calibration.result.converged:
        return []
    if not reference.result.converged:
        return [f"{reference.solver} did not finish, so nothing confirms the minimum; another --reference may"]
    if calibration.method in MINIMISERS:
        return [f"the costs of {calibration.method} and {reference.solver} differ, so one of them missed the minimum"]
    if 2 * (calibration.result.cost - reference.cost) <= calibration.fit.unknowns:
        return []
    return [
        f"{calibration.method} ended at a cost of {calibration.result.cost:.4g}, far above the {reference.cost:.4g} "
        f"that {reference.solver} found"
    ]


def _out_of_reach(calibration: Calibration) -> list[str]:
    """Numbers that wandered off where neither samples nor a prior hold them."""
    moved = {name: calibration.used_x[j] for name, _, _, j in calibration.fit.parameters() if j is not None}
    far = [name for name, by in moved.items() if not abs(by) < FARTHEST]
    if not far or not calibration.result.converged:
        return []
    said = f"{far[0]} moved by {moved[far[0]]:.3g}, as no arm does"
    return [f"{said}: neither samples nor a prior hold it (--prior {far[0]}=STD)"]


def held_as_drawn(calibration: Calibration) -> list[str]:
    """Faces and the like that took over the drawn arm's errors, so that the arm was fitted to these."""
    names = dict.fromkeys(slot.key for slot in calibration.fit.slots if slot.held_as_drawn)
    if not names or not calibration.fit.unknowns:
        return []
    return [
        f"what was measured against is held where the arm as drawn has it ({', '.join(names)}), so the arm was fitted "
        "to its own errors; leave it free, or state in the problem where it is"
    ]


def unexplained(calibration: Calibration) -> list[str]:
    """Residuals far above the noise that the fit hardly lowered, or lowered only by bending the arm out of shape."""
    ratio, low = calibration.noise.ratio, calibration.noise.low
    before, after = (calibration.metrics[when]["fit"] for when in ("before", "after"))
    assert before is not None
    assert after is not None
    # where faces are held, what is not corrected may stand as a shift of the base, which no figure counts
    if calibration.fit.datum.any() and after["rmse_mm"] > WORSE * before["rmse_mm"]:
        else_found = larger_than_any(calibration)  # it cannot be corrected, and then decides more than the geometry
        also = f", and {else_found.clause}" if else_found else ""
        return [f"the calibrated arm fits its own rows worse than the arm as drawn{also}"]
    if low <= LACK_OF_FIT:
        return []
    moved = float(calibration.moves.max(initial=0.0))
    said = f"the residuals are {times(ratio)} times what the stated noise explains"
    if after["rmse_mm"] > EXPLAINED * before["rmse_mm"]:
        return [f"{said}, and calibrating hardly lowered them"]
    if moved > FAR:
        return [f"{said}, even though parameters moved by up to {moved:.0f} prior standard deviations"]
    return []


CONTRADICTED = 1e-3  # chance below which new rows do not fit what an earlier result knows


def earlier_contradicted(calibration: Calibration) -> list[str]:
    """A reason where new rows contradict the earlier result, given what was loosened."""
    chance_of_rows = calibration.earlier_chance
    if calibration.earlier is None or not chance_of_rows < CONTRADICTED or not calibration.result.converged:
        return []
    loosened = listed(list(calibration.earlier.loosened))
    what = f"something else than {loosened} has changed" if loosened else "something has changed"
    return [
        f"these rows contradict the earlier result ({chance(chance_of_rows)}): {what}, or rows are wrong. casacal "
        "changed looks for it; name it with --loosen (loosen=), or calibrate anew"
    ]


def priors_contradicted(calibration: Calibration) -> list[str]:
    """Priors that the samples contradict, and that yet decide most of where the tip is."""
    if not calibration.fit.unknowns:
        return []
    (before, now), far = calibration.tip_std, float(calibration.moves.max(initial=0.0))
    if far > BENT:
        worst = calibration.fit.names[int(np.argmax(calibration.moves))]
        return [
            f"{worst} moved by {times(far)} prior standard deviations. Either a sign, a unit or a label is wrong, or "
            "it is so far from what the problem says; state wider priors then (--prior, or --accuracy for the arm)"
        ]
    drawn, scatter = calibration.metrics["before"]["fit"], prior_scatter(calibration.bare)
    assert drawn is not None
    # were all priors so much narrower as the drawn arm contradicts them, this is what it would err by
    as_drawn = before * drawn["rmse_mm"] / scatter.rms if scatter.rms > 0 else math.inf
    if math.isfinite(before) and now > as_drawn and scatter.chance_below(drawn["rmse_mm"]) < TOO_LOOSE:
        return [
            f"the priors are too loose for this arm: they allow a tip error of {mm(before)} as drawn, but its "
            f"residuals suggest about {mm(max(as_drawn, SHOWN))}, which is less than these priors leave after "
            "calibrating (--accuracy, --prior)"
        ]
    if far <= FAR or now <= LEFT_TO_PRIORS * before:
        return []
    return [
        f"the samples move parameters by up to {far:.0f} prior standard deviations, so these priors do not fit this "
        "arm, and yet most of the tip error depends on them"
    ]

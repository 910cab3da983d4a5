"""The verdict: calibrated, use with care, or do not use; the doubts and warnings that decide it."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from casacal.calibration.before_fit import labels_alike, repeated
from casacal.calibration.calibration import FAR, LACK_OF_FIT, Calibration, parts_of
from casacal.calibration.finding import Finding
from casacal.calibration.mirror import DIAL_WAY, either_way
from casacal.calibration.motion import chance_worse, tip_extremes
from casacal.calibration.numbers import SCALE, TOOL, without_its_likes
from casacal.calibration.set_aside import OUTLIERS, robust_fit, studentised_outliers
from casacal.data.samples import Measurements
from casacal.data.text import typed_rows
from casacal.deployment.result import Verdict
from casacal.effects.selection import at_most, errors_are_shared
from casacal.effects.trusted import COVERED
from casacal.fit.bound_problem import BoundProblem, by_face, repeatability
from casacal.fit.kernel_rows import constraint_set
from casacal.fit.methods import minimises
from casacal.model.constraint import Constraint
from casacal.model.robot import Robot
from casacal.model.trace import PER_RAD
from casacal.uncertainty.moves import prior_scatter
from casacal.uncertainty.noise import is_usual
from casacal.uncertainty.tip_error import spread_rms
from casacal.wording import capital, chance, counted, figures, listed, lower, mm, sentence, shortened, sized, times

NOISE_BAND = (0.9, 1.1)  # found over stated noise: an interval outside this band is worth a warning
IMPROBABLE = 0.005  # chance below which a drawn arm that misses the planes by so little contradicts its priors
TOO_TIGHT = 1e-4  # chance of moves as large as these, all together, below which the priors are too tight for this arm
SETTLED = 0.1  # expected tip error over that before, below which the samples decide, however loose the priors
SHOWN = 6
DECLARE = "have the dial calibrated, or declare the error as unknown (gain=dial_gain(1) or cycle= of the instrument)"
VERIFY = "touch in other postures, and check with casacal verify whether the result holds there"
WIDEN = f"state wider priors (--accuracy, --prior) if the arm may be so far from its drawing; otherwise {VERIFY}"
REPEAT = (  # settles a doubt of unknown cause
    "touch some places three times each, which separates the scatter of touches from errors of the model; or state "
    "the noise, if it is known to be larger (--set noise_std=MM)"
)
GAIN = 0.9  # expected tip error over the one before, above which little was gained
WORSE = 1.1  # residual after over before, on the very rows that were fitted, above which calibrating made the arm worse
EXPLAINED = 0.5  # residual after over before, above which a fit that does not reach the noise has explained nothing
BENT = 10.0  # prior standard deviations by which no arm differs from its drawing; who knows better states wider priors
FARTHEST = 1e5  # mm or rad beyond which a number of an arm wandered off; result.schema.json takes none so large
TOO_LOOSE = 1e-3  # chance below which a drawn arm that misses so little contradicts its priors: they must not decide
USELESS = 20.0  # mm; an arm as drawn and a tool held against a rule err by less, so such a tip is not calibrated
LITTLE_TURNED = 20.0  # degrees between postures below which a tool is hardly seen
WORSE_IF_LOOSE = 0.005  # chance of a tip worse than as drawn, above which an arm with a loose joint is refused
LIKELY_WORSE = 0.1  # the same chance, above which any other arm is doubted
UNNAMED = (OUTLIERS, "misfit")  # findings that name no cause, as which a loose joint looks to the data check
MEND = "have it mended, then measure again"
AS_DRAWN = "the rows hardly differ from those of the arm as drawn: unless a gauge stood still, or they are a plan's, "
MEMBER = 1e-3  # part of a direction's length above which a parameter takes part in it
LEAST_SHOWN = 0.01  # millimetres below which nobody asks how little a tip errs
LEFT_TO_PRIORS = 0.5  # expected tip error over the one before, above which priors decide more of it than samples
OVERSTATED = 0.3  # found over stated noise, surely below which rows count for a tenth of what they are worth
CERTIFIED = 4.0  # standard deviations from what rows and priors say beyond which a certificate is not of this arm
CONTRADICTED = 1e-3  # chance below which new rows do not fit what an earlier result knows


@dataclass(frozen=True)
class Doubt:
    """A clause to put after "but", and a sentence.

    step: what settles it; empty where the data check, which was not run, may find the cause.
    """

    clause: str
    sentence: str
    step: str = ""


def warnings(calibration: Calibration) -> list[str]:
    """Sentences, most telling first; empty when there is nothing to warn of."""
    return [doubt.sentence for doubt in doubts(calibration)]


def doubts(calibration: Calibration) -> list[Doubt]:
    """Doubts about a calibration, most telling first; empty when there is nothing to warn of."""
    if not calibration.fit.unknowns:  # nothing moved, and nothing is known better or worse
        return []
    drawn = calibration.earlier is None  # what is known beforehand is not the drawing
    return [
        *_known_before(calibration),
        *_held_or_left_out(calibration),
        *(_far_parameters(calibration) if drawn else ()),
        *_samples(calibration),
        *_noise(calibration),
        *(_places_hardly_known(calibration) if drawn else ()),
        *_beside_the_geometry(calibration),
    ]


def _known_before(calibration: Calibration) -> Iterator[Doubt]:
    """Doubts about a dial's sign that no reading shows; inherited from the earlier result, or of what was loosened."""
    if (earlier := calibration.earlier) is None:
        if calibration.either_way:
            clause, rest = DIAL_WAY
            yield Doubt(clause, f"{capital(clause)}. {rest}.", "touch three places again with the arm 1 mm nearer")
        return
    if earlier.loosened:
        what = listed(list(earlier.loosened))
        clause = f"{what} may have changed, and no fresh rows have verified since that nothing else did"
        yield Doubt(clause, f"{capital(clause)}. Verify with rows in other postures.", VERIFY)
    if earlier.verdict.level != "calibrated":
        clause = "the earlier result was to be used with care"
        yield Doubt(clause, f"{capital(clause)}: {earlier.verdict.words}")


def _held_or_left_out(calibration: Calibration) -> Iterator[Doubt]:
    """Bounds on which the estimate lies (were they wrong, so would the arm be), rows set aside, a tool elsewhere."""
    if active := calibration.result.active:
        known = {each.name: each for each in calibration.fit.problem.exact}
        upper = [calibration.result.multipliers[name] > 0 for name in active]
        ends = [known[name].high if up else known[name].low for name, up in zip(active, upper, strict=True)]
        which = listed([f"'{name}' ({end:g} {known[name].unit})" for name, end in zip(active, ends, strict=True)])
        clause = f"the samples would cross the bound {which}"
        said = f"{capital(clause)}. The estimate lies on it, and every figure takes it for exact."
        step = "check the bound, or calibrate without it and see what the samples say by themselves"
        yield Doubt(clause, said, step)
    if calibration.aside:
        count = len(calibration.aside_lines)
        said, it = ("1 row was set aside", "it") if count == 1 else (f"{count} rows were set aside", "them")
        each = " ".join(str(finding).removeprefix("error: ") for finding in calibration.aside)
        yield Doubt(said, f"{said} and not used: {each}", f"measure {it} again, and calibrate with the new readings")
    for finding in calibration.tool_findings:
        clause = "the tool is not where the problem file says"
        if finding.about != TOOL:
            either = finding.about.replace(" or ", " from ")
            clause = f"these samples cannot tell {either}, so nothing is promised at the flange"
        said = (
            f"Tool offset: {finding.cause}. {finding.fix}. Until then figures hold for the tip with this tool, not for "
            "the flange; compensate and predict need --frame tip."
        )
        yield Doubt(clause, said, lower(finding.fix))


def _far_parameters(calibration: Calibration) -> Iterator[Doubt]:
    moved, names, together = calibration.moves, calibration.fit.names, calibration.prior_moves
    far = [j for j in np.argsort(-moved) if moved[j] > FAR]
    if not far and together.chance > TOO_TIGHT:
        return
    factor = f"{together.factor:.1f} times as far as their priors allow"
    said = f"Together, the parameters moved {factor}"
    if far:
        named = shortened([f"{names[j]} ({moved[j]:.1f})" for j in far], SHOWN)
        said = f"Parameters moved by more than {FAR:g} prior standard deviations: {named}. "
        said += f"Together they moved {factor}"
    clause = "parameters moved far beyond their priors"
    if calibration.borne_out:
        elsewhere = listed(sorted(calibration.borne_out))
        said += f". Regions of postures that were left out bear out that {elsewhere} of this arm "
        said += f"differ{'s' if len(calibration.borne_out) == 1 else ''} from the drawing"
        wider = f"correct {elsewhere} in the problem file, or state wider priors (--prior, --accuracy)"
        yield Doubt(clause, f"{said}. {capital(wider)}.", wider)
        return
    said += ". Either these priors are too tight for this arm (--accuracy, --prior), or the samples are wrong"
    yield Doubt(clause, f"{said}; {_what_check_says(calibration)}.", WIDEN if calibration.suspicious else "")


def _what_check_says(calibration: Calibration) -> str:
    """The data check's finding on the cause, as a clause; where it did not run, a pointer to it."""
    if not calibration.suspicious:
        return "casacal check looks for the cause"
    named = [error.about for error in calibration.data_errors if error.about != "misfit"]
    return f"the data check found {', '.join(named)}" if named else "the data check found no cause"


def _samples(calibration: Calibration) -> Iterator[Doubt]:
    """A common scale of all lengths, copies of rows, labels that may be slips, repeats that the fit misses."""
    scales = [each for each in calibration.instrument_findings if each.severity == "warning"]
    for finding in scales[:1]:
        yield Doubt(finding.cause.partition("; ")[0], str(finding).removeprefix("warning: "))
    measured = Measurements.of(calibration.samples)
    pairs = zip(measured.names, measured.sets, strict=True)
    found = (replace(each, instrument=name) for name, some in pairs for each in repeated(some))
    if said := " ".join(str(each).removeprefix("warning: ") for each in found if each.severity == "warning"):
        yield Doubt("some rows are copies of others", said, "remove the copies, or touch those places again")
    alike = labels_alike(calibration.bare.problem, measured)
    if said := " ".join(str(each).removeprefix("warning: ") for each in alike):
        step = "write one label where they are the same, and calibrate again"
        yield Doubt("some labels hardly differ from others", capital(said), step)
    if (again := calibration.noise.repeats) is not None and again.shared:
        yield Doubt(
            "the fit misses repeated touches by more than they scatter",
            f"Repeated touches at {again.places} places scatter by {times(again.ratio)} times the stated noise; the "
            f"fit misses them by {times(math.sqrt(again.f))} times that (F = {again.f:.3g}, {chance(again.chance)}). "
            "So the instrument is not the cause, but an error that the model does not describe. Repeats of a place "
            "therefore count as little more than one touch.",
        )


def _noise(calibration: Calibration) -> Iterator[Doubt]:
    noise, fit = calibration.noise, calibration.fit
    ratio, low, high = noise.ratio, noise.low, noise.high
    if (low <= NOISE_BAND[1] and high >= NOISE_BAND[0]) or (ratio < 1 and errors_are_shared(fit)):
        return
    joint, rad = repeatability(fit.scale)
    if joint:
        loose = sentence(_loose(fit.problem.robot, joint, rad))
        said = f"{loose} Touches that see it count less, and every target errs by it as well."
        yield Doubt(f"joint {joint} is loose", said, MEND)
    if is_usual(fit, NOISE_BAND[1]) or (joint and max(by_face(fit.scale).values(), default=1.0) <= NOISE_BAND[1]):
        return
    said = f"The residuals are {ratio:.2f} times the stated noise (95 % interval {low:.2f} to {high:.2f})"
    if ratio < 1:
        advice = "The stated noise is too large, and so are the standard deviations. Lower noise_std."
        yield Doubt("the stated noise is too large", f"{said}. {advice}")
        return
    advice = "The standard deviations are too small by about that factor. Raise noise_std, or find the cause."
    if noise.scale:
        factors = {name: fit.scale[name] for name in parts_of(fit) if name in fit.scale}
        more = [f"{name} {factor:.2g}" for name, factor in factors.items() if factor > NOISE_BAND[1]]
        right = [name for name, factor in factors.items() if factor <= NOISE_BAND[1]]
        others = f", {' and '.join(right)} as stated" if right else ""
        which = f"Times the stated noise: {', '.join(more)}{others}. " if more else ""
        advice = (
            f"{which}All figures use the noise as found. Possible causes: poor joint "
            "repeatability, transmission error of the motors' gears (state the gear ratios), a face that is not flat, "
            f"a tool that is not where the problem file says; {_what_check_says(calibration)}."
        )
        if rad > 0 and not joint:
            advice += f" The pattern fits a joint repeatability of {sized(rad, 'rad')}."
    yield Doubt(
        "the residuals exceed the stated noise",
        f"{said}. Either the noise is larger than stated, or the model leaves something out. {advice}",
        REPEAT if calibration.suspicious else "",
    )


def joint_error(robot: Robot, joint: int, rad: float) -> str:
    """A joint's error (rad, where `PER_RAD` mm of a sliding one are one) in words; `joint` is counted from 1."""
    return sized(rad, "rad") if robot.axes[joint - 1].turns else sized(PER_RAD * rad, "mm")


def _loose(robot: Robot, joint: int, rad: float) -> str:
    """A clause on a joint that alone does not repeat."""
    errs = f"it errs by {joint_error(robot, joint, rad)} (standard deviation) from touch to touch"
    return f"joint {joint} does not repeat: {errs}, as with play in its gear, which no calibration removes"


def counts_back(calibration: Calibration) -> bool:
    """Whether rows that were set aside fit with all others where the dial counts the other way."""
    open_way = bool(calibration.aside) and calibration.either_way
    return open_way and either_way(calibration.fit, Measurements.of(calibration.samples))


def broken(calibration: Calibration) -> str:
    """Why an arm must be mended before it is calibrated; empty where no joint is loose, or the rows have a cause.

    Also empty where the tip is nearer in spite of it, all but surely.
    """
    joint, rad = repeatability(calibration.fit.scale)
    if not joint or any(each.about not in UNNAMED for each in wrong_with_samples(calibration)):
        return ""
    worse = chance_worse(calibration.motion, calibration.workspace)
    if worse <= WORSE_IF_LOOSE and not unexplained(calibration):
        return ""
    return f"{_loose(calibration.fit.problem.robot, joint, rad)}, so that the tip may err more than as drawn; {MEND}"


def _places_hardly_known(calibration: Calibration) -> Iterator[Doubt]:
    """Priors that look too loose, and places of the workspace where the tip is known no better than before."""
    (prior, now), drawn = calibration.tip_std, calibration.metrics["before"]["fit"]
    prior_tip = prior
    if not math.isfinite(prior):  # a flat prior says nothing that samples could contradict; the others do
        (_, tips, slopes), stds = calibration.workspace, calibration.motion.arm.prior_std
        prior_tip = spread_rms(np.diag(np.where(np.isfinite(stds), stds, 0.0) ** 2), slopes, tips)
    assert drawn is not None
    moved, worst = tip_extremes(calibration.motion, calibration.workspace)
    scatter = None if now < SETTLED * prior_tip else prior_scatter(calibration.bare)
    if scatter is not None and not scatter.chance_below(drawn["rmse_mm"]) > IMPROBABLE:
        yield Doubt(
            "the priors look too loose",
            f"By the priors the drawn arm would miss the {calibration.fit.problem.words.things} by {mm(scatter.rms)} "
            f"RMS; it misses them by only {mm(drawn['rmse_mm'])}. So the priors look too loose, and calibration moves "
            f"the tip by up to {mm(moved)} in places that the samples do not cover. Tighten the priors (--accuracy, "
            "--prior), or verify there.",
        )
    if math.isfinite(now) and not worst < prior:
        yield Doubt(
            "in some places the tip is known no better than before",
            f"In the worst place of the workspace the tip's standard deviation is {mm(worst)}; before calibration it "
            f"was {mm(prior)} on average. Take samples there, or verify before you rely on it.",
        )
    elif (worse := chance_worse(calibration.motion, calibration.workspace)) > LIKELY_WORSE:
        yield Doubt(
            "the tip may err more than as drawn",
            f"By these rows the tip errs more over the workspace than that of the arm as drawn with a chance of "
            f"{figures(100 * worse, 1)} %. Touch in more postures, or verify before you rely on it.",
        )


def _beside_the_geometry(calibration: Calibration) -> Iterator[Doubt]:
    """Errors of the dial that nobody declared, effects that are too large or left out, rows that a loss ignored."""
    doubted, promised = {each.name: each.std for each in calibration.leverages}, calibration.tip_std[1]
    shown = [error for error in calibration.dial_errors if error.shown and error.tip_mm > promised]
    shown = [error for error in shown if error.size > COVERED * doubted.get(error.key, 0.0)]
    if shown:
        worst = max(shown, key=lambda error: error.tip_mm)
        yield Doubt(
            f"the rows show an undeclared {worst.words}",
            f"The rows show a {worst.words} of about {worst.shown_size}. The problem does not declare it, and it "
            f"changes the result by more than the expected tip error. {capital(DECLARE)}.",
            DECLARE,
        )
    if (too_large := larger_than_any(calibration)) is not None:
        yield too_large
    if lines := calibration.down_weighted:
        rows = f"{'1 row: line' if len(lines) == 1 else f'{len(lines)} rows: lines'} {shortened(lines, 2 * SHOWN)}"
        yield Doubt(
            f"the robust loss set aside {'a row' if len(lines) == 1 else f'{len(lines)} rows'}",
            f"The robust loss gave less than half of its weight to {rows}. Measure them again.",
        )
    declared = calibration.source.problem.terms
    if declared and not calibration.counts_effects:
        yield Doubt(
            "effects that the problem declares were left out",
            f"The problem declares {listed([effect.words for effect in declared])}, which a robust loss, some methods "
            "and --discrepancy none leave out: no figure counts them, and nothing corrects them.",
        )


def larger_than_any(calibration: Calibration) -> Doubt | None:
    """An effect came out at the largest size that is accepted."""
    found = at_most(calibration.fit) if any(calibration.fit.beside) else ()
    if not found:
        return None
    named = listed([effect.words for effect in found])
    sizes = listed([f"{effect.words} reached {effect.most:g} times the usual size" for effect in found])
    return Doubt(
        f"{named} reached the largest size that casacal accepts",
        f"{capital(sizes)}, the largest that casacal accepts. Something "
        "else probably errs as well, which no figure counts. What is corrected of it counts as an error all the same. "
        "casacal check looks for the cause; touches in other postures and on other faces separate the effects.",
    )


def verdict_of(calibration: Calibration) -> Verdict:
    """Whether to use a result; what speaks against it decides, the weightiest first."""
    calibration = calibration.unjudged
    if against := _against(calibration):
        reasons = tuple(reason for _, reason in against)
        return Verdict("do not use", f"Do not use this result: {against[0][0]}.", reasons)
    if not calibration.fit.unknowns:
        said = "every unknown is held, so nothing was estimated"
        words = f"Use with care: {said}; the residuals are those of the arm as drawn."
        return Verdict("use with care", words, (sentence(said),))
    found, expected, unchecked = doubts(calibration), _expected(calibration), ""
    if calibration.reference is None and minimises(calibration.method):
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


class WithVerdict(Calibration):
    """A calibration that knows its verdict."""

    @cached_property
    def verdict(self) -> Verdict:
        """How far the result may be used, and what speaks against it; it may take the whole data check to know."""
        return verdict_of(self)

    @property
    def denied(self) -> bool:
        """Whether the verdict is not to use this result."""
        return self.verdict.level == "do not use"


def _expected(calibration: Calibration) -> str:
    """The error to expect, of flange and tip; what matters first."""
    (before, now), (drawn, flange) = calibration.tip_std, calibration.flange_std
    least = "at least " if calibration.noise.low > NOISE_BAND[1] and not calibration.noise.scale else ""
    alone = "" if calibration.counts_effects else " and nothing errs beside the geometry"
    trusted = f"apart from the pose of the base, if {calibration.assumed} are right{alone}"
    if (tool := calibration.hidden_tool) is not None:
        said = f"expect a flange error of {least}{mm(flange)} RMS over the workspace (before: {mm(drawn)}), {trusted}. "
        said += f"The tip error of {mm(now)} is mostly the tool's: these samples hardly show {listed(tool.names)} "
        return f"{said}(standard deviation {mm(tool.std_mm)}). Measure it; once it is known, expect {mm(tool.tip_mm)}."
    names = calibration.fit.problem.names
    whose = f" ({names[0]})" if len(names) > 1 else ""
    at_flange = f" and {mm(flange)} at the flange" if math.isfinite(flange) else ""
    sizes = f"{least}{mm(now)} RMS over the workspace (before: {mm(before)})"
    return f"expect a tip error{whose} of {sizes}{at_flange}, {trusted}."


def _against(calibration: Calibration) -> list[tuple[str, str]]:
    """Reasons to refuse a result: for each a clause for the verdict's sentence, and a full sentence."""
    if clause := broken(calibration):  # whose rows look wrong in other ways, too
        return [(clause, sentence(clause))]
    # what is held as drawn, or certified of another arm, may look like wrong samples
    looks = (certificate_contradicted, held_as_drawn, earlier_contradicted, _out_of_reach)
    found = [(clause, sentence(clause)) for look in looks if (clause := look(calibration))]
    for error in wrong_with_samples(calibration):
        said = str(error).removeprefix("error: ").removesuffix(".")
        found.append((f"the samples look wrong ({error.about})", sentence(said)))
    if not found and counts_back(calibration):
        clause = "the dial counts the other way: with its sign reversed in the problem, no row would be set aside"
        found.append((clause, sentence(clause)))
    if not calibration.result.converged:  # unbounded directions are the reason where there are any
        flat, names = ~np.isfinite(calibration.bare.prior_std), calibration.bare.names
        null = [np.flatnonzero(np.abs(each.direction) > MEMBER) for each in calibration.identifiability.null]
        loose = [names[members[0]] for members in null if flat[members].all()]
        clause, said = "the method did not finish", calibration.result.message
        if loose:
            clause = f"neither the samples nor a prior hold {counted(len(loose), 'combination')} of parameters"
            them = "it" if len(loose) == 1 else "them"
            said = f"Give a prior to {listed(loose)} (--prior {loose[0]}=STD), or hold {them} (--fix)."
        found.append((clause, said))
    for look in (_missed_minimum, *((unexplained, priors_contradicted) if calibration.earlier is None else ())):
        if (not found or look is _missed_minimum) and (clause := look(calibration)):
            found.append((clause, sentence(clause)))
    if calibration.result.converged and not math.isfinite(calibration.tip_std[1]):
        clause = "these samples do not bound the tip error"
        found.append((clause, "Neither the samples nor a prior determine every direction that moves the tip."))
    elif calibration.result.converged and not found and calibration.tip_std[1] > USELESS:
        fit, covariance = calibration.fit, calibration.covariance
        places = [(name, j) for name, unit, _, j in fit.parameters() if j is not None and unit == "mm"]
        stds = {name: math.sqrt(covariance[j, j]) for name, j in places}
        unsure = sorted((name for name in stds if stds[name] > USELESS / 2), key=lambda name: -stds[name])
        which = f"The samples hardly show {listed(unsure)}" if unsure else "The samples show too little of the arm"
        turned = math.degrees(most_turned(fit))
        little = f" These postures turn the tool by at most {figures(turned, 2)} degrees."
        why = f"{which}.{little if turned < LITTLE_TURNED else ''}"
        clause = f"the tip would err by {mm(calibration.tip_std[1])}, more than an arm as drawn"
        found.append((clause, f"{why} Add postures that turn the tool far about two axes, or state priors."))
    return found


def certificate_contradicted(calibration: Calibration) -> str:
    """Why a certified quantity is not that of the arm that was measured; empty where none is at odds with the rest."""
    worst = max(certificates(calibration), key=lambda each: abs(each.off), default=None)
    if worst is None or not abs(worst.off) > CERTIFIED:
        return ""
    return (
        f"'{worst.name}', certified as {worst.value:g} {worst.unit}, contradicts rows and priors: without it they say "
        f"{worst.otherwise:.6g}, {abs(worst.off):.1f} standard deviations away; look whether it is of this arm, and "
        "in mm or rad"
    )


@dataclass(frozen=True)
class Certificate:
    """A certified quantity in `unit`, what rows and priors say without it, and how many standard deviations off."""

    name: str
    value: float
    unit: str
    otherwise: float
    off: float


def certificates(calibration: Calibration) -> tuple[Certificate, ...]:
    """What is certified of the arm, each against the rows and all other priors.

    The studentised residual of the certificate as one more row (Cook and Weisberg, Residuals and Influence in
    Regression, 1982, section 2.2.1): its residual over what is left of its variance.
    """
    fit, result, found = calibration.fit, calibration.result, []
    for each in fit.problem.constraints:
        if not isinstance(each, Constraint) or not each.std:
            continue
        told = constraint_set([each], fit.slots, np.ones(fit.unknowns))
        assert told is not None
        (now,), (slope,) = told.evaluate(result.x)
        seen = slope != 0
        left = 1 - float(slope[seen] @ result.covariance[np.ix_(seen, seen)] @ slope[seen]) / each.std**2
        left = left if left > 0 else 1.0  # of a method whose own covariance is no bound
        away = each.low - float(now)
        off = away / (each.std * math.sqrt(left))
        found.append(Certificate(each.name, each.low, each.unit, each.low - away / left, off))
    return tuple(found)


def most_turned(fit: BoundProblem) -> float:
    """Largest angle (rad) between the drawn arm's flange in the first row and in any other."""
    robot = fit.problem.robot
    q = ca.SX.sym("q", len(robot.axes))
    turn = ca.Function("turn", [q], [robot.traced.at_drawn(q)[:3, :3]])
    turns = np.array([np.array(turn(row)) for some in fit.measured.sets for row in some.joints])
    cosines = (np.einsum("ij,kij->k", turns[0], turns) - 1) / 2
    return float(np.arccos(np.clip(cosines, -1.0, 1.0)).max())


def wrong_with_samples(calibration: Calibration) -> tuple[Finding, ...]:
    """Errors in the fitted rows, by the whole data check where the fit is suspicious, else by the quick checks.

    Single rows are outliers where they are so beside effects and a loose joint too, not for geometry alone.
    """
    found = calibration.data_errors if calibration.suspicious else calibration.plain_errors
    own = [each for each in calibration.instrument_findings if each.severity == "error"]
    reported = {"misfit", SCALE, *(error.about for error in own)}
    explained = calibration.counts_effects or repeatability(calibration.fit.scale)[0]
    if any(error.about == OUTLIERS for error in found) and explained:
        robust = robust_fit(calibration.fit)
        if robust is None or not studentised_outliers(*robust).rows:  # effects explain what geometry alone does not
            reported.add(OUTLIERS)
    if any(error.about.endswith(" elsewhere") for error in found):
        reported |= {f"{name} elsewhere" for name in calibration.borne_out}
    return tuple(without_its_likes([*(error for error in found if error.about not in reported), *own]))


def _missed_minimum(calibration: Calibration) -> str:
    """Why the estimate is not the minimum; empty where it is.

    A method that promises the minimum must meet the reference; any other may miss it by what the estimate's own spread
    explains: twice the cost above the minimum is then about chi-square with as many degrees of freedom as unknowns.
    """
    reference = calibration.reference
    if reference is None or reference.agrees or not calibration.result.converged:
        return ""
    if not reference.result.converged:
        return f"{reference.solver} did not finish, so nothing confirms the minimum; another --reference may"
    if minimises(calibration.method):
        return f"the costs of {calibration.method} and {reference.solver} differ, so one of them missed the minimum"
    if 2 * (calibration.result.cost - reference.cost) <= calibration.fit.unknowns:
        return ""
    least = f"the {reference.cost:.4g} that {reference.solver} found"
    return f"{calibration.method} ended at a cost of {calibration.result.cost:.4g}, far above {least}"


def _out_of_reach(calibration: Calibration) -> str:
    """Numbers that wandered off where neither samples nor a prior hold them."""
    moved = {name: calibration.used_x[j] for name, _, _, j in calibration.fit.parameters() if j is not None}
    far = [name for name, by in moved.items() if not abs(by) < FARTHEST]
    if not far or not calibration.result.converged:
        return ""
    why = f"neither samples nor a prior hold it (--prior {far[0]}=STD)"
    return f"{far[0]} moved by {moved[far[0]]:.3g}, as no arm does: {why}"


def held_as_drawn(calibration: Calibration) -> str:
    """Faces and the like that took over the drawn arm's errors, so that the arm was fitted to these."""
    names = dict.fromkeys(slot.key for slot in calibration.fit.slots if slot.held_as_drawn)
    if not names or not calibration.fit.unknowns:
        return ""
    return (
        f"what was measured against is held where the arm as drawn has it ({', '.join(names)}), so the arm was fitted "
        "to its own errors; leave it free, or state in the problem where it is"
    )


def unexplained(calibration: Calibration) -> str:
    """Residuals far above the noise that the fit hardly lowered, or lowered only by bending the arm out of shape."""
    ratio, low = calibration.noise.ratio, calibration.noise.low
    before, after = (calibration.metrics[when]["fit"] for when in ("before", "after"))
    assert before is not None
    assert after is not None
    # where faces are held, what is not corrected may stand as a shift of the base, which no figure counts
    if calibration.fit.datum.any() and after["rmse_mm"] > WORSE * before["rmse_mm"]:
        else_found = larger_than_any(calibration)  # it cannot be corrected, and then decides more than the geometry
        also = f", and {else_found.clause}" if else_found else ""
        return f"the calibrated arm fits its own rows worse than the arm as drawn{also}"
    if low <= LACK_OF_FIT:
        return ""
    moved = float(calibration.moves.max(initial=0.0))
    said = f"the residuals are {times(ratio)} times what the stated noise explains"
    if after["rmse_mm"] > EXPLAINED * before["rmse_mm"]:
        return f"{said}, and calibrating hardly lowered them"
    if moved > FAR:
        return f"{said}, even though parameters moved by up to {moved:.0f} prior standard deviations"
    return ""


def earlier_contradicted(calibration: Calibration) -> str:
    """A reason where new rows contradict the earlier result, given what was loosened."""
    chance_of_rows = calibration.earlier_chance
    if calibration.earlier is None or not chance_of_rows < CONTRADICTED or not calibration.result.converged:
        return ""
    loosened = listed(list(calibration.earlier.loosened))
    what = f"something else than {loosened} has changed" if loosened else "something has changed"
    said = f"these rows contradict the earlier result ({chance(chance_of_rows)}): {what}, or rows are wrong. casacal "
    return f"{said}changed looks for it; name it with --loosen (loosen=), or calibrate anew"


def priors_contradicted(calibration: Calibration) -> str:
    """Priors that the samples contradict, and that yet decide most of where the tip is."""
    if not calibration.fit.unknowns:
        return ""
    (before, now), far = calibration.tip_std, float(calibration.moves.max(initial=0.0))
    worst = calibration.fit.names[int(np.argmax(calibration.moves))]
    if far > BENT and worst not in calibration.borne_out:
        return (
            f"{worst} moved by {times(far)} prior standard deviations. Either a sign, a unit or a label is wrong, or "
            "it is so far from what the problem says; state wider priors then (--prior, or --accuracy for the arm)"
        )
    drawn, scatter = calibration.metrics["before"]["fit"], prior_scatter(calibration.bare)
    before = calibration.flange_std[0]  # a tool's prior is no part of the arm's
    assert drawn is not None
    # were all priors so much narrower as the drawn arm contradicts them, this is what it would err by
    as_drawn = before * drawn["rmse_mm"] / scatter.rms if scatter.rms > 0 else math.inf
    if math.isfinite(before) and now > as_drawn and scatter.chance_below(drawn["rmse_mm"]) < TOO_LOOSE:
        if calibration.noise.high < OVERSTATED:
            planned = AS_DRAWN if drawn["rmse_mm"] < LEAST_SHOWN else ""
            said = f"the stated noise is {times(1 / calibration.noise.ratio)} times what the rows show"
            return f"{planned}{said}, so that they hardly count; state it as it is"
        said = f"{AS_DRAWN}the priors are too loose for this arm: they allow a tip error of {mm(before)} as drawn, but "
        said += f"its residuals suggest about {mm(max(as_drawn, LEAST_SHOWN))}, which is less than these priors leave "
        return f"{said}after calibrating (--accuracy, --prior)"
    if far <= FAR or now <= LEFT_TO_PRIORS * before:
        return ""
    said = f"the samples move parameters by up to {far:.0f} prior standard deviations, so these priors do not fit this "
    return f"{said}arm, and yet most of the tip error depends on them"


def repair(calibration: Calibration, check: str) -> str:
    """What to do about a refused result, as a clause, and empty where only a cure helps; `check`: the data check."""
    if counts_back(calibration):
        return "reverse the sign of the dial in the problem (--set sign=-1 or sign=1 tries it), and calibrate again."
    if broken(calibration):
        return f"{MEND}."
    reference, wrong = calibration.reference, wrong_with_samples(calibration)
    if held_as_drawn(calibration):
        return "free it, or state in the problem where it is, and calibrate again."
    if calibration.earlier is not None and earlier_contradicted(calibration):
        rows = f"casacal changed {shlex.quote(calibration.earlier.file)} {typed_rows(calibration.samples.file)}"
        return f"run {rows}, which says what has changed; then name that with --loosen."
    if wrong:
        for name in re.findall(r"--set (\S+?)=", wrong[0].fix):  # what is to be set otherwise is not set so again
            check = re.sub(rf" --set {re.escape(name)}=\S+", "", check)
        return f"{lower(wrong[0].fix)}; then run {check}."
    if not calibration.result.converged:
        return f"run {check}, which looks closer at the samples; or try another way to the minimum, --method lm."
    if reference is not None and not reference.agrees:
        if minimises(calibration.method):
            return f"run {check}; then compare the costs of --method lm and --method ipopt, and keep the lower one."
        return "use --method lm or sckf-lm, which go to the minimum."
    if (clause := priors_contradicted(calibration)) and not unexplained(calibration):
        look = "look whether these readings were measured; then " if clause.startswith(AS_DRAWN) else ""
        return f"{look}state priors that fit the arm (--accuracy MM, --prior NAME=STD), and calibrate again."
    if math.isfinite(calibration.tip_std[1]):
        return f"run {check}, which looks closer at the samples."
    return ""

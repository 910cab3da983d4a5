"""Warnings that a summary must not be without: what a good-looking fit may hide."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from casacal.calibration.calibration import FAR, Calibration, more_than_stated
from casacal.calibration.motion import tip_extremes
from casacal.uncertainty.discrepancy import at_most, errors_are_shared
from casacal.uncertainty.joint_repeatability import is_usual, repeats_to
from casacal.uncertainty.prior_moves import prior_scatter
from casacal.uncertainty.workspace import spread_rms
from casacal.wording import capital, chance, listed, lower, mm, shortened, sized, times

NOISE_BAND = (0.9, 1.1)  # found over stated noise: an interval outside this band is worth a warning
IMPROBABLE = 0.005  # chance below which a drawn arm that misses the planes by so little contradicts its priors
TOO_TIGHT = 1e-4  # chance of moves as large as these, all together, below which the priors are too tight for this arm
SETTLED = 0.1  # expected tip error over that before, below which the samples decide, however loose the priors

SHOWN = 6
DECLARE = "have the dial calibrated, or declare the error as unknown (gain=dial_gain(0.15) or cycle= of the instrument)"

VERIFY = "touch in other postures, and check with casacal verify whether the result holds there"
WIDEN = f"state wider priors (--accuracy, --prior) if the arm may be so far from its drawing; otherwise {VERIFY}"
REPEAT = (
    "touch some places three times each, which separates the scatter of touches from errors of the model; or state "
    "the noise, if it is known to be larger (--set noise_std=MM)"
)
"""Step that settles a doubt of unknown cause."""


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
    found: tuple[Callable[[Calibration], Doubt | None], ...] = (
        _rows_set_aside,
        _tool_elsewhere,
        _far_parameters,
        _scale,
        _repeated_rows,
        _labels_alike,
        _lack_of_fit,
        _noise,
        _loose_priors,
        _unknown_places,
        _dial_is_off,
        larger_than_any,
        _ignored_rows,
        _effects_left_out,
    )
    if calibration.earlier is not None:  # what is known beforehand is not the drawing
        found = (_since_earlier, *(look for look in found if look not in AS_DRAWN))
    return [doubt for look in found if (doubt := look(calibration)) is not None]


def _since_earlier(calibration: Calibration) -> Doubt | None:
    """A doubt inherited from the earlier result, or caused by what was loosened since."""
    earlier = calibration.earlier
    assert earlier is not None
    if earlier.loosened:
        what = listed(list(earlier.loosened))
        clause = f"{what} may have changed, and no fresh rows have verified since that nothing else did"
        return Doubt(clause, f"{capital(clause)}. Verify with rows in other postures.", VERIFY)
    if earlier.verdict.level != "calibrated":
        clause = "the earlier result was to be used with care"
        return Doubt(clause, f"{capital(clause)}: {earlier.verdict.words}")
    return None


def _scale(calibration: Calibration) -> Doubt | None:
    found = [each for each in calibration.instrument_findings if each.severity == "warning"]
    return Doubt(found[0].cause.partition("; ")[0], str(found[0]).removeprefix("warning: ")) if found else None


def _far_parameters(calibration: Calibration) -> Doubt | None:
    moved, names = calibration.moves, calibration.fit.names
    far = [j for j in np.argsort(-moved) if moved[j] > FAR]
    together = calibration.prior_moves
    if not far and together.chance > TOO_TIGHT:
        return None
    factor = f"{together.factor:.1f} times as far as their priors allow"
    said = f"Together, the parameters moved {factor}"
    if far:
        named = shortened([f"{names[j]} ({moved[j]:.1f})" for j in far], SHOWN)
        said = f"Parameters moved by more than {FAR:g} prior standard deviations: {named}. "
        said += f"Together they moved {factor}"
    return Doubt(
        "parameters moved far beyond their priors",
        f"{said}. Either these priors are too tight for this arm (--accuracy, --prior), or the "
        f"samples are wrong; {_what_check_says(calibration)}.",
        WIDEN if calibration.suspicious else "",
    )


def _what_check_says(calibration: Calibration) -> str:
    """The data check's finding on the cause, as a clause; where it did not run, a pointer to it."""
    if not calibration.suspicious:
        return "casacal check looks for the cause"
    named = [error.about for error in calibration.data_errors if error.about != "misfit"]
    return f"the data check found {', '.join(named)}" if named else "the data check found no cause"


def _rows_set_aside(calibration: Calibration) -> Doubt | None:
    if not (found := calibration.aside):
        return None
    rows = calibration.aside_lines
    said = "1 row was set aside" if len(rows) == 1 else f"{len(rows)} rows were set aside"
    each = " ".join(str(finding).removeprefix("error: ") for finding in found)
    it = "it" if len(rows) == 1 else "them"
    return Doubt(said, f"{said} and not used: {each}", f"measure {it} again, and calibrate with the new readings")


def _tool_elsewhere(calibration: Calibration) -> Doubt | None:
    if not calibration.tool_findings:
        return None
    (finding,) = calibration.tool_findings
    sentence = (
        f"Tool offset: {finding.cause}. {finding.fix}. Until then figures hold for the tip with this tool, not for the "
        "flange; compensate and predict need --frame tip."
    )
    return Doubt("the tool is not where the problem file says", sentence, lower(finding.fix))


def _repeated_rows(calibration: Calibration) -> Doubt | None:
    said = " ".join(str(finding).removeprefix("warning: ").removesuffix(".") for finding in calibration.repeated)
    step = "remove the copies, or touch those places again"
    return Doubt("some rows are copies of others", f"{said}; each was counted once.", step) if said else None


def _labels_alike(calibration: Calibration) -> Doubt | None:
    said = " ".join(str(finding).removeprefix("warning: ") for finding in calibration.labels_alike)
    step = "write one label where they are the same, and calibrate again"
    return Doubt("some labels hardly differ from others", capital(said), step) if said else None


def _lack_of_fit(calibration: Calibration) -> Doubt | None:
    again = calibration.noise.repeats
    if again is None or not again.shared:
        return None
    return Doubt(
        "the fit misses repeated touches by more than they scatter",
        f"Repeated touches at {again.places} places scatter by {times(again.ratio)} times the stated noise; the fit "
        f"misses them by {times(math.sqrt(again.f))} times that (F = {again.f:.3g}, {chance(again.chance)}). So the "
        "instrument is not the cause, but an error that the model does not describe. Repeats of a place therefore "
        "count as little more than one touch.",
    )


def _noise(calibration: Calibration) -> Doubt | None:
    noise, fit = calibration.noise, calibration.fit
    ratio, low, high = noise.ratio, noise.low, noise.high
    if (low <= NOISE_BAND[1] and high >= NOISE_BAND[0]) or (ratio < 1 and errors_are_shared(fit)):
        return None
    if is_usual(fit, NOISE_BAND[1]):
        return None
    said = f"The residuals are {ratio:.2f} times the stated noise (95 % interval {low:.2f} to {high:.2f})"
    if ratio < 1:
        advice = "The stated noise is too large, and so are the standard deviations. Lower noise_std."
        return Doubt("the stated noise is too large", f"{said}. {advice}")
    if noise.scale:
        advice = (
            f"{more_than_stated(fit, NOISE_BAND[1])}All figures use the noise as found. Possible causes: poor joint "
            "repeatability, transmission error of the motors' gears (state the gear ratios), a face that is not flat, "
            f"a tool that is not where the problem file says; {_what_check_says(calibration)}."
        )
        if (rad := repeats_to(fit)) > 0:
            advice += f" The pattern fits a joint repeatability of {sized(rad, 'rad')}."
    else:
        advice = "The standard deviations are too small by about that factor. Raise noise_std, or find the cause."
    return Doubt(
        "the residuals exceed the stated noise",
        f"{said}. Either the noise is larger than stated, or the model leaves something out. {advice}",
        REPEAT if calibration.suspicious else "",
    )


def _loose_priors(calibration: Calibration) -> Doubt | None:
    (prior_tip, tip), before = calibration.tip_std, calibration.metrics["before"]["fit"]
    if not math.isfinite(prior_tip):  # a flat prior says nothing that samples could contradict; the others do
        (_, tips, slopes), stds = calibration.workspace, calibration.motion.arm.prior_std
        prior_tip = spread_rms(np.diag(np.where(np.isfinite(stds), stds, 0.0) ** 2), slopes, tips)
    assert before is not None
    if tip < SETTLED * prior_tip:
        return None
    scatter = prior_scatter(calibration.bare)
    if scatter.chance_below(before["rmse_mm"]) > IMPROBABLE:
        return None
    things = calibration.fit.problem.words.things
    moved, _ = tip_extremes(calibration.motion, calibration.workspace)
    return Doubt(
        "the priors look too loose",
        f"By the priors the drawn arm would miss the {things} by {mm(scatter.rms)} RMS; it misses them by only "
        f"{mm(before['rmse_mm'])}. So the priors look too loose, and calibration moves the tip by up to {mm(moved)} in "
        "places that the samples do not cover. Tighten the priors (--accuracy, --prior), or verify there.",
    )


def _unknown_places(calibration: Calibration) -> Doubt | None:
    before, now = calibration.tip_std
    _, worst = tip_extremes(calibration.motion, calibration.workspace)
    if worst < before or not math.isfinite(now):
        return None
    return Doubt(
        "in some places the tip is known no better than before",
        f"In the worst place of the workspace the tip's standard deviation is {mm(worst)}; before calibration it was "
        f"{mm(before)} on average. Take samples there, or verify before you rely on it.",
    )


def _ignored_rows(calibration: Calibration) -> Doubt | None:
    lines = calibration.down_weighted
    if not lines:
        return None
    rows = f"{'1 row: line' if len(lines) == 1 else f'{len(lines)} rows: lines'} {shortened(lines, 2 * SHOWN)}"
    return Doubt(
        f"the robust loss set aside {'a row' if len(lines) == 1 else f'{len(lines)} rows'}",
        f"The robust loss gave less than half of its weight to {rows}. Measure them again.",
    )


def _effects_left_out(calibration: Calibration) -> Doubt | None:
    """The problem declares effects beside the geometry, and this fit has none."""
    declared = calibration.source.problem.terms
    if not declared or any(calibration.fit.beside):
        return None
    words = listed([effect.words for effect in declared])
    return Doubt(
        "effects that the problem declares were left out",
        f"The problem declares {words}, which a robust loss, some methods and --discrepancy none leave out: no figure "
        "counts them, and nothing corrects them.",
    )


def _dial_is_off(calibration: Calibration) -> Doubt | None:
    """The rows show an error of the dial that the problem does not know, and it bends the arm by more than promised."""
    shown = [error for error in calibration.dial_errors if error.shown and error.tip_mm > calibration.tip_std[1]]
    if not shown:
        return None
    worst = max(shown, key=lambda error: error.tip_mm)
    return Doubt(
        f"the rows show an undeclared {worst.words}",
        f"The rows show a {worst.words} of about {worst.shown_size}. The problem does not declare it, and it changes "
        f"the result by more than the expected tip error. {capital(DECLARE)}.",
        DECLARE,
    )


def larger_than_any(calibration: Calibration) -> Doubt | None:
    """An effect came out at the largest size that is accepted."""
    found = at_most(calibration.fit) if any(calibration.fit.beside) else ()
    if not found:
        return None
    named = listed([effect.words for effect in found])
    return Doubt(
        f"{named} reached the largest size that casacal accepts",
        f"{capital(named)} reached {found[0].most:g} times the usual size, the largest that casacal accepts. Something "
        "else probably errs as well, which no figure counts. What is corrected of it counts as an error all the same. "
        "casacal check looks for the cause; touches in other postures and on other faces separate the effects.",
    )


AS_DRAWN = (_far_parameters, _loose_priors, _unknown_places)
"""Doubts that compare with the drawing; a calibration with an earlier result skips them."""

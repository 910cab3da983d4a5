"""Doubts that a figure of accuracy must not be without, and what is said of effects beside the geometry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from casacal.calibration.calibration import Calibration
from casacal.calibration.corrections import VERY_STRONG, Tried
from casacal.calibration.motion import Motion
from casacal.uncertainty.discrepancy import at_most
from casacal.uncertainty.expectation import expected_accuracy
from casacal.uncertainty.identifiability import Identifiability
from casacal.uncertainty.scores import CLEAR, ScoreTest
from casacal.uncertainty.transfer import LeftOut
from casacal.wording import capital, listed, mm, sized


@dataclass(frozen=True)
class Doubt:
    """A clause to put after "but", and a sentence.

    step: what settles it; empty where the data check, which was not run, may find the cause.
    """

    clause: str
    sentence: str
    step: str = ""


OF_THE_DIAL = ("gain", "cycle")
"""Keys of the tests of a dial's own errors; they are made where these are no unknowns."""

DECLARE = "have the dial calibrated, or declare the error as unknown (gain=dial_gain(0.15) or cycle= of the instrument)"


def dial_is_off(calibration: Calibration) -> Doubt | None:
    """The rows show an error of the dial that the problem does not know, and it bends the arm by more than promised."""
    now = calibration.tip_std[1]
    shown = [
        test
        for test in calibration.score_tests
        if test.key in OF_THE_DIAL and test.p_holm < CLEAR and test.tip_mm > now
    ]
    if not shown:
        return None
    worst = max(shown, key=lambda test: test.tip_mm)
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
        "else probably errs as well, and the figures count only part of it. casacal check looks for the cause; touches "
        "in other postures and on other faces separate the effects.",
    )


def without_tips(found: Identifiability) -> Identifiability:
    """The same directions, without what they do to the tip: NaN."""
    null = tuple(replace(each, tip_mm=math.nan) for each in found.null)
    weak = tuple(replace(each, tip_mm=math.nan) for each in found.weak)
    return replace(found, null=null, weak=weak)


def without_predictions(faces: Sequence[LeftOut]) -> tuple[LeftOut, ...]:
    """The same faces, without what the others predict of them: NaN, and so their ratio."""
    return tuple(replace(each, predicted_mm=math.nan) for each in faces)


def without_motion(tests: Sequence[ScoreTest]) -> tuple[ScoreTest, ...]:
    """The same tests, without what the effects do to the tip: NaN."""
    return tuple(replace(each, tip_mm=math.nan) for each in tests)


def corrected_words(calibration: Calibration) -> list[str]:
    """What is corrected, and what is to be expected where nobody can; nothing where nothing is."""
    named = listed([each.words for each in calibration.tried if each.corrected])
    if not named:
        return []
    return [
        f"The result corrects {named}; predict, compensate and the C export apply it. Tables of lengths",
        f"and angles cannot: with those alone expect a tip error of {mm(tip_without_corrections(calibration))} RMS.",
    ]


def tip_without_corrections(calibration: Calibration) -> float:
    """Tip error (mm RMS) to expect over the workspace of the arm whose effects nobody corrects."""
    motion = Motion.of(calibration.fit, calibration.result, calibration.uncorrected_x)
    return expected_accuracy(motion.arm, motion.x, motion.off)[1]


def tried_words(calibration: Calibration) -> list[str]:
    """One line for each effect that could be corrected and that the rows speak for."""
    asked = [each for each in calibration.tried if each.unseen]
    if not asked:
        return ["None of them is corrected."] if calibration.tried else []
    return [became(each) for each in asked]


def size_words(calibration: Calibration, test: ScoreTest) -> tuple[str, str]:
    """Size of an effect and its tip error as people read them; no number where it is larger than can be believed.

    Each is worked out as if the effect were the only one. Where the geometry takes up most of it, that says nothing:
    what moves the arm is then shown as beyond the most that is accepted, what does not as beyond the residuals.
    """
    drawn = calibration.metrics["before"]["fit"]
    assert drawn is not None
    effect = next((each for each in calibration.fit.problem.effects if each.key == test.key and each.moves), None)
    most = effect.most * effect.size if effect is not None else drawn["rmse_mm"] if test.unit == "mm" else math.inf
    if test.size > most:
        return f"over {sized(most, test.unit)}", "-"
    return test.shown_size, mm(test.tip_mm) if test.tip_mm < calibration.tip_std[0] else "-"


def became(tried: Tried) -> str:
    """What became of an effect that the rows speak for, and why, as a clause."""
    splits = ", ".join(f"{name} {gain:+.1f}" for name, gain in tried.unseen.items())
    became = "corrected" if tried.corrected else "not corrected"
    told = (
        f"{tried.words}, {became}: log likelihood of held-out rows {splits} (at least {VERY_STRONG:+g} each required)"
    )
    return told if tried.corrected or tried.helps is None else f"{told}, but no gain at the tip"

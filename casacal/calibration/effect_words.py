"""What is said of effects beside the geometry that are corrected, and of those that were tried."""

from __future__ import annotations

import math

from casacal.calibration.calibration import Calibration
from casacal.calibration.corrections import VERY_STRONG, Tried
from casacal.calibration.motion import Motion
from casacal.uncertainty.expectation import expected_accuracy
from casacal.uncertainty.scores import ScoreTest
from casacal.wording import listed, mm, sized


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
        return ["  None of them is corrected."] if calibration.tried else []
    return [f"  {became(each)}" for each in asked]


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

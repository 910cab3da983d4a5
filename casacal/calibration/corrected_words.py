"""What is said of effects beside the geometry that are corrected, and of those that were tried."""

from __future__ import annotations

from casacal.calibration.calibration import Calibration
from casacal.calibration.corrections import VERY_STRONG, Tried
from casacal.calibration.motion import Motion
from casacal.uncertainty.expectation import expected_accuracy


def corrected_words(calibration: Calibration) -> list[str]:
    """What is corrected, and what is to be expected where nobody can; nothing where nothing is."""
    named = " and ".join(each.words for each in calibration.tried if each.corrected)
    if not named:
        return []
    return [
        f"That corrects {named}, as predict, compensate and the C export do. Tables of lengths",
        f"and angles cannot: with these alone expect {tip_without_corrections(calibration):.3f} mm RMS.",
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


def became(tried: Tried) -> str:
    """What became of an effect that the rows speak for, and why, as a clause."""
    splits = ", ".join(f"{name} {gain:+.1f}" for name, gain in tried.unseen.items())
    told = f"{tried.words}, {{}}: logarithm of the density of left-out rows by {splits}, {VERY_STRONG:g} asked of each"
    if tried.corrected:
        return told.format("corrected")
    return told.format("not corrected") + ("" if tried.helps is None else ", but no gain for the tip")

"""Doubts that a figure of accuracy must not be without, and what a verdict that denies a result takes away."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from casacal.calibration.calibration import Calibration
from casacal.uncertainty.discrepancy import at_most
from casacal.uncertainty.identifiability import Identifiability
from casacal.uncertainty.scores import CLEAR, ScoreTest
from casacal.uncertainty.transfer import LeftOut
from casacal.wording import capital, listed


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

"""What a verdict that denies a result takes away: figures of accuracy, which are then worth nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from casacal.uncertainty.identifiability import Identifiability
from casacal.uncertainty.left_out import LeftOut
from casacal.uncertainty.score_test import ScoreTest


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

"""The arm where rows have the columns that tell an effect, such as torques or a payload, for result.json."""

from __future__ import annotations

import math
from itertools import chain, combinations
from typing import Any

import numpy as np

from casacal.calibration.calibration import Calibration
from casacal.calibration.motion import Motion, doubtful, used_arm
from casacal.uncertainty.expectation import expected_accuracy
from casacal.uncertainty.figures import residual_figures
from casacal.wording import listed, mm


def told_part(calibration: Calibration, *, denied: bool) -> dict[str, Any]:
    """Which columns tell an effect, their sizes in the fitted rows, and the arm for each choice of such effects.

    Empty where none is told. Each choice holds the effects, the unknowns of the geometry, by how much those that move
    the tip are elsewhere, and the tip error to expect, mm RMS over the workspace.
    """
    fit, keys = calibration.fit, calibration.told
    block = fit.blocks[0]
    usual = {
        name: float(value)
        for name, value, away in zip(block.model.names, block.usual, block.elsewhere, strict=True)
        if value != away
    }
    if not keys:
        return {"usual": usual} if usual else {}
    choices = chain.from_iterable(combinations(keys, count) for count in range(1, len(keys) + 1))
    further = {each.key: list(each.further) for each in calibration.tried if each.told}
    return {"usual": usual, "further": further, "told": [_arm_where(calibration, some, denied) for some in choices]}


def told_words(calibration: Calibration, *, denied: bool) -> list[str]:
    """What rows with the columns that tell effects are worth; of a result that is denied, residuals alone."""
    told = [each for each in calibration.tried if each.told]
    if not told:
        return []
    columns = listed([name for each in told for name in each.further])
    said = f"Where rows have {columns}, predict, compensate and the exports c and casadi correct "
    said += f"{listed([each.words for each in told])}"
    if not denied:
        motion = told_motion(calibration, calibration.told)
        return [
            f"{said}: expect a tip error of {mm(expected_accuracy(motion.arm, motion.x, motion.off)[1])} RMS there."
        ]
    fit, used = (
        calibration.fit,
        used_arm(calibration.fit, calibration.result, {*calibration.corrected, *calibration.told}),
    )
    without, left = (
        residual_figures(fit.plain_residual(x)[fit.leading])["rmse_mm"] for x in (calibration.used_x, used)
    )
    return [f"{said}: so used, the fitted rows miss by {mm(left)} RMS, else by {mm(without)}; that is no accuracy."]


def told_motion(calibration: Calibration, keys: tuple[str, ...]) -> Motion:
    """The tip where these effects are corrected on top of what is corrected anyway."""
    fit, result, corrected = calibration.fit, calibration.result, {*calibration.corrected, *keys}
    doubted = doubtful(fit, corrected)
    sure = used_arm(fit, result, corrected - doubted) if doubted else None
    return Motion.of(fit, result, used_arm(fit, result, corrected), sure=sure)


def _arm_where(calibration: Calibration, keys: tuple[str, ...], denied: bool) -> dict[str, Any]:
    fit, motion = calibration.fit, told_motion(calibration, keys)
    used = used_arm(fit, calibration.result, {*calibration.corrected, *keys})
    unknowns = zip(fit.names, used, fit.beside, strict=True)
    part: dict[str, Any] = {
        "effects": list(keys),
        "unknowns": [{"name": name, "value": float(value)} for name, value, beside in unknowns if not beside],
        "expected_rms_mm": math.nan if denied else expected_accuracy(motion.arm, motion.x, motion.off)[1],
    }
    return part if denied else {**part, "off": np.zeros(motion.x.size) if motion.off is None else motion.off}

"""The arm where rows have the columns that tell an effect, such as torques or a payload, and its verdict."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import asdict, replace
from itertools import chain, combinations
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.calibration.calibration import Calibration
from casacal.calibration.verdict import Verdict, verdict_of
from casacal.discrepancy.effect import Site
from casacal.wording import listed, lower

OF_ROWS = ("plain", "data_errors", "plain_errors", "effect_sizes", "dial_errors")
"""Figures that take fits and do not depend on what is corrected."""


def where_told(calibration: Calibration, keys: Collection[str] | None = None) -> Calibration:
    """The calibration of the arm where these effects are corrected as well, by default all that columns tell."""
    keys, whole = calibration.told if keys is None else keys, calibration.unjudged
    tried = tuple(replace(each, further=()) if each.key in keys else each for each in whole.tried)
    found = replace(whole, tried=tried)
    vars(found).update({name: value for name, value in vars(whole).items() if name in OF_ROWS})
    return found


def told_part(calibration: Calibration) -> dict[str, Any]:
    """Which columns tell an effect, how large they are in the fitted rows, and the arm for each choice of such effects.

    Empty where none is told. Each choice holds the effects, the unknowns of the geometry, its verdict, by how much
    those that move the tip are elsewhere, and the tip error to expect, mm RMS over the workspace.
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
    told = [_arm_where(calibration, some) for some in choices]
    return {"usual": usual, "range": _ranges(calibration), "further": further, "told": told}


def _ranges(calibration: Calibration) -> dict[str, dict[str, float]]:
    """Lowest and highest value in the fitted rows of the columns that tell an effect by amounts."""
    problem, found = calibration.fit.problem, dict[str, list[Array]]()
    effects = [effect for effect in problem.effects if effect.key in calibration.told]
    for instrument, block in zip(problem.instruments, calibration.fit.blocks, strict=True):
        for effect in effects:
            for column, values in effect.amounts(Site(problem.robot, instrument), block.samples).items():
                found.setdefault(column, []).append(values)
    return {
        column: {
            "lowest": min(float(each.min()) for each in parts),
            "highest": max(float(each.max()) for each in parts),
        }
        for column, parts in found.items()
    }


def _arm_where(calibration: Calibration, keys: tuple[str, ...]) -> dict[str, Any]:
    fit, arm = calibration.fit, where_told(calibration, keys)
    verdict, motion = verdict_of(arm), arm.motion
    denied = verdict.level == "do not use"
    unknowns = zip(fit.names, arm.used_x, fit.beside, strict=True)
    part: dict[str, Any] = {
        "effects": list(keys),
        "verdict": asdict(verdict),
        "unknowns": [{"name": name, "value": float(value)} for name, value, beside in unknowns if not beside],
        "expected_rms_mm": math.nan if denied else arm.tip_std[1],
    }
    return part if denied else {**part, "off": np.zeros(motion.x.size) if motion.off is None else motion.off}


def verdict_lines(calibration: Calibration, verdict: Verdict) -> list[str]:
    """The verdict, which governs; before it that of the arm where rows have all columns that tell effects."""
    if not calibration.told:
        return [verdict.words]
    names = [name for each in calibration.tried if each.told for name in each.further]
    known, several = verdict_of(where_told(calibration)), len(names) > 1
    columns = f"the column{'s' * several} {listed(names)}"
    return [
        f"With {columns}, in predict, compensate, verify and the exports c and casadi: {lower(known.words)}",
        f"Without {'them' if several else columns}, and in tables of lengths and angles: {lower(verdict.words)}",
    ]

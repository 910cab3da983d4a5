"""Effects that columns of the rows tell, such as torques: what these columns held, and what they are worth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.calibration.calibration import Calibration
from casacal.compensation.result import Verdict
from casacal.discrepancy.effect import effects_of
from casacal.problem.term import Site
from casacal.uncertainty.workspace import without_rigid, workspace_joints
from casacal.wording import listed, mm


def columns_told(calibration: Calibration) -> dict[str, tuple[Array, Array]]:
    """Mean and standard deviation over the fitted rows of each column of a row model that tells a corrected effect."""
    problem, found = calibration.fit.problem, dict[str, list[Array]]()
    for instrument, block in zip(problem.instruments, calibration.fit.blocks, strict=True):
        for effect in problem.terms:
            if effect.key in calibration.told:
                for name, values in effect.told(Site(problem.robot, instrument), block.samples).items():
                    found.setdefault(name, []).append(values)
    every = {name: np.concatenate(parts) for name, parts in found.items()}
    return {name: (values.mean(), values.std()) for name, values in every.items()}


def without_columns(calibration: Calibration) -> float:
    """Tip error to expect, mm RMS over the workspace, of rows that lack these columns, which then stand at their means.

    What is known of the arm, and how far each column's deviation from its mean moves the tip.
    """
    block, known = calibration.fit.blocks[0], columns_told(calibration)
    joints = workspace_joints(calibration.fit.problem.robot)
    names, x = list(block.model.names), calibration.used_x
    at = np.array([known.get(name, (away, 0.0))[0] for name, away in zip(names, block.elsewhere, strict=True)])
    tips = block.tips_where(x, joints, at)
    squares = calibration.tip_std[1] ** 2
    for name, (_, spread) in known.items():
        moved = block.tips_where(x, joints, at + spread * (np.array(names) == name)) - tips
        squares += 3 * float((without_rigid(moved.ravel(), tips) ** 2).mean())
    return math.sqrt(squares)


def columns_part(calibration: Calibration) -> dict[str, Any]:
    """Which columns tell an effect, and what they held in the fitted rows; empty where none is told."""
    block = calibration.fit.blocks[0]
    usual = {
        name: float(value)
        for name, value, away in zip(block.model.names, block.usual, block.elsewhere, strict=True)
        if value != away
    }
    if not calibration.told:
        return {"usual": usual} if usual else {}
    known = columns_told(calibration)
    return {
        "usual": usual,
        "mean": {name: float(mean) for name, (mean, _) in known.items()},
        "spread": {name: float(spread) for name, (_, spread) in known.items()},
        "range": _ranges(calibration),
        "further": {each.key: list(each.further) for each in calibration.tried if each.told},
    }


def _ranges(calibration: Calibration) -> dict[str, dict[str, float]]:
    """Lowest and highest value in the fitted rows of the columns that tell an effect by amounts."""
    problem, found = calibration.fit.problem, dict[str, list[Array]]()
    effects = [effect for effect in effects_of(problem) if effect.key in calibration.told]
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


def verdict_lines(calibration: Calibration, verdict: Verdict) -> list[str]:
    """The verdict, and what it is worth for who lacks the columns that tell effects."""
    if not calibration.told or verdict.level == "do not use":
        return [verdict.words]
    columns = listed([name for each in calibration.tried if each.told for name in each.further])
    return [
        verdict.words,
        f"That is where rows have {columns}, in predict, compensate, verify and the exports c and casadi; without, "
        f"expect a tip error of {mm(without_columns(calibration))} RMS.",
    ]

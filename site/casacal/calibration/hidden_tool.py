"""A tool that the samples hardly show, and what of the tip error is its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.calibration.motion import Motion
from casacal.uncertainty.identifiability import verdict
from casacal.uncertainty.workspace import tip_rms, tip_stds, tool_unknowns, without_rigid

PART = 0.5  # tip error with a tool that is exactly known over that as it is, below which the tool decides most of it


@dataclass(frozen=True)
class HiddenTool:
    """Coordinates of the tool that the samples hardly show and that decide most of the tip error.

    std_mm: of the least known. tip_mm: the tip error to expect were the tool's point exactly known.
    """

    names: tuple[str, ...]
    std_mm: float
    tip_mm: float


def hidden_tool(motion: Motion, workspace: tuple[Array, Array, Array]) -> HiddenTool | None:
    """What of the tool the samples hardly show; None where most of the tip error is the arm's.

    Of joint values, tips and slopes there, as `tip_extremes`; the covariance must be finite.
    """
    arm, covariance, (_, tips, slopes) = motion.arm, motion.covariance, workspace
    tool, stds = tool_unknowns(arm, motion.x), np.sqrt(np.diagonal(covariance))
    tool = np.array([j for j in tool if arm.units[j] == "mm"], dtype=int)
    hidden = [j for j in tool if verdict(stds[j], float(arm.prior_std[j])) != "data"]
    if not hidden:
        return None
    with_tool = covariance[tool]
    known = covariance - with_tool.T @ np.linalg.solve(with_tool[:, tool], with_tool)
    field = without_rigid(slopes, tips)
    now, tip = (tip_rms(tip_stds(each, field, motion.off).ravel()) for each in (covariance, known))
    return HiddenTool(tuple(arm.names[j] for j in hidden), float(stds[hidden].max()), tip) if tip < PART * now else None

"""Remark in every exported file: where it comes from, and how far to trust it."""

from __future__ import annotations

import math
from pathlib import Path

from casacal.deployment.arm import CalibratedArm
from casacal.deployment.result_file import arm_from
from casacal.files import MADE
from casacal.model.dh_table import DHTable
from casacal.model.robot import Robot
from casacal.model.urdf import UrdfChain

TAKES_COLUMNS = ("c", "casadi")  # forms with an input for what columns tell of effects

MARK = "casacal: "
"""Prefix of each of these lines, by which they are replaced when a file is written back again."""


def remark(result: CalibratedArm, *, form: str = "c") -> list[str]:
    """Lines, without comment signs, on the origin and the expected accuracy of what is exported.

    form: every form but "c", "casadi" and a work object ("frame") holds lengths and angles alone, none of the effects
    beside them that a result corrects; what columns tell is in those of `TAKES_COLUMNS` alone.
    """
    result = arm_from(result)
    takes = form in TAKES_COLUMNS
    found, effects, name = result.found, result.found.effects, result.source.name
    if found.method == "truth":
        return [f"{MARK}the true arm of a simulation of {name}, not a calibration ({MADE})"]
    lines = [f"{MARK}{name}, calibrated by {found.method}, {Path(result.file).name}, {MADE}"]
    if not found.converged:
        lines.append(f"{MARK}WARNING, this is not a minimum: {found.status}")
    if (words := result.denial) is not None:
        return [*lines, f"{MARK}WARNING, forced against the verdict: {words}"]
    keys, error, called = effects.corrected, found.tip.expected_mm, found.called
    named = " and ".join(called[key] for key in called if key in keys)
    alone = bool(keys) and not takes and form != "frame"
    if alone:
        error = effects.uncorrected_mm
        lines.append(f"{MARK}not in this form: {named}, which predict, compensate and the forms c and casadi correct")
    elif keys:
        lines.append(f"{MARK}corrected beside the geometry: {named}")
    for key, names in effects.further.items() if takes else ():
        lines.append(f"{MARK}{called[key]} takes {', '.join(names)} as inputs")
    if (care := result.caution) is not None:
        level = f"{care.partition(':')[0]}; its words and its figure are those of the corrected arm"
        lines.append(f"{MARK}the result's verdict: {level if alone else care}")
    if (image := result.mirror_words) is not None:
        lines.append(f"{MARK}{image}")
    where = "mm RMS over the workspace, apart from the pose of the base"
    errors = (error, math.nan if alone else found.tip.flange_expected_mm)
    tip, flange = ("not known" if math.isnan(each) else f"{each:.3f} {where}" for each in errors)
    if form != "zeros":  # which hold no more than a part of the correction, and say of how much
        held = "" if form == "frame" else "with the tool as calibrated, which is no part of it; "
        lines.append(f"{MARK}expected tip error: {tip}; {held}small residuals on planes are not accuracy")
    if form not in ("zeros", "frame"):
        lines.append(f"{MARK}expected error of the flange, which this form holds: {flange}")
    return [*lines, f"{MARK}what the samples do not determine is as the prior has it; the result names it"]


def other_forms(robot: Robot) -> str:
    """Advice to export an arm in the forms that hold it."""
    own = {DHTable: "dh, ", UrdfChain: "urdf, "}
    return f"Export it as {own.get(type(robot.arm), '')}zeros or c"

"""The calibrated DH table as a file of its own, CSV or TOML."""

from __future__ import annotations

import math
from dataclasses import replace

from casacal.compensation.arm import CalibratedArm, arm_values
from casacal.compensation.result_file import arm_from
from casacal.errors import CasacalError
from casacal.export.remark import other_forms, remark
from casacal.robots.dh_table import DHTable
from casacal.robots.files.dh_file import dh_file_text


def dh_text(result: CalibratedArm, *, toml: bool = False) -> str:
    """The calibrated DH table in its own convention, with the controller's joint signs, offsets and coupling.

    result: of a robot built by `Robot.from_dh` or `from_dh_file`; where axes are parallel, Hayati's `beta` stands in
    place of `d`. toml: TOML in place of CSV. Raises CasacalError for other robots.
    """
    result = arm_from(result)
    arm = result.source.problem.robot.arm
    if not isinstance(arm, DHTable):
        fix = other_forms(result.source.problem.robot)
        raise CasacalError(f"'{result.source.problem.robot.name}' was not built from a DH table", fix)
    table = arm.at(arm_values(result))
    table = replace(table, alpha=tuple(math.remainder(twist, math.tau) for twist in table.alpha))  # as files have it
    text = dh_file_text(table, "arm.toml" if toml else "arm.csv")
    return "".join(f"# {line}\n" for line in remark(result, form="dh")) + text

"""The forms by name, one door for the command line and for Python; and the DH table, the simplest of them."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

from casacal.compensation.arm import CalibratedArm, arm_values
from casacal.compensation.result_file import arm_from
from casacal.errors import CasacalError, UnknownNameError, came
from casacal.export.controllers import ur_kinematics_text, urdf_text, zeros_text
from casacal.export.functions import c_text, casadi_text
from casacal.export.remark import MARK, other_forms, remark
from casacal.files import MADE, write_text
from casacal.robots.dh_table import DHTable, dh_file_text, is_toml

FORMS = ("dh", "urdf", "zeros", "ur", "c", "casadi")
"""DH table (CSV, or TOML by the file's name), URDF, zero corrections (CSV), ur_description's kinematics, C99, and
a `casadi.Function` of q to the flange pose, which `casadi.Function.load` reads."""


def export(
    arm: CalibratedArm,
    form: str,
    path: str | Path | None = None,
    *,
    source: str | Path | None = None,
    prefix: str | None = None,
    force: bool = False,
) -> str:
    """A calibrated arm in a form that others read, as text.

    form: one of `FORMS`. path: file to write it to; None writes nothing. source: for "urdf", the file written
    back with only its numbers changed. prefix: for "c", what the functions' names begin with; by default the problem's
    name. force: write a result whose verdict is not to use it, with that verdict as a comment.

    Raises UnknownNameError for another form, CasacalError where the arm cannot be said in it, or is not to be used.
    """
    arm = arm_from(arm)
    if not isinstance(form, str) or form not in FORMS:
        raise UnknownNameError("form", str(form), FORMS)
    for place in (path, source):
        if place is not None and not isinstance(place, (str, Path)):
            raise CasacalError(f"Got {came(place)} as a path", "Give a path, or nothing")
    if source is not None and form != "urdf":
        raise CasacalError(f"The form '{form}' writes no file back", "Leave out the source")
    if prefix is not None and form != "c":
        raise CasacalError(f"The form '{form}' has no prefix", "Leave it out")
    arm.check_usable(force=force)
    if form == "dh":
        text = dh_text(arm, toml=path is not None and is_toml(path))
    elif form == "urdf":
        text = _remarked(urdf_text(arm, source), arm)
    elif form == "c":
        text = c_text(arm, prefix=prefix)
    elif form == "casadi":
        text = f"{casadi_text(arm)}\n# {MADE}\n"  # behind what casadi.Function.load reads
    else:
        text = zeros_text(arm) if form == "zeros" else ur_kinematics_text(arm)
    if path is not None:
        write_text(path, text)
    return text


def dh_text(result: CalibratedArm, *, toml: bool = False) -> str:
    """The calibrated DH table in its own convention, with the controller's joint signs, offsets and coupling.

    result: of a robot built by `Robot.from_dh` or `from_dh_file`; where axes are parallel, Hayati's `beta` stands in
    place of `d`. toml: TOML in place of CSV. Raises CasacalError for other robots.
    """
    result = arm_from(result)
    robot = result.source.problem.robot
    if not isinstance(robot.arm, DHTable):
        raise CasacalError(f"'{robot.name}' was not built from a DH table", other_forms(robot))
    table = robot.arm.at(arm_values(result))
    table = replace(table, alpha=tuple(math.remainder(twist, math.tau) for twist in table.alpha))  # as files have it
    text = dh_file_text(table, "arm.toml" if toml else "arm.csv")
    return "".join(f"# {line}\n" for line in remark(result, form="dh")) + text


def _remarked(text: str, arm: CalibratedArm) -> str:
    """A URDF with its remark as a comment before its first element, in place of an older one."""
    text = re.sub(rf"<!-- {MARK}.*?-->\r?\n?", "", text, flags=re.DOTALL)
    words = "\n".join(remark(arm, form="urdf")).replace("--", "- -")  # a comment holds no two hyphens
    place = re.search(r"<(?=[A-Za-z_])", text)
    assert place is not None
    return f"{text[: place.start()]}<!-- {words} -->\n{text[place.start() :]}"

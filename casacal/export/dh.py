"""The calibrated DH table as CSV or TOML: in the layout of the file it came from, or afresh."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import numpy as np

from casacal.compensation.arm import CalibratedArm, arm_values
from casacal.compensation.result_file import arm_from
from casacal.errors import CasacalError, ProblemError
from casacal.export.dh_layout import written_into_csv, written_into_toml
from casacal.export.remark import MARK, other_forms, remark
from casacal.robots.dh_table import DHTable
from casacal.robots.files.dh_file import dh_file_text, is_toml, read_dh_file
from casacal.robots.files.dh_text import decode

SAME = {"alpha": 1e-8, "a": 1e-6, "d": 1e-6, "theta": 1e-8}
"""Difference, rad or mm, below which a file's number is the one that the calibration began with."""


def dh_text(result: CalibratedArm, source: str | Path | None = None, *, toml: bool = False) -> str:
    """The calibrated DH table in its own convention, with the controller's joint signs, offsets and coupling.

    Args:
        result: of a robot built by `Robot.from_dh` or `from_dh_file`.
        source: the DH file the table came from, to be written back with nothing but its numbers changed; where axes
            are parallel, Hayati's `beta` is added if the file has none. None writes a file afresh.
        toml: without a source, TOML in place of CSV.

    Raises CasacalError for other robots, and for a source that is not the table the calibration began with.

    """
    result = arm_from(result)
    arm = result.source.problem.robot.arm
    if not isinstance(arm, DHTable):
        raise CasacalError(
            f"'{result.source.problem.robot.name}' was not built from a DH table",
            other_forms(result.source.problem.robot),
        )
    table = arm.at(arm_values(result))
    if source is None:
        return _remarked(dh_file_text(table, "arm.toml" if toml else "arm.csv"), remark(result, form="dh"))
    _check_source(source, arm)
    text = decode(Path(source))
    written = written_into_toml(text, table) if is_toml(source) else written_into_csv(text, table)
    marked = Path(source).read_bytes()[:2] in (b"\xef\xbb", b"\xff\xfe", b"\xfe\xff")  # a byte-order mark
    written = ("\ufeff" if marked else "") + _remarked(written, remark(result, form="dh"))
    _check_written(written, source, table)
    return written


def _remarked(text: str, lines: list[str]) -> str:
    """Text with comment lines on top, in place of older ones, in the line ends of the text."""
    end = "\r\n" if "\r\n" in text else "\n"
    text = re.sub(rf"(?m)^# {MARK}.*(\r\n|\n|\r|\Z)", "", text)
    return "".join(f"# {line}{end}" for line in lines) + text


def _check_source(source: str | Path, arm: DHTable) -> None:
    """Refuse a file that is not the table the calibration began with."""
    began = read_dh_file(source)
    wrong = ""
    if len(began.joints) != len(arm.joints):
        wrong = f"it has {len(began.joints)} joints, the calibrated arm {len(arm.joints)}"
    elif began.convention != arm.convention:
        wrong = f"its convention is {began.convention}, the calibrated arm's {arm.convention}"
    elif began.parallel not in ((), arm.parallel):
        wrong = f"its parallel rows are {list(began.parallel)}, the calibrated arm's {list(arm.parallel)}"
    elif not _same_conventions(began, arm):
        wrong = "its joint signs, offsets or coupling are not those of the calibrated arm"
    for key, tolerance in SAME.items():
        if wrong:
            break
        for i, (one, two) in enumerate(zip(getattr(began, key), getattr(arm, key), strict=True), 1):
            if abs(one - two) > tolerance:
                wrong = f"{key} of row {i} is {one:.9g}, where the calibration began with {two:.9g} (mm, rad)"
                break
    if wrong:
        raise CasacalError(
            f"{source}: {wrong}", "Give the file that the problem was made from, or leave out the source"
        )


def _same_conventions(one: DHTable, two: DHTable) -> bool:
    """Whether two tables mean the same by a controller's joint values."""
    rows = []
    for table in (one, two):
        count = len(table.joints)
        made = table.conventions
        rows.append((np.eye(count), np.zeros(count)) if made is None else (made.matrix, np.array(made.offsets)))
    return all(np.allclose(a, b, atol=1e-8) for a, b in zip(*rows, strict=True))


def _check_written(text: str, source: str | Path, table: DHTable) -> None:
    """Refuse to hand over a text that does not read as the calibrated table."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / Path(source).name
        path.write_bytes(text.encode("utf-8"))
        try:
            again = read_dh_file(path)
            keys = (*SAME, "beta")
            good = again.parallel == table.parallel or not any(table.beta)
            good = good and all(np.allclose(getattr(again, k), getattr(table, k), rtol=0, atol=1e-8) for k in keys[:4])
            good = good and (again.parallel != table.parallel or np.allclose(again.beta, table.beta, rtol=0, atol=1e-9))
        except ProblemError:
            good = False
    if not good:
        raise CasacalError(
            f"{source}: its layout cannot be written back", "Leave out the source: then the table is written afresh"
        )

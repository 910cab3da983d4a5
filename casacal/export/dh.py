"""The calibrated DH table as CSV or TOML, anew or in the layout of a file of one's own."""

from __future__ import annotations

import math
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from casacal.compensation.arm import CalibratedArm, arm_values
from casacal.compensation.result_file import arm_from
from casacal.errors import CasacalError, ProblemError
from casacal.export.remark import MARK, other_forms, remark
from casacal.robots.dh_table import DHTable
from casacal.robots.files.dh_fields import UNITS, plain
from casacal.robots.files.dh_file import dh_file_text, is_toml, read_dh_file
from casacal.robots.files.dh_text import decode
from casacal.robots.joints import Conventions

TOML_TOKEN = re.compile(
    r"""(?P<text>"(?:\\.|[^"\\\n])*"|'[^'\n]*')|(?P<comment>\#[^\r\n]*)|"""
    r"""(?<![\w-])(?P<field>alpha|theta|beta|a|d)_(?P<unit>deg|rad|mm|m)(?P<gap>\s*=\s*)(?P<number>[-+.\w]+)"""
)


def written_into_csv(text: str, table: DHTable) -> str:
    """Text of a CSV with the table's numbers; a cell whose number is the same to twelve digits keeps its text."""
    lines = re.findall(r"[^\r\n]*(?:\r\n|\n|\r)|[^\r\n]+", text)
    rows = [i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    delimiter = max(",;\t", key=lines[rows[0]].count)
    header = [cell.strip().strip('"').strip() for cell in _cells(_body(lines[rows[0]]), delimiter)]
    columns = {field: (j, unit) for j, name in enumerate(header) for field, unit in [_field(name)] if field}
    cells_of = [_cells(_body(lines[i]), delimiter) for i in rows[1:]]
    comma = delimiter != "," and any("," in cells[j] for cells in cells_of for j, _ in columns.values())
    adds_beta = any(table.beta) and "beta" not in columns
    for k, (i, cells) in enumerate(zip(rows[1:], cells_of, strict=True)):
        for field, (j, unit) in columns.items():
            new = _number(table, field, k, unit)
            if new is not None:
                cells[j] = _in_place(cells[j], new, comma)
        if adds_beta:
            beta = _number(table, "beta", k, "deg")
            cells.append("" if beta is None else _with_comma(plain(beta), comma))
        lines[i] = delimiter.join(cells) + _end(lines[i])
    if adds_beta:
        lines[rows[0]] = _body(lines[rows[0]]) + delimiter + "beta_deg" + _end(lines[rows[0]])
    if table.parallel and not any(re.match(r"\s*#\s*parallel\s*:", line) for line in lines):
        end = _end(lines[rows[0]]) or "\n"
        lines.insert(rows[0], f"# parallel: {', '.join(map(str, table.parallel))}{end}")
    return "".join(lines)


def written_into_toml(text: str, table: DHTable) -> str:
    """Text of a TOML file with the table's numbers, whose order of `[[joint]]` tables is that of the joints."""
    seen: dict[str, int] = {}
    has_beta = any(found["field"] == "beta" for found in TOML_TOKEN.finditer(text))

    def replaced(found: re.Match[str]) -> str:
        field, whole = found["field"], found.group(0)
        if field is None:
            return whole
        k = seen.get(field, 0)
        seen[field] = k + 1
        if field == "beta":
            k = seen["alpha"] - 1 if "alpha" in seen else k  # a row without beta has none
        new = _number(table, field, k, found["unit"]) if k < len(table.alpha) else None
        number = found["number"] if new is None else _in_place(found["number"], new, False)
        written = f"{field}_{found['unit']}{found['gap']}{number}"
        beta = _number(table, "beta", k, "deg") if k < len(table.alpha) else None
        if field != "theta" or has_beta or not beta:
            return written
        start = text.rfind("\n", 0, found.start()) + 1
        alone = not text[start : found.start()].strip()
        between = _line_end(text) + text[start : found.start()] if alone else ", "
        return f"{written}{between}beta_deg = {plain(beta)}"

    written = TOML_TOKEN.sub(replaced, text)
    if table.parallel and not re.search(r"(?m)^\s*parallel\s*=", text):
        line = f"parallel = {list(table.parallel)}"
        written = re.sub(r"(?m)^(\s*convention\s*=[^\r\n]*)", lambda m: m.group(1) + _line_end(text) + line, written)
    return written


def _number(table: DHTable, field: str, k: int, unit: str) -> float | None:
    """A number of row k (from 0) in a unit; None where the row has none, as beta where axes are not parallel."""
    if field == "beta":
        if k + 1 not in table.parallel:
            return None
        return table.beta[table.parallel.index(k + 1)] / UNITS["beta"][unit]
    return float(getattr(table, field)[k]) / UNITS[field][unit]


def _in_place(cell: str, new: float, comma: bool) -> str:
    """A cell with another number, its blanks and quotes kept; the cell itself where the number is the same."""
    found = re.search(r"[^\s\"]+", cell)
    if found is None:
        return _with_comma(plain(new), comma)
    old = found.group(0).replace(",", ".") if comma else found.group(0)
    try:
        same = math.isclose(float(old), new, rel_tol=1e-12, abs_tol=1e-12)
    except ValueError:
        same = False
    return cell if same else cell[: found.start()] + _with_comma(plain(new), comma) + cell[found.end() :]


def _with_comma(number: str, comma: bool) -> str:
    return number.replace(".", ",") if comma else number


def _field(name: str) -> tuple[str | None, str]:
    """Field and unit of a column such as alpha_deg; None for one that holds something else."""
    field, _, unit = name.partition("_")
    return (field, unit) if unit in UNITS.get(field, {}) else (None, "")


def _cells(line: str, delimiter: str) -> list[str]:
    """Cells of a line as they stand, quotes and blanks included."""
    cells, quoted = [""], False
    for letter in line:
        if letter == delimiter and not quoted:
            cells.append("")
            continue
        quoted ^= letter == '"'
        cells[-1] += letter
    return cells


def _body(line: str) -> str:
    return line.rstrip("\r\n")


def _end(line: str) -> str:
    return line[len(_body(line)) :]


def _line_end(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"


SAME = {"alpha": 1e-8, "a": 1e-6, "d": 1e-6, "theta": 1e-8}
"""Difference, rad or mm, below which a file's number is the one that the calibration began with."""


def dh_text(result: CalibratedArm, source: str | Path | None = None, *, toml: bool = False) -> str:
    """The calibrated DH table in its own convention, with the controller's joint signs, offsets and coupling.

    result: of a robot built by `Robot.from_dh` or `from_dh_file`. source: the DH file the table came from, to be
    written back with nothing but its numbers changed; where axes are parallel, Hayati's `beta` is added if the file has
    none. None writes a file afresh. toml: without a source, TOML in place of CSV.

    Raises CasacalError for other robots, and for a source that is not the table the calibration began with.
    """
    result = arm_from(result)
    arm = result.source.problem.robot.arm
    if not isinstance(arm, DHTable):
        fix = other_forms(result.source.problem.robot)
        raise CasacalError(f"'{result.source.problem.robot.name}' was not built from a DH table", fix)
    table = arm.at(arm_values(result))
    table = replace(table, alpha=tuple(math.remainder(twist, math.tau) for twist in table.alpha))  # as files have it
    if source is None:
        return _remarked(dh_file_text(table, "arm.toml" if toml else "arm.csv"), remark(result, form="dh"))
    _check_source(source, arm)
    text = decode(Path(source))
    written = written_into_toml(text, table) if is_toml(source) else written_into_csv(text, table)
    marked = Path(source).read_bytes()[:2] in (b"\xef\xbb", b"\xff\xfe", b"\xfe\xff")  # a byte-order mark
    lines = remark(result, form="dh")
    if table.conventions is not None and read_dh_file(source).conventions is None:
        lines.append(
            f"{MARK}signs, offsets and coupling of the controller's joint values are in the problem file alone"
        )
    written = ("\ufeff" if marked else "") + _remarked(written, lines)
    _check_written(written, source, table)
    return written


def _remarked(text: str, lines: list[str]) -> str:
    """Text with comment lines on top, in place of older ones, in the line ends of the text."""
    end = "\r\n" if "\r\n" in text else "\n"
    text = re.sub(rf"(?m)^# {MARK}.*(\r\n|\n|\r|\Z)", "", text)
    return "".join(f"# {line}{end}" for line in lines) + text


def _check_source(source: str | Path, arm: DHTable) -> None:
    """Refuse a file that is not the table the calibration began with."""
    began, wrong = read_dh_file(source), ""
    mine, theirs = (table.conventions or Conventions.plain(len(table.joints)) for table in (began, arm))
    if len(began.joints) != len(arm.joints):
        wrong = f"it has {len(began.joints)} joints, the calibrated arm {len(arm.joints)}"
    elif began.convention != arm.convention:
        wrong = f"its convention is {began.convention}, the calibrated arm's {arm.convention}"
    elif began.parallel not in ((), arm.parallel):
        wrong = f"its parallel rows are {list(began.parallel)}, the calibrated arm's {list(arm.parallel)}"
    elif began.conventions is not None and not all(
        np.allclose(getattr(mine, k), getattr(theirs, k), atol=1e-8) for k in ("matrix", "offsets")
    ):
        wrong = "its joint signs, offsets or coupling are not those of the calibrated arm"
    for key, tolerance in SAME.items():
        if wrong:
            break
        for i, (one, two) in enumerate(zip(getattr(began, key), getattr(arm, key), strict=True), 1):
            if abs(one - two) > tolerance:
                wrong = f"{key} of row {i} is {one:.9g}, where the calibration began with {two:.9g} (mm, rad)"
                break
    if wrong:
        fix = "Give the file that the problem was made from, or leave out the source"
        raise CasacalError(f"{source}: {wrong}", fix)


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
        fix = "Leave out the source: then the table is written afresh"
        raise CasacalError(f"{source}: its layout cannot be written back", fix)

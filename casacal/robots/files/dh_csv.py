"""DH tables as CSV: a block of `# key: value` comments, then a header with units and one row per joint."""

from __future__ import annotations

import math
import re
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from casacal.errors import ProblemError, SamplesError
from casacal.robots.conventions import Conventions
from casacal.robots.dh_table import DHTable
from casacal.robots.files.decimals import degrees, plain
from casacal.robots.files.dh_fields import BLOCK_FIELDS, OFFSETS, ROW_FIELDS, Fields, check_names
from casacal.tables.text import read_table

ENTRY = re.compile(r"\s*#\s*(\w+)\s*:\s*(.*?)\s*")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def read_csv(path: str | Path) -> Fields:
    """Fields of a CSV; raises ProblemError that names file and line."""
    try:
        table = read_table(path)
    except SamplesError as error:
        fix = error.fix.replace("one line per sample", "one line per joint")
        raise ProblemError(error.what, fix) from None
    rows: list[dict[str, Any]] = []
    check_names(dict.fromkeys(table.header), ROW_FIELDS, f"{table.file}, header")  # before their cells are read
    for cells, line in zip(table.rows, table.lines, strict=True):
        row: dict[str, Any] = {}
        for name, cell in zip(table.header, cells, strict=True):
            if not cell:
                continue
            text = cell.replace(",", ".") if table.decimal_comma else cell
            row[name] = text if name in ("kind", "note") else _number(text, f"{table.file}, line {line}, '{name}'")
        rows.append(row)
    places = tuple(f"line {line}" for line in table.lines)
    return Fields(table.file, _block(decode(Path(path)), table.file), tuple(rows), places)


def decode(path: Path) -> str:
    """Text of a file that `read_table` accepts, line ends as they are."""
    data = path.read_bytes()
    return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")


def csv_text(table: DHTable) -> str:
    """A DH table as CSV, degrees and millimetres."""
    lines = [f"# name: {table.name}", f"# convention: {table.convention}"]
    if table.parallel:
        lines.append(f"# parallel: {', '.join(map(str, table.parallel))}")
    if table.conventions is not None:
        lines += conventions_comments(table.conventions, [joint.turns for joint in table.joints])
    slides = [joint for joint in table.joints if joint.kind == "prismatic"]
    header = ["joint", "alpha_deg", "a_mm", "d_mm", "theta_deg", *(["beta_deg"] if table.parallel else []), "kind"]
    header += ["lower_deg", "upper_deg", *(["lower_mm", "upper_mm"] if slides else [])]
    lines.append(",".join(header))
    for i, joint in enumerate(table.joints):
        turn = joint.turns
        cells = [str(i + 1), degrees(table.alpha[i]), plain(table.a[i]), plain(table.d[i]), degrees(table.theta[i])]
        if table.parallel:
            cells.append(degrees(table.beta[table.parallel.index(i + 1)]) if i + 1 in table.parallel else "")
        limits = [degrees(joint.lower), degrees(joint.upper)] if turn else [plain(joint.lower), plain(joint.upper)]
        cells += [joint.kind, *(limits if turn else ["", ""])]
        if slides:
            cells += ["", ""] if turn else limits
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def conventions_comments(conventions: Conventions, turns: list[bool]) -> list[str]:
    """The block lines of what a controller's joints mean; `turns` says which joints turn."""
    degs = [degrees(o) if turn else "0" for o, turn in zip(conventions.offsets, turns, strict=True)]
    lines = [f"# signs: {', '.join(map(str, conventions.signs))}", f"# offsets_deg: {', '.join(degs)}"]
    if not all(turns):
        mms = [plain(0.0 if turn else o) for o, turn in zip(conventions.offsets, turns, strict=True)]
        lines.append(f"# offsets_mm: {', '.join(mms)}")
    if conventions.coupling:
        entries = (f"{i} {j} {plain(factor)}" for i, j, factor in conventions.coupling)
        lines.append(f"# coupling: {'; '.join(entries)}")
    return lines


def _block(text: str, file: str) -> dict[str, Any]:
    """Known keys of the comments; other comments stay comments, but a key that is nearly a known one is refused."""
    block: dict[str, Any] = {}
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        found = ENTRY.fullmatch(line)
        if not found:
            continue
        key, value = found.group(1), found.group(2).rstrip(",;\t ")  # spreadsheets fill up lines with delimiters
        where = f"{file}, line {number}"
        if key not in BLOCK_FIELDS:
            close = get_close_matches(key.lower(), BLOCK_FIELDS, n=1, cutoff=0.8)
            if close:
                raise ProblemError(f"{where}: there is no key '{key}'", f"Write '# {close[0]}: ...', or no colon")
            continue
        if key in block:
            raise ProblemError(f"{where}: '{key}' comes a second time", "Leave one of them")
        block[key] = _value(key, value, where)
    return block


def _value(key: str, text: str, where: str) -> Any:
    """What a key's text means: a word, whole numbers, numbers, or couplings 'i j factor' between semicolons."""
    if key in ("name", "convention"):
        return text
    if key == "coupling":
        entries = [_numbers(entry, where) for entry in text.split(";") if entry.strip()]
        if any(len(entry) != 3 or entry[0] % 1 or entry[1] % 1 for entry in entries):
            raise ProblemError(f"{where}: coupling is '{text}'", "Write joint, joint and factor, such as 3 2 -1")
        return entries
    numbers = _numbers(text, where)
    if key in OFFSETS:
        return numbers
    if any(number % 1 for number in numbers):
        raise ProblemError(f"{where}: {key} is '{text}'", "Give whole numbers")
    return [int(number) for number in numbers]


def _numbers(text: str, where: str) -> list[float]:
    return [_number(part, where) for part in re.split(r"[,;\s]+", text.strip().strip("[]")) if part]


def _number(text: str, where: str) -> float:
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ProblemError(f"{where}: '{text}' is not a number", "Write it like 12.5")
    return value

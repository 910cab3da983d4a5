"""Samples kept in a spreadsheet, and readings kept apart from the poses they belong to."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from casacal.errors import CasacalError, SamplesError
from casacal.tables.text import Table, make_table

WORKBOOKS = (".xlsx", ".xlsm")
KEY = "pose"
"""Column by which readings find their pose, unless another one is named."""


def read_workbook(path: str | Path) -> Table:
    """Read the first sheet of an Excel workbook as it is calculated: a header row, then one row per sample.

    Blank rows, and rows whose first cell begins with #, are skipped; "line" is the sheet's row.

    Raises SamplesError for anything else, CasacalError without the extra `excel`.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        raise CasacalError(
            f"{path} is an Excel workbook, which needs a library", 'Install casacal with the extra: "casacal[excel]"'
        ) from None
    file = str(path)
    try:
        data = Path(path).read_bytes()
        book = load_workbook(path, read_only=True, data_only=True)
        rows = list(book.worksheets[0].iter_rows(values_only=True))
        book.close()
    except FileNotFoundError:
        raise SamplesError(file, "there is no such file", "Check the path") from None
    except Exception as error:  # whatever a damaged archive makes of the library, it is the file that must change
        raise SamplesError(file, f"this is no readable workbook ({type(error).__name__})", "Save it again, or as CSV"
        ) from None  # fmt: skip
    texts = [(number, [_text(cell) for cell in row]) for number, row in enumerate(rows, 1)]
    kept = [(number, row) for number, row in texts if any(row) and not row[0].startswith("#")]
    width = max((k for k, cell in enumerate(kept[0][1], 1) if cell), default=0) if kept else 0
    for number, row in kept:
        if any(row[width:]):
            raise SamplesError(file, "a cell stands where the header has no name", "Name its column", line=number)
    narrow = [(number, row[:width]) for number, row in kept]
    return make_table(file, hashlib.sha256(data).hexdigest(), narrow, "\t")


def joined_tables(poses: Table, readings: Table, *, key: str = KEY) -> Table:
    """Each pose with the reading that carries the same id: the columns of both.

    Args:
        poses: rows of joint values.
        readings: rows of readings, in any order.
        key: column of both that holds the id, compared as text.

    Raises SamplesError when an id is missing, doubled, or without its counterpart.

    """
    for table in (poses, readings):
        if key not in table.header:
            raise SamplesError(
                table.file,
                f"there is no column '{key}' that says which reading belongs to which pose",
                "Name it by --id",
            )
    both = [name for name in readings.header if name in poses.header and name != key]
    if both:
        raise SamplesError(readings.file, f"'{poses.file}' has this column too", "Keep one of the two", column=both[0])
    poses, readings = poses.with_points(), readings.with_points()
    found = _by_id(readings, key)
    _by_id(poses, key)
    rows = []
    for row, line, name in zip(poses.rows, poses.lines, poses.column(key), strict=True):
        if name not in found:
            raise SamplesError(
                poses.file, f"pose '{name}' has no reading in {readings.file}", "Add it, or remove the line", line=line
            )
        extra = zip(readings.header, readings.rows[found.pop(name)], strict=True)
        rows.append((*row, *(cell for column, cell in extra if column != key)))
    for name, k in found.items():
        raise SamplesError(
            readings.file, f"'{name}' has no pose in {poses.file}", "Add it, or remove the line", line=readings.lines[k]
        )
    header = (*poses.header, *(column for column in readings.header if column != key))
    digest = hashlib.sha256((poses.sha256 + readings.sha256).encode()).hexdigest()
    return Table(
        f"{poses.file} with {readings.file}", digest, header, poses.header_line, tuple(rows), poses.lines, False
    )


def _by_id(table: Table, key: str) -> dict[str, int]:
    found: dict[str, int] = {}
    for k, (name, line) in enumerate(zip(table.column(key), table.lines, strict=True)):
        if not name or name in found:
            what = f"'{name}' appears twice" if name else "the id is empty"
            raise SamplesError(table.file, what, "Give each row an id of its own", line=line, column=key)
        found[name] = k
    return found


def _text(cell: Any) -> str:
    """A cell as one would type it."""
    if cell is None:
        return ""
    if isinstance(cell, float):
        return str(int(cell)) if cell.is_integer() and abs(cell) < 1e15 else repr(cell)
    return str(cell).strip()

"""Samples kept in a spreadsheet."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from casacal.errors import CasacalError, SamplesError
from casacal.tables.arrays import check_unpacked, pieces, readable
from casacal.tables.text import UNSHOWN, Comments, Table, make_table

WORKBOOKS = (".xlsx", ".xlsm")
MOST_ROWS = 1 << 20  # of a sheet, whatever its file says
MOST_TAGS = 1_600_000
"""In all parts of a workbook, four of them a cell; what is larger takes minutes and gigabytes to read."""
MOST_OTHER_TAGS = 100_000  # of styles and the like, which take the library longest
CELL_TAG = re.compile(rb"</?(?:\w+:)?(?:row|c|v|f|is|si|t)[\s/>]")
MOST_PLACES = 20_000_000
"""Of a sheet, most of them empty: one cell that was coloured far to the right makes a row of 16,384."""
ERRORS = ("#NULL!", "#DIV/0!", "#VALUE!", "#REF!", "#NAME?", "#NUM!", "#N/A")
"""What a sheet shows where it could not calculate; these are no comments."""

NumberedRows = list[tuple[int, list[str]]]


def read_workbook(path: str | Path) -> Table:
    """Read the first visible sheet of an Excel workbook as it is calculated: a header row, then one row per sample.

    Blank rows, and rows whose first cell begins with #, are skipped as in text; "line" is the sheet's row. Where there
    are more sheets, the table's `file` says which one was read.

    Raises SamplesError for anything else, such as hidden rows; CasacalError without the extra `excel`.
    """
    try:
        import openpyxl
    except ImportError:
        raise CasacalError(
            f"{path} is an Excel workbook, which needs a library", "Install it with pip install openpyxl"
        ) from None
    file = str(path)
    with readable(file, "this is no readable workbook", "Save it again, or as CSV"):
        check_unpacked(Path(path), file)
        _check_tags(Path(path), file)
        data = Path(path).read_bytes()
        opened = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True, keep_links=False)
        with closing(opened) as book:
            file, rows, comments = _first_sheet(book, file)
    return make_table(file, hashlib.sha256(data).hexdigest(), rows, "\t", comments)


def _check_tags(path: Path, file: str) -> None:
    """Raise SamplesError for a workbook whose parts are too many, or that declares parts of its own."""
    tags = others = 0
    for piece in pieces(path):
        here = piece.count(b"<")
        tags, others = tags + here, others + here - len(CELL_TAG.findall(piece))
        if b"<!DOCTYPE" in piece:
            raise SamplesError(file, "the workbook declares a document type", "Save it again, or as CSV")
        if tags > MOST_TAGS or others > MOST_OTHER_TAGS:
            what = f"the workbook holds more than {MOST_TAGS // 4:,} cells, or {MOST_OTHER_TAGS:,} styles and the like"
            raise SamplesError(file, what, "Save the samples as CSV")


def _first_sheet(book: Any, file: str) -> tuple[str, NumberedRows, Comments]:
    """Cells of the first visible sheet as text and those of comments; the file with the sheet's name if it has more."""
    sheets = [sheet for sheet in book.worksheets if sheet.sheet_state == "visible"]
    if not sheets:
        raise SamplesError(
            file, "the workbook has no visible sheet", "Show the one with the samples, or save it as CSV"
        )
    sheet = sheets[0]
    if len(book.sheetnames) > 1:
        file = f"{file}, sheet '{UNSHOWN.sub('?', sheet.title)[:40]}'"
    with book._archive.open(sheet._worksheet_path) as stream:  # the library passes over what it does not show
        hidden = _hidden_rows(stream, file)
    sheet.reset_dimensions()  # they may be wrong
    rows: NumberedRows = []
    comments: Comments = []
    for number, cells in _filled(sheet, file):
        if cells[0].startswith("#") and cells[0] not in ERRORS:
            comments.append((number, cells))
            continue
        width = len(rows[0][1]) if rows else len(cells)
        if len(cells) > width:
            raise SamplesError(file, "a cell has no name in the header", "Name its column", line=number)
        if number in hidden:
            raise SamplesError(
                file, "the row is hidden, so that it is not clear whether it counts", "Show or delete it", line=number
            )
        rows.append((number, cells + [""] * (width - len(cells))))
    return file, rows, comments


def _hidden_rows(stream: Any, file: str) -> set[int]:
    """Numbers of the rows that a sheet hides; raises SamplesError where its rows are not in their order."""
    hidden, last, depth = set(), 0, 0
    for event, element in ElementTree.iterparse(stream, ("start", "end")):
        depth += 1 if event == "start" else -1
        if event == "end":
            element.clear()
        elif element.tag.rpartition("}")[2] == "row" and depth == 3:
            number = int(element.get("r", last + 1))
            if not last < number <= MOST_ROWS:
                raise SamplesError(file, "the rows are out of order", "Save it again, or as CSV", line=number)
            last = number
            if element.get("hidden", "0").strip() not in ("0", "false"):
                hidden.add(number)
    return hidden


def _filled(sheet: Any, file: str) -> Iterator[tuple[int, list[str]]]:
    """Rows of a sheet that are not blank, each with its number, up to its last cell with text."""
    places = 0
    for number, row in enumerate(sheet.iter_rows(values_only=True), 1):
        places += len(row)
        if places > MOST_PLACES:
            what = f"the sheet spans more than {MOST_PLACES:,} cells, most of them empty"
            raise SamplesError(file, what, "Delete the columns beside the samples, or save them as CSV", line=number)
        width = len(row)
        while width and row[width - 1] is None:
            width -= 1
        cells = [_text(cell) for cell in row[:width]]
        while cells and not cells[-1]:
            cells.pop()
        if cells:
            yield number, cells


def _text(cell: Any) -> str:
    """A cell as one would type it."""
    if cell is None:
        return ""
    if isinstance(cell, float):
        return str(int(cell)) if cell.is_integer() and abs(cell) < 1e15 else repr(cell)
    return str(cell).strip()

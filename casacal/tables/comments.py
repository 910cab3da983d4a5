"""Lines that begin with #: comments, unless they may be rows whose first cell begins so; these are asked about.

In a table whose rows begin with text, a line such as #1,10.5,20.5 is a row to whoever named a wall #1, and a comment to
whoever took out a row. Where rows begin with numbers, nobody means a row.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from casacal.errors import SamplesError
from casacal.tables.grammar import NUMBER

Comments = list[tuple[int, list[str]]]
"""Cells of lines that begin with #, each with its number."""


def rows_set_aside(lines: Iterable[tuple[int, str]], delimiter: str, width: int) -> Comments:
    """Of lines that begin with #, those with a cell for each column: prose and empty comments are soon left out."""
    return [(number, cells) for number, text in lines if text.count(delimiter) >= width - 1
            and len(cells := _cells(text, delimiter)) >= width]  # fmt: skip


def _cells(text: str, delimiter: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter), [])]
    except csv.Error:  # a cell that is too long for a row
        return []


def is_number(cell: str) -> bool:
    """Whether a cell holds a number, with whichever decimal mark."""
    return NUMBER.fullmatch(cell.replace(",", ".")) is not None


def refuse_rows_set_aside(
    rows: Sequence[Sequence[str]], comments: Comments, file: str, header: Sequence[str], header_line: int
) -> None:
    """Raise SamplesError for a comment below the header that has a number wherever all rows have one.

    rows: all cells, without comments. Rows that begin with numbers have none but comments set aside.
    """
    below = [(number, cells) for number, cells in comments if number > header_line and len(cells) >= len(header)]
    if not below or all(is_number(row[0]) for row in rows):
        return
    hold_numbers = [k for k in range(1, len(header)) if all(is_number(row[k]) for row in rows)]
    for number, cells in below:
        if hold_numbers and all(is_number(cells[k]) for k in hold_numbers):
            raise SamplesError(
                file,
                "the line begins with #, but holds a number in each column of numbers, so it may be a row",
                'Rename its label, or in a CSV file quote it, as in "#1"; delete a comment, or put it above the header',
                line=number,
            )


def rows_begin_with_text(path: Path, header_line: int, delimiter: str) -> bool:
    """Whether any row of a UTF-8 file may begin with anything but a number; raises OSError, UnicodeDecodeError."""
    with path.open(encoding="utf-8-sig", newline="\n") as file:
        for number, text in enumerate(file, 1):
            cell = text.split(delimiter, 1)[0].strip()
            if number > header_line and not is_number(cell) and not cell.startswith("#") and text.strip():
                return True  # a quote is as good as a letter: what it holds is for others to find out
    return False

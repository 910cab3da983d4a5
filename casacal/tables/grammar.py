"""The grammar of delimited text: encodings, lines, comments, cells, the header; every refusal names file and line.

A line that begins with # is a comment. In a table whose rows begin with text, though, a line such as #1,10.5,20.5 is a
row to whoever named a wall #1, and a comment to whoever took out a row: it is asked about. Where rows begin with
numbers, nobody means a row.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence

from casacal.errors import SamplesError
from casacal.wording import counted

MOST_COLUMNS = 16_384  # what a sheet of a spreadsheet holds
LONGEST_NAME = 200  # of a column, in characters
SEPARATOR = "sep=,", "sep=;", "sep="  # a first line that tells Excel what stands between the cells; a tab is stripped
NAMES = {",": "commas", ";": "semicolons", "\t": "tabs"}  # of delimiters
Comments = list[tuple[int, list[str]]]
"""Cells of lines that begin with #, each with its number."""

LINE_END = re.compile(r"\r\n|\n|\r")
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0e-\x1f]")
UNSHOWN = re.compile(r"[\x00-\x08\x0a-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")  # what would tear a sentence apart


def decode(data: bytes, file: str) -> str:
    """Text of a file's bytes: UTF-8 with or without a byte-order mark, UTF-16 with one; raises SamplesError."""
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    if encoding != "utf-16" and b"\x00" in data:
        raise SamplesError(file, "this is not a text file (it holds zero bytes)", "Save it as CSV text in UTF-8")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = len(LINE_END.findall(data[: error.start].decode(encoding, "replace"))) + 1
        name = encoding.removesuffix("-sig").upper()
        raise SamplesError(file, f"this is not {name} text", "Save it as CSV text in UTF-8", line=line) from None
    if found := _CONTROL.search(text):
        line = 1 + len(LINE_END.findall(text, 0, found.start()))
        what = "this is not a text file (it holds control characters)"
        raise SamplesError(file, what, "Save it as CSV text", line=line)
    return text


def lines_and_comments(text: str, first: int = 1) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """Lines neither blank nor comments, and the comments; each with its number, `first` being that of the first."""
    lines: list[tuple[int, str]] = []
    comments: list[tuple[int, str]] = []
    for number, line in enumerate(LINE_END.split(text), first):
        if begun := line.lstrip():
            spreadsheet = number == 1 and begun.strip().casefold() in SEPARATOR  # how Excel is told what stands between
            (comments if begun.startswith("#") or spreadsheet else lines).append((number, line))
    return lines, comments


def delimiter_of(header: str) -> str:
    """What stands between the cells of a header line."""
    return max(",;\t", key=header.count)


def numbered_rows(lines: list[tuple[int, str]], delimiter: str, file: str) -> list[tuple[int, list[str]]]:
    """Cells of each logical line, without surrounding blanks; raises SamplesError unless quotes end on their line."""
    reader = csv.reader((text for _, text in lines), delimiter=delimiter, strict=True)
    rows = []
    for count, (number, text) in enumerate(lines, 1):
        try:
            row = next(reader)
        except csv.Error:
            row = []
        if not row or reader.line_num != count:
            if max(map(len, text.split(delimiter))) > csv.field_size_limit():
                what = f"a cell has more than {csv.field_size_limit()} characters"
                raise SamplesError(file, what, "Shorten it, or leave its column out", line=number)
            raise SamplesError(file, "a quoted cell does not end on its line", "Close the quote", line=number)
        rows.append((number, [cell.strip() for cell in row]))
    return rows


def is_number(cell: str) -> bool:
    """Whether a cell holds a number, with whichever decimal mark."""
    return NUMBER.fullmatch(cell.replace(",", ".")) is not None


def check_header(header: tuple[str, ...], file: str, line: int) -> None:
    """Raise SamplesError unless the header is one of names, each column having its own."""
    if len(header) > MOST_COLUMNS:
        what = f"the header has {len(header)} columns; at most {MOST_COLUMNS} are read"
        raise SamplesError(file, what, "Leave out what is not a sample", line=line)
    if any(map(is_number, header)):
        what = "the first line holds numbers, not column names"
        raise SamplesError(file, what, "Put a header such as q1_deg,q2_deg,... above it", line=line)
    check_names(header, file, line)


def check_names(names: Iterable[str], file: str, line: int | None = None) -> None:
    """Raise SamplesError unless each column has a name of its own that can be shown in a sentence."""
    known: set[str] = set()
    for i, name in enumerate(names, 1):
        if not name:
            raise SamplesError(file, f"column {i} has no name", "Name it, or remove the delimiter", line=line)
        if len(name) > LONGEST_NAME or UNSHOWN.search(name):
            what = f"the name of column {i} is longer than {LONGEST_NAME} characters, or holds control characters"
            raise SamplesError(file, what, "Give it a short, plain name", line=line)
        if name in known:
            raise SamplesError(file, "the column appears twice", "Keep one of the two", line=line, column=name)
        known.add(name)


def body(
    rows: list[tuple[int, list[str]]], header: tuple[str, ...], delimiter: str, file: str
) -> tuple[tuple[tuple[str, ...], ...], tuple[int, ...]]:
    """Cells of rows and their lines; raises SamplesError unless each has as many as the header."""
    for number, row in rows:
        if len(row) != len(header):
            hint = "; a decimal comma needs semicolons between the cells" if delimiter == "," else ""
            what = f"the line has {counted(len(row), 'cell')} where the header has {len(header)}"
            fix = f"Give {counted(len(header), 'cell')} separated by {NAMES[delimiter]}{hint}"
            raise SamplesError(file, what, fix, line=number)
    return tuple(tuple(row) for _, row in rows), tuple(number for number, _ in rows)


def not_a_number(cell: str) -> tuple[str, str]:
    """What is wrong with a cell that should be a finite number, and what to do."""
    if not cell:
        return "the cell is empty", "Give a number, or remove the line"
    shown = UNSHOWN.sub(lambda found: ascii(found[0])[1:-1], cell[:40])
    return f"'{shown}' is not a finite number", "Give a plain decimal number such as 12.5"


def rows_set_aside(lines: Iterable[tuple[int, str]], delimiter: str, width: int) -> Comments:
    """Of lines that begin with #, those with a cell for each column: prose and empty comments are soon left out."""
    return [(number, cells) for number, text in lines if text.count(delimiter) >= width - 1
            and len(cells := _cells(text, delimiter)) >= width]  # fmt: skip


def _cells(text: str, delimiter: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter), [])]
    except csv.Error:  # a cell that is too long for a row
        return []


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
            what = "the line begins with #, but holds a number in each column of numbers, so it may be a row"
            fix = (
                'Rename its label, or in a CSV file quote it, as in "#1"; delete a comment, or put it above the header'
            )
            raise SamplesError(file, what, fix, line=number)

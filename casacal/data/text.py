"""Delimited text: its grammar, cells as they were written, and the numbers in them; refused by file, line, column.

A line that begins with # is a comment. In a table whose rows begin with text, though, a line such as #1,10.5,20.5 is a
row to whoever named a wall #1, and a comment to whoever took out a row: it is asked about. Where rows begin with
numbers, nobody means a row. Readings may stand in a file of their own, joined to the poses that they belong to.
"""

from __future__ import annotations

import csv
import hashlib
import math
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casacal.data.columns import Columns, Labels
from casacal.errors import SamplesError
from casacal.wording import counted

MOST_COLUMNS = 16_384  # columns of a spreadsheet's sheet
LONGEST_NAME = 200  # characters of a column's name
SEPARATOR = "sep=,", "sep=;", "sep="  # a first line that tells Excel what stands between the cells; a tab is stripped
NAMES = {",": "commas", ";": "semicolons", "\t": "tabs"}  # delimiters in words
NumberedRows = list[tuple[int, list[str]]]  # cells of lines, each with its number

LINE_END = re.compile(r"\r\n|\n|\r")
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0e-\x1f]")
UNSHOWN = re.compile(r"[\x00-\x08\x0a-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")  # would break up a sentence


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


def numbered_rows(lines: list[tuple[int, str]], delimiter: str, file: str) -> NumberedRows:
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


def _cells(text: str, delimiter: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter), [])]
    except csv.Error:  # a cell that is too long for a row
        return []


STANDARD_INPUT = "-"
KEY = "pose"  # column by which readings find their pose, unless another one is named


@dataclass(frozen=True)
class Table:
    """The cells of a table as text, with where they came from."""

    file: str
    sha256: str
    header: tuple[str, ...]
    header_line: int
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    decimal_comma: bool

    def column(self, name: str) -> list[str]:
        """Cells of one column, as text without surrounding blanks."""
        index = self.header.index(name)
        return [row[index] for row in self.rows]

    @property
    def columns(self) -> Columns:
        """The cells by column."""
        return Columns(
            self.file,
            self.sha256,
            self.header,
            self.header_line,
            self.lines,
            lambda name: np.array(self.numbers(name)),
            lambda name: Labels.of(self.column(name)),
            lambda: {name: tuple(self.column(name)) for name in self.header},
        )

    def with_points(self) -> Table:
        """A copy with decimal points in place of decimal commas."""
        if not self.decimal_comma:
            return self
        rows = tuple(tuple(cell.replace(",", ".") if is_number(cell) else cell for cell in row) for row in self.rows)
        return replace(self, rows=rows, decimal_comma=False)

    def numbers(self, name: str) -> list[float]:
        """Cells of one column as finite numbers; raises SamplesError that names the line of the first that is none."""
        return finite_numbers(self.file, name, self.column(name), self.lines, decimal_comma=self.decimal_comma)


def finite_numbers(
    file: str, name: str, cells: Sequence[str], lines: Sequence[int], *, decimal_comma: bool = False
) -> list[float]:
    """Cells of a column as finite numbers; raises SamplesError that names column and lines of all others."""
    if (
        decimal_comma
        and (k := next((k for k, cell in enumerate(cells) if "." in cell and is_number(cell)), None)) is not None
    ):
        what = f"decimal commas and decimal points are mixed: '{cells[k]}', and another column has commas"
        raise SamplesError(file, what, "Write all numbers one way, labels too", line=int(lines[k]), column=name)
    texts = [cell.replace(",", ".") for cell in cells] if decimal_comma else cells
    result = [float(text) if NUMBER.fullmatch(text) else math.nan for text in texts]
    bad = [k for k, value in enumerate(result) if not math.isfinite(value)]
    if bad:
        cell, (line, *also) = cells[bad[0]], (int(lines[k]) for k in bad)
        shown = UNSHOWN.sub(lambda found: ascii(found[0])[1:-1], cell[:40])
        what = f"'{shown}' is not a finite number" if cell else "the cell is empty"
        fix = "Give a plain decimal number such as 12.5" if cell else "Give a number, or remove the line"
        if also:
            fix = "Give plain decimal numbers such as 12.5, or remove these lines: targets may have been lost there"
        raise SamplesError(file, what, fix, line=line, column=name, also=also)
    return result


def read_table(path: str | Path) -> Table:
    """Read a delimited text file with one header line; `#` starts a comment line, blank lines are skipped.

    A comment that may be a row, because rows begin with text and it has a cell for each column, is refused.

    Understands UTF-8 with or without a byte-order mark and UTF-16 with one; commas, semicolons or tabs; decimal
    commas where the delimiter is not a comma. "-" is standard input.

    Raises SamplesError for anything else.
    """
    piped = str(path) == STANDARD_INPUT
    file = "standard input" if piped else str(path)
    try:
        data = sys.stdin.buffer.read() if piped else Path(path).read_bytes()
    except FileNotFoundError:
        raise SamplesError(file, "there is no such file", "Check the path") from None
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise SamplesError(file, f"cannot be read ({why})", "Give a readable text file") from None
    lines, comments = list[tuple[int, str]](), list[tuple[int, str]]()
    for number, line in enumerate(LINE_END.split(decode(data, file)), 1):
        if begun := line.lstrip():
            spreadsheet = number == 1 and begun.strip().casefold() in SEPARATOR
            (comments if begun.startswith("#") or spreadsheet else lines).append((number, line))
    delimiter = max(",;\t", key=lines[0][1].count) if lines else ","
    rows = numbered_rows(lines, delimiter, file)
    width = len(rows[0][1]) if rows else 1
    aside = [
        (number, cells)
        for number, text in comments
        if text.count(delimiter) >= width - 1 and len(cells := _cells(text, delimiter)) >= width
    ]
    return make_table(file, hashlib.sha256(data).hexdigest(), rows, delimiter, aside)


def make_table(file: str, sha256: str, rows: NumberedRows, delimiter: str, comments: NumberedRows) -> Table:
    """Table of numbered rows of cells, the header first, which were apart by a delimiter, and rows that are comments.

    Raises SamplesError, also where such a comment may be a row that is meant.
    """
    if not rows:
        raise SamplesError(file, "the file is empty", "Give a header line and one line per sample")
    header_line, header = rows[0][0], tuple(rows[0][1])
    if len(header) > MOST_COLUMNS:
        what = f"the header has {len(header)} columns; at most {MOST_COLUMNS} are read"
        raise SamplesError(file, what, "Leave out what is not a sample", line=header_line)
    if any(map(is_number, header)):
        what = "the first line holds numbers, not column names"
        raise SamplesError(file, what, "Put a header such as q1_deg,q2_deg,... above it", line=header_line)
    check_names(header, file, header_line)
    if len(rows) == 1:
        fix = "Give one line per sample" + (", and quote labels that begin with #" if comments else "")
        raise SamplesError(file, "there is a header but no line of data", fix, line=header_line)
    for number, row in rows[1:]:
        if len(row) != len(header):
            hint = "; a decimal comma needs semicolons between the cells" if delimiter == "," else ""
            what = f"the line has {counted(len(row), 'cell')} where the header has {len(header)}"
            fix = f"Give {counted(len(header), 'cell')} separated by {NAMES[delimiter]}{hint}"
            raise SamplesError(file, what, fix, line=number)
    lines, cells = zip(*((number, tuple(row)) for number, row in rows[1:]), strict=True)
    table = Table(file, sha256, header, header_line, cells, lines, decimal_comma=False)
    comma = delimiter != "," and has_decimal_commas(table)
    # where all rows begin with numbers, nothing but comments was set aside
    if not all(is_number(row[0]) for row in cells):
        numbers = [k for k in range(1, len(header)) if all(is_number(row[k]) for row in cells)]
        what = "the line begins with #, but holds a number in each column of numbers, so it may be a row"
        fix = 'Rename its label, or in a CSV file quote it, as in "#1"; delete a comment, or put it above the header'
        for number, row in comments:
            below = number > header_line and len(row) >= len(header)
            if below and numbers and all(is_number(row[k]) for k in numbers):
                raise SamplesError(file, what, fix, line=number)
    return replace(table, decimal_comma=comma)


def has_decimal_commas(table: Table) -> bool:
    """Whether numbers have decimal commas; raises SamplesError for a column that has points as well.

    Columns may differ: labels such as 1.2 are no numbers. Whoever reads one as numbers is refused points there.
    """
    found = False
    for k, name in enumerate(table.header):
        comma = point = None
        for row, line in zip(table.rows, table.lines, strict=True):
            if is_number(row[k]):
                comma, point = comma or (line if "," in row[k] else None), point or (line if "." in row[k] else None)
        if comma and point:
            what = "decimal commas and decimal points are mixed"
            raise SamplesError(table.file, what, "Write all numbers one way", line=max(comma, point), column=name)
        found |= comma is not None
    return found


TOGETHER = " with "  # between two files whose columns were joined


def typed_rows(file: str) -> str:
    """What a command is told of rows, by what they are called: "poses.csv with readings.csv" are two files."""
    poses, _, readings = file.partition(TOGETHER)
    return f"{shlex.quote(poses)}{f' --readings {shlex.quote(readings)}' if readings else ''}"


def joined_tables(poses: Table, readings: Table, *, key: str = KEY) -> Table:
    """Columns of poses and of the readings with the same id; SamplesError for one missing, doubled or alone."""
    for table in (poses, readings):
        if key not in table.header:
            what = f"there is no column '{key}' that says which reading belongs to which pose"
            raise SamplesError(table.file, what, "Name it by --id")
    both = [name for name in readings.header if name in poses.header and name != key]
    if both:
        raise SamplesError(readings.file, f"'{poses.file}' has this column too", "Keep one of the two", column=both[0])
    poses, readings = poses.with_points(), readings.with_points()
    found = _by_id(readings, key)
    _by_id(poses, key)
    rows = []
    for row, line, name in zip(poses.rows, poses.lines, poses.column(key), strict=True):
        if name not in found:
            what = f"pose '{name}' has no reading in {readings.file}"
            raise SamplesError(poses.file, what, "Add it, or remove the line", line=line)
        extra = zip(readings.header, readings.rows[found.pop(name)], strict=True)
        rows.append((*row, *(cell for column, cell in extra if column != key)))
    for name, k in found.items():
        what = f"'{name}' has no pose in {poses.file}"
        raise SamplesError(readings.file, what, "Add it, or remove the line", line=readings.lines[k])
    header = (*poses.header, *(column for column in readings.header if column != key))
    digest = hashlib.sha256((poses.sha256 + readings.sha256).encode()).hexdigest()
    file = f"{poses.file}{TOGETHER}{readings.file}"
    return Table(file, digest, header, poses.header_line, tuple(rows), poses.lines, decimal_comma=False)


def _by_id(table: Table, key: str) -> dict[str, int]:
    found: dict[str, int] = {}
    for k, (name, line) in enumerate(zip(table.column(key), table.lines, strict=True)):
        if not name or name in found:
            what = f"'{name}' appears twice" if name else "the id is empty"
            raise SamplesError(table.file, what, "Give each row its own id", line=line, column=key)
        found[name] = k
    return found

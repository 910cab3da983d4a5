"""Text tables at the edge: encodings, delimiters, decimal commas, comments; every refusal names file, line, column."""

from __future__ import annotations

import csv
import hashlib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casacal.errors import SamplesError
from casacal.tables.columns import Columns
from casacal.tables.labels import Labels

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


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
        """The same as columns."""
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
        """The same with decimal points where there were decimal commas."""
        if not self.decimal_comma:
            return self
        rows = tuple(
            tuple(cell.replace(",", ".") if _NUMBER.fullmatch(cell.replace(",", ".")) else cell for cell in row)
            for row in self.rows
        )
        return replace(self, rows=rows, decimal_comma=False)

    def numbers(self, name: str) -> list[float]:
        """Cells of one column as finite numbers.

        Raises SamplesError that names the line of the first cell that is not one.
        """
        result = []
        for cell, line in zip(self.column(name), self.lines, strict=True):
            text = cell.replace(",", ".") if self.decimal_comma else cell
            value = float(text) if _NUMBER.fullmatch(text) else math.nan
            if not math.isfinite(value):
                raise SamplesError(self.file, *_not_a_number(cell), line=line, column=name)
            result.append(value)
        return result


def read_table(path: str | Path) -> Table:
    """Read a delimited text file with one header line; `#` starts a comment line, blank lines are skipped.

    Understands UTF-8 with or without a byte-order mark and UTF-16 with one; commas, semicolons or tabs; decimal
    commas where the delimiter is not a comma.

    Raises SamplesError for anything else.
    """
    file = str(path)
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise SamplesError(file, "there is no such file", "Check the path") from None
    except OSError as error:
        raise SamplesError(file, f"cannot be read ({error.strerror})", "Give a readable text file") from None
    lines = _logical_lines(_decode(data, file))
    delimiter = max(",;\t", key=lines[0][1].count) if lines else ","
    rows = list(zip((number for number, _ in lines), _cells(lines, delimiter, file), strict=True))
    return make_table(file, hashlib.sha256(data).hexdigest(), rows, delimiter)


def make_table(file: str, sha256: str, rows: list[tuple[int, list[str]]], delimiter: str) -> Table:
    """Table of numbered rows of cells, the header first, which were apart by a delimiter; raises SamplesError."""
    if not rows:
        raise SamplesError(file, "the file is empty", "Give a header line and one line per sample")
    header_line, header = rows[0][0], tuple(rows[0][1])
    _check_header(header, file, header_line)
    for number, row in rows[1:]:
        if len(row) != len(header):
            hint = "; a decimal comma needs semicolons between the cells" if delimiter == "," else ""
            raise SamplesError(
                file,
                f"the line has {len(row)} cells where the header has {len(header)}",
                f"Give {len(header)} cells separated by {_named(delimiter)}{hint}",
                line=number,
            )
    if len(rows) == 1:
        raise SamplesError(file, "there is a header but no line of data", "Give one line per sample", line=header_line)
    numbers, cells = [number for number, _ in rows[1:]], [tuple(row) for _, row in rows[1:]]
    comma = delimiter != "," and _decimal_comma(cells, header, numbers, file)
    return Table(file, sha256, header, header_line, tuple(cells), tuple(numbers), comma)


def _decode(data: bytes, file: str) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
    elif b"\x00" in data:
        raise SamplesError(file, "this is not a text file (it holds zero bytes)", "Save it as CSV text in UTF-8")
    else:
        encoding = "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise SamplesError(file, "this is not UTF-8 text", "Save it as CSV text in UTF-8", line=line) from None
    if any(ord(letter) < 32 and letter not in "\t\r\n\f" for letter in text[:4096]):
        raise SamplesError(file, "this is not a text file (it holds control characters)", "Save it as CSV text")
    return text


def _logical_lines(text: str) -> list[tuple[int, str]]:
    lines = re.split(r"\r\n|\n|\r", text)
    return [(i, line) for i, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]


def _cells(lines: list[tuple[int, str]], delimiter: str, file: str) -> Iterator[list[str]]:
    """Cells of each logical line, without surrounding blanks; a quoted cell must end on its line."""
    reader = csv.reader((text for _, text in lines), delimiter=delimiter, strict=True)
    for count, (number, _) in enumerate(lines, 1):
        try:
            row = next(reader)
        except csv.Error:
            row = []
        if not row or reader.line_num != count:
            raise SamplesError(file, "a quoted cell does not end on its line", "Close the quote", line=number)
        yield [cell.strip() for cell in row]


def _check_header(header: tuple[str, ...], file: str, line: int) -> None:
    if any(_NUMBER.fullmatch(cell.replace(",", ".")) for cell in header):
        raise SamplesError(
            file,
            "the first line holds numbers, not column names",
            "Put a header such as q1_deg,q2_deg,... above it",
            line=line,
        )
    for i, name in enumerate(header):
        if not name:
            raise SamplesError(file, f"column {i + 1} has no name", "Name it, or remove the delimiter", line=line)
        if name in header[:i]:
            raise SamplesError(file, "the column appears twice", "Keep one of the two", line=line, column=name)


def _decimal_comma(rows: list[tuple[str, ...]], header: tuple[str, ...], lines: list[int], file: str) -> bool:
    """Whether numbers are written with decimal commas; refuses a file that writes them both ways."""
    comma = point = None
    for row, line in zip(rows, lines, strict=True):
        for name, cell in zip(header, row, strict=True):
            if not _NUMBER.fullmatch(cell.replace(",", ".")):
                continue
            if "," in cell:
                comma = comma or (line, name)
            elif "." in cell:
                point = point or (line, name)
        if comma and point:
            line, name = max(comma, point)
            raise SamplesError(
                file, "decimal commas and decimal points are mixed", "Write all numbers one way", line=line, column=name
            )
    return comma is not None


def _not_a_number(cell: str) -> tuple[str, str]:
    if not cell:
        return "the cell is empty", "Give a number, or remove the line"
    return f"'{cell[:40]}' is not a finite number", "Give a plain decimal number such as 12.5"


def _named(delimiter: str) -> str:
    return {",": "commas", ";": "semicolons", "\t": "tabs"}[delimiter]

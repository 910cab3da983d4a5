"""Tables of text: cells as they were written, and the numbers in them; refused by file, line, column.

Also readings in a file of their own, joined to the poses that they belong to.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casacal.errors import SamplesError
from casacal.tables.columns import Columns, Labels
from casacal.tables.grammar import (
    NUMBER,
    Comments,
    body,
    check_header,
    decode,
    delimiter_of,
    is_number,
    lines_and_comments,
    not_a_number,
    numbered_rows,
    refuse_rows_set_aside,
    rows_set_aside,
)

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
        rows = tuple(tuple(cell.replace(",", ".") if is_number(cell) else cell for cell in row) for row in self.rows)
        return replace(self, rows=rows, decimal_comma=False)

    def numbers(self, name: str) -> list[float]:
        """Cells of one column as finite numbers.

        Raises SamplesError that names the line of the first cell that is not one.
        """
        return finite_numbers(self.file, name, self.column(name), self.lines, decimal_comma=self.decimal_comma)


def finite_numbers(
    file: str, name: str, cells: Sequence[str], lines: Sequence[int], *, decimal_comma: bool = False
) -> list[float]:
    """The same of cells on some lines of a file."""
    result = []
    for cell, line in zip(cells, lines, strict=True):
        text = cell.replace(",", ".") if decimal_comma else cell
        value = float(text) if NUMBER.fullmatch(text) else math.nan
        if not math.isfinite(value):
            raise SamplesError(file, *not_a_number(cell), line=int(line), column=name)
        result.append(value)
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
    lines, comments = lines_and_comments(decode(data, file))
    delimiter = delimiter_of(lines[0][1]) if lines else ","
    rows = numbered_rows(lines, delimiter, file)
    aside = rows_set_aside(comments, delimiter, len(rows[0][1]) if rows else 1)
    return make_table(file, hashlib.sha256(data).hexdigest(), rows, delimiter, aside)


def make_table(file: str, sha256: str, rows: list[tuple[int, list[str]]], delimiter: str, comments: Comments) -> Table:
    """Table of numbered rows of cells, the header first, which were apart by a delimiter, and rows that are comments.

    Raises SamplesError, also where such a comment may be a row that is meant.
    """
    if not rows:
        raise SamplesError(file, "the file is empty", "Give a header line and one line per sample")
    header_line, header = rows[0][0], tuple(rows[0][1])
    check_header(header, file, header_line)
    if len(rows) == 1:
        fix = "Give one line per sample" + (", and quote labels that begin with #" if comments else "")
        raise SamplesError(file, "there is a header but no line of data", fix, line=header_line)
    table = Table(file, sha256, header, header_line, *body(rows[1:], header, delimiter, file), decimal_comma=False)
    comma, _ = decimal_marks(table) if delimiter != "," else (None, None)
    refuse_rows_set_aside(table.rows, comments, file, header, header_line)
    return replace(table, decimal_comma=comma is not None)


def decimal_marks(table: Table) -> tuple[tuple[int, str] | None, tuple[int, str] | None]:
    """Line and column where a number first has a decimal comma, and where a point; raises SamplesError for both."""
    comma = point = None
    for row, line in zip(table.rows, table.lines, strict=True):
        for name, cell in zip(table.header, row, strict=True):
            if not is_number(cell):
                continue
            if "," in cell:
                comma = comma or (line, name)
            elif "." in cell:
                point = point or (line, name)
        if comma and point:
            line, name = max(comma, point)
            what = "decimal commas and decimal points are mixed"
            raise SamplesError(table.file, what, "Write all numbers one way", line=line, column=name)
    return comma, point


def joined_tables(poses: Table, readings: Table, *, key: str = KEY) -> Table:
    """Each pose with the reading, in any order, that carries the same id, compared as text: the columns of both.

    Raises SamplesError when an id is missing, doubled, or without its counterpart.
    """
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
    file = f"{poses.file} with {readings.file}"
    return Table(file, digest, header, poses.header_line, tuple(rows), poses.lines, decimal_comma=False)


def _by_id(table: Table, key: str) -> dict[str, int]:
    found: dict[str, int] = {}
    for k, (name, line) in enumerate(zip(table.column(key), table.lines, strict=True)):
        if not name or name in found:
            what = f"'{name}' appears twice" if name else "the id is empty"
            raise SamplesError(table.file, what, "Give each row its own id", line=line, column=key)
        found[name] = k
    return found

"""Tables of text at the edge: cells as they were written, and the numbers in them; refused by file, line, column."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from casacal.errors import SamplesError
from casacal.tables.columns import Columns
from casacal.tables.comments import Comments, refuse_rows_set_aside, rows_set_aside
from casacal.tables.grammar import (
    NUMBER,
    body,
    check_header,
    decode,
    delimiter_of,
    lines_and_comments,
    not_a_number,
    numbered_rows,
    refuse_controls,
)
from casacal.tables.labels import Labels


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
            tuple(cell.replace(",", ".") if NUMBER.fullmatch(cell.replace(",", ".")) else cell for cell in row)
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
            value = float(text) if NUMBER.fullmatch(text) else math.nan
            if not math.isfinite(value):
                raise SamplesError(self.file, *not_a_number(cell), line=line, column=name)
            result.append(value)
        return result


def read_table(path: str | Path) -> Table:
    """Read a delimited text file with one header line; `#` starts a comment line, blank lines are skipped.

    A comment that may be a row, because rows begin with text and it has a cell for each column, is refused.

    Understands UTF-8 with or without a byte-order mark and UTF-16 with one; commas, semicolons or tabs; decimal
    commas where the delimiter is not a comma.

    Raises SamplesError for anything else.
    """
    file = str(path)
    try:
        data = Path(path).read_bytes()
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


def table_of_lines(text: str, file: str, header: tuple[str, ...], first: int, delimiter: str) -> tuple[Table, Comments]:
    """Some whole lines of a file, from line `first` on, as a table of their own, and rows that are comments.

    What depends on all lines of a file is the caller's: that numbers have one decimal mark, and comments are no rows.
    Raises SamplesError.
    """
    refuse_controls(text, file, first)
    lines, comments = lines_and_comments(text, first)
    rows = numbered_rows(lines, delimiter, file)
    table = Table(file, "", header, 0, *body(rows, header, delimiter, file), decimal_comma=False)
    return table, rows_set_aside(comments, delimiter, len(header))


Place: TypeAlias = tuple[int, str]
"""A line and the name of a column."""


def decimal_marks(table: Table) -> tuple[Place | None, Place | None]:
    """Where a number is first written with a decimal comma, and where with a point; raises SamplesError for both."""
    comma = point = None
    for row, line in zip(table.rows, table.lines, strict=True):
        for name, cell in zip(table.header, row, strict=True):
            if not NUMBER.fullmatch(cell.replace(",", ".")):
                continue
            if "," in cell:
                comma = comma or (line, name)
            elif "." in cell:
                point = point or (line, name)
        if comma and point:
            line, name = max(comma, point)
            raise SamplesError(
                table.file, "decimal commas and decimal points are mixed", "Write all numbers one way",
                line=line, column=name,
            )  # fmt: skip
    return comma, point

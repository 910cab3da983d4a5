"""Text files of a million rows, read section by section.

Text has one grammar, that of `grammar`, and one reader that applies it cell by cell, `read_table`. It takes a million
rows a gigabyte. So a large file is read section by section. A section in which bytes can be cells in one way alone is
read by pandas, any other by the grammar, and a file in which anything is wrong by `read_table`, which says what.
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np

from casacal.array_types import Array
from casacal.tables.columns import Columns, Labels
from casacal.tables.grammar import (
    Comments,
    body,
    check_header,
    delimiter_of,
    is_number,
    lines_and_comments,
    numbered_rows,
    rows_begin_with_text,
    rows_set_aside,
)
from casacal.tables.text import Table, decimal_marks, read_table

SECTION = 1 << 22
"""Bytes that are read at once, more or less: enough to be worth a call of pandas, which takes as long as 300 KB."""
MANY_ROWS = 100_000
"""Rows from which lines are numbers in an array rather than Python objects."""
IN_NUMBERS = {",": b"0123456789+-eE \t.", ";": b"0123456789+-eE \t.,", "\t": b"0123456789+-eE .,"}
"""By delimiter, the bytes that numbers and blanks around them are made of."""
BYTE_ORDER_MARK = "\ufeff".encode()
BLANKS = {end: re.compile(rb"[ \t]*(\n|%b)[ \t]*" % end.encode()) for end in ",;"} | {
    "\t": re.compile(rb" *([\t\n]) *")
}
"""By delimiter, the ends of cells with the blanks beside them, which are no part of a cell."""


@dataclass(frozen=True)
class _Form:
    """How a file is written: its delimiter and header, which columns are read as numbers, which are kept as labels."""

    file: str
    delimiter: str
    line: int
    header: tuple[str, ...]
    numbers: tuple[str, ...]
    labels: tuple[str, ...]


@dataclass(frozen=True)
class _Rows:
    """Rows of one section: numbers, labels, lines; marks: the decimal marks that all numbers so far may have."""

    numbers: dict[str, Array]
    labels: dict[str, Labels]
    lines: Sequence[int]
    marks: frozenset[str]


def read_large(path: Path, numbers: Callable[[Sequence[str]], Sequence[str]], labels: Sequence[str]) -> Columns | None:
    """Columns of a UTF-8 file; None, ValueError or SamplesError where `read_table` must read it as a whole."""
    digest, sections, comments = hashlib.sha256(), list[_Rows](), Comments()
    with path.open("rb") as file:
        data = file.read(SECTION) + file.readline()
        form = _form(data, str(path), numbers, labels)
        digest.update(data)
        data = data.split(b"\n", form.line)[form.line]
        line, marks = form.line + 1, frozenset("." if form.delimiter == "," else ".,")
        while data or not sections:
            count = data.count(b"\n") + (not data.endswith(b"\n"))
            sections.append(_section(data, range(line, line + count), form, marks, comments))
            line, marks = line + count, sections[-1].marks
            data = file.read(SECTION) + file.readline()
            digest.update(data)
    places = [form.header.index(name) for name in form.numbers]
    doubtful = 0 not in places and any(all(is_number(cells[k]) for k in places) for _, cells in comments)
    if doubtful and rows_begin_with_text(path, form.line, form.delimiter):
        return None
    return _joined([some for some in sections if len(some.lines)], path, digest.hexdigest(), form)


def _form(data: bytes, file: str, numbers: Callable[[Sequence[str]], Sequence[str]], labels: Sequence[str]) -> _Form:
    """The form that the beginning of a file shows; raises ValueError, SamplesError."""
    lines, _ = lines_and_comments(_plain_ends(data).decode("utf-8-sig"))
    if not lines:
        raise ValueError("no header")
    line, text = lines[0]
    delimiter = delimiter_of(text)
    header = tuple(numbered_rows(lines[:1], delimiter, file)[0][1])
    check_header(header, file, line)
    wanted = tuple(dict.fromkeys(numbers(header)))
    if not wanted:
        raise ValueError("no numbers")
    return _Form(file, delimiter, line, header, wanted, tuple(name for name in labels if name in header))


def _plain_ends(data: bytes) -> bytes:
    """Lines, each ended by a newline alone; raises ValueError for control characters and other line ends."""
    signs = np.frombuffer(data, dtype=np.uint8)
    if np.count_nonzero(signs < 32) > sum(np.count_nonzero(signs == ord(blank)) for blank in "\n\t\r\f"):
        raise ValueError("control characters")
    data = data.replace(b"\r\n", b"\n")
    if b"\r" in data:
        raise ValueError("lines that end otherwise")
    return data if data.endswith(b"\n") else data + b"\n"


def _section(data: bytes, lines: range, form: _Form, marks: frozenset[str], comments: Comments) -> _Rows:
    """Rows of some whole lines; adds what may be rows among their comments. Raises ValueError, SamplesError."""
    data, kept = _plain_ends(data), list[tuple[int, str]]()
    text = data.decode("utf-8")
    own: Sequence[int] = lines
    if b"#" in data or b"\n\n" in data or data.startswith(b"\n"):
        kept, aside = lines_and_comments(text, lines.start)
        comments += rows_set_aside(aside, form.delimiter, len(form.header))
        own = tuple(number for number, _ in kept)
        data = "".join(f"{each}\n" for _, each in kept).encode()
    plain = _plain_cells(data, len(own), form)
    rows = None if plain is None else _read_plain(plain, own, form, marks)
    return rows or _read_cells(kept or lines_and_comments(text, lines.start)[0], form, marks)


def _plain_cells(data: bytes, lines: int, form: _Form) -> bytes | None:
    """Lines without comments whose cells end at each delimiter, quotes taken off; None where that is not shown.

    Each line has a cell for each column, and the columns of numbers hold nothing but what numbers are made of.
    """
    delimiter = form.delimiter.encode()
    longest = np.diff(np.flatnonzero(np.frombuffer(data, dtype=np.uint8) == ord("\n")), prepend=-1).max(initial=0)
    if not lines or longest > csv.field_size_limit() or data.startswith(BYTE_ORDER_MARK):
        return None
    if b'"' in data:
        if not _quotes_whole_cells(data, form.delimiter):
            return None
        data = data.replace(b'"', b"")
    if b"+" in data and (b" " in data or b"\t" in data):  # pandas is less exact about +1.5 with blanks around it
        data = BLANKS[form.delimiter].sub(rb"\1", data)
        if re.search(rb"\+[0-9.]+[eE][ \t]", data):  # and takes +1e 5 for a number
            return None
    rest = np.frombuffer(data.translate(None, IN_NUMBERS[form.delimiter]), dtype=np.uint8)
    ends = np.flatnonzero((rest == ord("\n")) | (rest == delimiter[0]))
    if len(ends) != lines * len(form.header) or not (rest[ends[len(form.header) - 1 :: len(form.header)]] == 10).all():
        return None
    sizes = np.diff(ends, prepend=-1).reshape(lines, -1)
    return data if (sizes[:, [form.header.index(name) for name in form.numbers]] == 1).all() else None


def _quotes_whole_cells(data: bytes, delimiter: str) -> bool:
    """Whether each quote opens or closes a cell, with no delimiter, line end or further quote between the two."""
    signs, ends = np.frombuffer(data, dtype=np.uint8), [ord("\n"), ord(delimiter)]
    quotes = np.flatnonzero(signs == ord('"'))
    if len(quotes) % 2:
        return False
    beside = np.concatenate([signs[quotes[::2] - 1], signs[quotes[1::2] + 1]])  # before the first is the last newline
    structure = data.translate(None, bytes(sign for sign in range(256) if sign not in (*ends, ord('"'))))
    return bool(np.isin(beside, ends).all()) and b'"' not in structure.replace(b'""', b"")


def _read_plain(data: bytes, lines: Sequence[int], form: _Form, marks: frozenset[str]) -> _Rows | None:
    """Rows of plain cells; None where a number is not one, or not finite, whichever decimal mark it has."""
    import pandas as pd

    fits = {mark: frame for mark in sorted(marks) if (frame := _frame(data, form, mark)) is not None}
    if not fits:
        return None
    frame, fitting = next(iter(fits.values())), frozenset(fits)
    if form.delimiter != ",":
        for name in frame.columns.difference(form.numbers):  # others may hold numbers, too; or dates, which are none
            for cell in pd.unique(frame[name]):
                if ("," in cell or "." in cell) and is_number(cell.strip()):
                    fitting &= {"," if "," in cell else "."}
    if not fitting:
        raise ValueError("two decimal marks")
    numbers = {name: frame[name].to_numpy() for name in form.numbers}
    labels = {}
    for name in form.labels:
        codes, names = pd.factorize(frame[name])
        labels[name] = Labels.coded(names, codes)
    return _Rows(numbers, labels, lines, fitting)


def _frame(data: bytes, form: _Form, mark: str) -> Any:
    """The cells as pandas reads them: columns of finite numbers, and others as they are written; or None.

    Where columns that nobody asked for may tell the decimal mark, they are read, too.
    """
    import pandas as pd

    kinds = dict.fromkeys(form.header if form.delimiter != "," else form.labels, "object") | dict.fromkeys(
        form.numbers, "float64"
    )
    # before 3.1 pandas had a faster way that may be wrong in the last digit
    version = tuple(int(part) for part in pd.__version__.split(".")[:2])
    exact: Any = {} if version >= (3, 1) else {"float_precision": "round_trip"}
    try:
        frame = pd.read_csv(
            io.BytesIO(data), sep=form.delimiter, decimal=mark, names=list(form.header), header=None,
            usecols=list(kinds), index_col=False, dtype=kinds, keep_default_na=False, na_filter=False,
            encoding="utf-8", quoting=csv.QUOTE_NONE, skip_blank_lines=False, low_memory=False, **exact,
        )  # fmt: skip
    except ValueError:
        return None
    return frame if all(np.isfinite(frame[name].to_numpy()).all() for name in form.numbers) else None


def _read_cells(lines: list[tuple[int, str]], form: _Form, marks: frozenset[str]) -> _Rows:
    """Rows by the grammar, cell by cell; raises SamplesError, and ValueError for another decimal mark."""
    rows = numbered_rows(lines, form.delimiter, form.file)
    table = Table(form.file, "", form.header, 0, *body(rows, form.header, form.delimiter, form.file), False)
    if form.delimiter != ",":
        comma, point = decimal_marks(table)
        marks &= {","} if comma else {"."} if point else marks
        table = replace(table, decimal_comma=comma is not None)
    if not marks:
        raise ValueError("two decimal marks")
    numbers = {name: np.array(table.numbers(name), dtype=np.float64) for name in form.numbers}
    return _Rows(numbers, {name: Labels.of(table.column(name)) for name in form.labels}, table.lines, marks)


def _joined(sections: list[_Rows], path: Path, digest: str, form: _Form) -> Columns | None:
    """The rows of all sections; None where there are none."""
    if not sections:
        return None
    count = sum(len(some.lines) for some in sections)
    first, last = sections[0].lines[0], sections[-1].lines[-1]
    lines: Any = range(first, last + 1)
    if len(lines) != count:
        lines = np.concatenate([np.asarray(some.lines) for some in sections])
    if count < MANY_ROWS:
        lines = tuple(int(line) for line in lines)

    def number(name: str) -> Array:
        if name not in form.numbers:
            return read_table(path).columns.number(name)
        return np.concatenate([some.numbers[name] for some in sections])

    def text(name: str) -> Labels:
        if name not in form.labels:
            return read_table(path).columns.text(name)
        return Labels.joined([some.labels[name] for some in sections])

    def written(name: str, row: int) -> str:
        with path.open("rb") as file:
            line = next(islice(file, lines[row] - 1, None)).decode("utf-8")
        return numbered_rows(lines_and_comments(line)[0], form.delimiter, form.file)[0][1][form.header.index(name)]

    return Columns(form.file, digest, form.header, form.line, cast(Sequence[int], lines), number, text, written=written)

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
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from casacal.array_types import Array
from casacal.tables.columns import Columns, Labels
from casacal.tables.grammar import (
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
from casacal.threads import thread_count

SECTION = 1 << 22
"""Bytes that are read at once, more or less: enough to be worth a call of pandas, which takes as long as 300 KB."""
HEAD = 1 << 16
"""Bytes in which the header of a large file is looked for, at least."""
MOST_THREADS = 4
"""One thread puts together what they have read, and has no time for more."""
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
    """Rows of one section: numbers, labels, lines.

    marks: the decimal marks that all numbers may have. doubtful: whether a comment holds a number in their columns.
    """

    numbers: dict[str, Array]
    labels: dict[str, Labels]
    lines: Sequence[int]
    marks: frozenset[str]
    doubtful: bool = False


def read_large(path: Path, numbers: Callable[[Sequence[str]], Sequence[str]], labels: Sequence[str]) -> Columns | None:
    """Columns of a UTF-8 file; None, ValueError or SamplesError where `read_table` must read it as a whole."""
    with path.open("rb") as file:
        head = file.read(HEAD) + file.readline()
        form = _form(head, str(path), numbers, labels)
        head = b"".join(head.splitlines(keepends=True)[: form.line])
        file.seek(len(head))
        digest = hashlib.sha256(head)
        gathered = _Gathered(form, path.stat().st_size)
        threads, waiting = min(thread_count(), MOST_THREADS), deque[Future[_Rows]]()
        with ThreadPoolExecutor(threads) as pool:
            for data, lines in _sections(file, form.line + 1):
                waiting.append(pool.submit(lambda *given: _section(*given, form, gathered.marks), data, lines))
                digest.update(data)
                if len(waiting) > threads:
                    gathered.add(waiting.popleft().result())
            while waiting:
                gathered.add(waiting.popleft().result())
    if not gathered.count or (gathered.doubtful and rows_begin_with_text(path, form.line, form.delimiter)):
        return None
    return gathered.columns(path, digest.hexdigest())


def _form(head: bytes, file: str, numbers: Callable[[Sequence[str]], Sequence[str]], labels: Sequence[str]) -> _Form:
    """The form that the beginning of a file shows; raises ValueError, SamplesError."""
    lines, _ = lines_and_comments(_newlines(head).decode("utf-8-sig"))
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


def _sections(file: BinaryIO, line: int) -> Iterator[tuple[bytes, range]]:
    """The rest of a file in pieces of whole lines, with the numbers of these from `line` on."""
    while data := file.read(SECTION) + file.readline():
        count = _count(data, "\n") + (not data.endswith(b"\n"))
        yield data, range(line, line + count)
        line += count


def _count(data: bytes, sign: str) -> int:
    """How often one sign occurs; many times as fast as bytes.count where it occurs often."""
    return int(np.count_nonzero(np.frombuffer(data, dtype=np.uint8) == ord(sign)))


def _newlines(data: bytes) -> bytes:
    """Lines, each ended by a newline alone; raises ValueError for control characters and other line ends."""
    if np.count_nonzero(np.frombuffer(data, dtype=np.uint8) < 32) > sum(_count(data, sign) for sign in "\n\t\r\f"):
        raise ValueError("control characters")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n")
        if b"\r" in data:
            raise ValueError("lines that end otherwise")
    return data if data.endswith(b"\n") else data + b"\n"


def _section(data: bytes, lines: range, form: _Form, marks: frozenset[str]) -> _Rows:
    """Rows of some whole lines, whose numbers may have those decimal marks; raises ValueError, SamplesError."""
    data = _newlines(data)
    if not data.isascii():
        data.decode("utf-8")
    rows = None if b"#" in data else _read_plain(data, lines, form, marks)
    if rows is not None:
        return rows
    kept, comments = lines_and_comments(data.decode("utf-8"), lines.start)
    if len(kept) < len(lines):
        data = "".join(f"{text}\n" for _, text in kept).encode()
    rows = _read_plain(data, tuple(line for line, _ in kept), form, marks) or _read_cells(kept, form, marks)
    places = [form.header.index(name) for name in form.numbers]
    aside = rows_set_aside(comments, form.delimiter, len(form.header))
    return replace(rows, doubtful=0 not in places and any(all(is_number(row[k]) for k in places) for _, row in aside))


def _plain_cells(data: bytes, lines: int, form: _Form) -> bytes | None:
    """Lines without comments whose cells end at each delimiter, quotes taken off; None where that is not shown.

    Each line has a cell for each column, and the columns of numbers hold nothing but what numbers are made of.
    """
    delimiter = form.delimiter.encode()
    step = csv.field_size_limit() // 2  # where a line ends in each stretch of that length, no cell is too long
    if any(data.find(b"\n", at, at + step) < 0 for at in range(0, len(data) - step + 1, step)):
        return None
    if not lines or data.startswith(BYTE_ORDER_MARK):  # which pandas would take off
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
    """Rows of lines without comments; None where cells are not plain, or a number is none with either decimal mark."""
    import pandas as pd

    if (plain := _plain_cells(data, len(lines), form)) is None:
        return None
    fits = {mark: frame for mark in sorted(marks) if (frame := _frame(plain, form, mark)) is not None}
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


class _Gathered:
    """Rows of all sections, one after another."""

    def __init__(self, form: _Form, size: int) -> None:
        most = size // (len(form.header) + len(form.numbers)) + 1  # bytes of a row; memory not used is free
        self._form, self._numbers = form, {name: np.empty(most) for name in form.numbers}
        self._labels: dict[str, list[Labels]] = {name: [] for name in form.labels}
        self._lines: list[Sequence[int]] = []
        self.count, self.doubtful, self.marks = 0, False, frozenset("." if form.delimiter == "," else ".,")

    def add(self, rows: _Rows) -> None:
        """Rows of the next section; raises ValueError where their numbers have another decimal mark."""
        self.marks, self.doubtful = self.marks & rows.marks, self.doubtful or rows.doubtful
        if not self.marks:
            raise ValueError("two decimal marks")
        count = self.count + len(rows.lines)
        for name, values in rows.numbers.items():
            self._numbers[name][self.count : count] = values
        for name, labels in rows.labels.items():
            self._labels[name].append(labels)
        self._lines += [rows.lines] if len(rows.lines) else []
        self.count = count

    def columns(self, path: Path, digest: str) -> Columns:
        """All rows, of which there is one at least."""
        form, numbers = self._form, {name: values[: self.count] for name, values in self._numbers.items()}
        labels = {name: Labels.joined(parts) for name, parts in self._labels.items()}
        lines: Any = range(self._lines[0][0], self._lines[-1][-1] + 1)
        if len(lines) != self.count:
            lines = np.concatenate([np.asarray(part) for part in self._lines])
        if self.count < MANY_ROWS:
            lines = tuple(int(line) for line in lines)

        def number(name: str) -> Array:
            return numbers[name] if name in numbers else read_table(path).columns.number(name)

        def text(name: str) -> Labels:
            return labels[name] if name in labels else read_table(path).columns.text(name)

        def written(name: str, row: int) -> str:
            with path.open("rb") as file:
                line = next(islice(file, int(lines[row]) - 1, None)).decode("utf-8")
            return numbered_rows(lines_and_comments(line)[0], form.delimiter, form.file)[0][1][form.header.index(name)]

        return Columns(form.file, digest, form.header, form.line, lines, number, text, written=written)

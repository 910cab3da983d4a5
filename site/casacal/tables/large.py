"""Text files of a million rows, read section by section.

Text has one grammar, that of `grammar`, and one reader that applies it cell by cell, `read_table`. It takes a million
rows a gigabyte. So a large file is read section by section. A section in which bytes can be cells in one way alone is
read by pandas, any other by the grammar, and a file in which anything is wrong by `read_table`, which says what.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
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
from casacal.tables.plain import Form, Rows, read_plain
from casacal.tables.text import Table, decimal_marks, read_table
from casacal.threads import thread_count

SECTION = 1 << 22
"""Bytes that are read at once, more or less: enough to be worth a call of pandas, which takes as long as 300 KB."""
HEAD = 1 << 16  # bytes in which the header of a large file is looked for, at least
MOST_THREADS = 4  # one thread puts together what they have read, and has no time for more
MANY_ROWS = 100_000  # rows from which lines are numbers in an array rather than Python objects


def read_large(path: Path, numbers: Callable[[Sequence[str]], Sequence[str]], labels: Sequence[str]) -> Columns | None:
    """Columns of a UTF-8 file; None, ValueError or SamplesError where `read_table` must read it as a whole."""
    with path.open("rb") as file:
        head = file.read(HEAD) + file.readline()
        form = _form(head, str(path), numbers, labels)
        head = b"".join(head.splitlines(keepends=True)[: form.line])
        file.seek(len(head))
        digest = hashlib.sha256(head)
        gathered = _Gathered(form, path.stat().st_size)
        threads, waiting = min(thread_count(), MOST_THREADS), deque[Future[Rows]]()
        with ThreadPoolExecutor(threads) as pool:
            for data, lines in _sections(file, form.line + 1):
                waiting.append(pool.submit(_section, data, lines, form, gathered.marks))
                digest.update(data)
                if len(waiting) > threads:
                    gathered.add(waiting.popleft().result())
            while waiting:
                gathered.add(waiting.popleft().result())
    if not gathered.count or (gathered.doubtful and rows_begin_with_text(path, form.line, form.delimiter)):
        return None
    return gathered.columns(path, digest.hexdigest())


def _form(head: bytes, file: str, numbers: Callable[[Sequence[str]], Sequence[str]], labels: Sequence[str]) -> Form:
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
    return Form(file, delimiter, line, header, wanted, tuple(name for name in labels if name in header))


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


def _section(data: bytes, lines: range, form: Form, marks: frozenset[str]) -> Rows:
    """Rows of some whole lines, whose numbers may have those decimal marks; raises ValueError, SamplesError."""
    data = _newlines(data)
    if not data.isascii():
        data.decode("utf-8")
    rows = None if b"#" in data else read_plain(data, lines, form, marks)
    if rows is not None:
        return rows
    kept, comments = lines_and_comments(data.decode("utf-8"), lines.start)
    if len(kept) < len(lines):
        data = "".join(f"{text}\n" for _, text in kept).encode()
    rows = read_plain(data, tuple(line for line, _ in kept), form, marks) or _read_cells(kept, form, marks)
    places = [form.header.index(name) for name in form.numbers]
    aside = rows_set_aside(comments, form.delimiter, len(form.header))
    return replace(rows, doubtful=0 not in places and any(all(is_number(row[k]) for k in places) for _, row in aside))


def _read_cells(lines: list[tuple[int, str]], form: Form, marks: frozenset[str]) -> Rows:
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
    return Rows(numbers, {name: Labels.of(table.column(name)) for name in form.labels}, table.lines, marks)


class _Gathered:
    """Rows of all sections, one after another."""

    def __init__(self, form: Form, size: int) -> None:
        most = size // (len(form.header) + len(form.numbers)) + 1  # bytes of a row; memory not used is free
        self._form, self._numbers = form, {name: np.empty(most) for name in form.numbers}
        self._labels: dict[str, list[Labels]] = {name: [] for name in form.labels}
        self._lines: list[Sequence[int]] = []
        self.count, self.doubtful, self.marks = 0, False, frozenset("." if form.delimiter == "," else ".,")

    def add(self, rows: Rows) -> None:
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

"""CSV files of a million rows: section by section, by threads.

The grammar is that of `text`, cell by cell, and so is every refusal. pandas reads a hundred times as fast, and is
believed where lines are proven plain: by an account of what it found, or where that cannot be given, beforehand. Any
other section is halved until little is left to be read by `text`; and a file in which anything is wrong is read by
`text` from its beginning, which can say what.
"""

from __future__ import annotations

import contextlib
import csv
import ctypes
import io
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from casacal.errors import SamplesError
from casacal.tables.columns import Columns
from casacal.tables.comments import is_number, rows_begin_with_text
from casacal.tables.digests import SharedDigest
from casacal.tables.grammar import LINE_END, check_header, delimiter_of, logical_lines, numbered_rows, refuse_controls
from casacal.tables.labels import Labels
from casacal.tables.plain_cells import accountable, accounted
from casacal.tables.plain_lines import Form, Plain, count, proven
from casacal.tables.sections import Gathered, Rows
from casacal.tables.text import decimal_marks, table_of_lines
from casacal.threads import thread_count

LARGE_FILE = 1 << 21
"""Bytes from which a CSV file is worth the time it takes to import pandas."""
SECTION = 1 << 22
"""Bytes that one thread reads, more or less: enough to be worth a call of pandas, which takes as long as 300 KB."""
SMALLEST_SECTION = 1 << 18
"""Bytes that are read cell by cell for one odd line, at most."""
MOST_THREADS = 4
"""One thread puts together what they have read, and has no time for more."""


def read_large_csv(
    path: Path, numbers: Callable[[tuple[str, ...]], Sequence[str]], labels: Sequence[str]
) -> Columns | None:
    """Columns of a large CSV file; None where the file is small, or `read_table` must say what is wrong with it.

    Args:
        path: of the file.
        numbers: which columns of a header must be numbers.
        labels: columns of text that are kept, where the file has them; others, such as times, are left in the file.

    """
    with contextlib.suppress(OSError, ValueError, SamplesError):
        if path.stat().st_size < LARGE_FILE:
            return None
        with path.open("rb") as file:
            before, line, delimiter, header = _header(file, str(path))
            wanted = tuple(dict.fromkeys(numbers(header)))
            if wanted:
                form = Form(delimiter, header, wanted, tuple(name for name in labels if name in header))
                digest, gathered = _read(file, path, before, line, form)
                if gathered.doubtful and rows_begin_with_text(path, line, delimiter):
                    return None
                return gathered.columns(path, digest, line)
    return None


def _header(file: BinaryIO, name: str) -> tuple[bytes, int, str, tuple[str, ...]]:
    """All bytes up to the end of the header, its line, its delimiter and its names; raises ValueError, SamplesError."""
    before = []
    while data := file.readline(SECTION):
        before.append(data)
        if data == b"\n":  # for those files that have a million of them
            continue
        text = data.decode("utf-8-sig" if len(before) == 1 else "utf-8").removesuffix("\n").removesuffix("\r")
        refuse_controls(text, name)
        if "\r" in text or not data.endswith(b"\n"):
            raise ValueError("lines that end otherwise")
        if lines := logical_lines(text, len(before)):
            delimiter = delimiter_of(text)
            header = tuple(numbered_rows(lines, delimiter, name)[0][1])
            check_header(header, name, len(before))
            return b"".join(before), len(before), delimiter, header
    raise ValueError("no header")


def _read(file: BinaryIO, path: Path, before: bytes, line: int, form: Form) -> tuple[str, Gathered]:
    """SHA-256 of the file, and the rows of its sections; raises ValueError, SamplesError for what is not understood."""
    size, threads = path.stat().st_size, min(thread_count(), MOST_THREADS)
    digest, gathered = SharedDigest(before), Gathered(size, form)
    pool, waiting = ThreadPoolExecutor(threads), deque[Any]()

    def rows_of(data: bytes, lines: range) -> list[Rows]:
        rows = _rows(data, str(path), lines, form)
        digest.go_on()
        return rows

    try:
        for data in _sections(file, size, threads):
            lines = count(data, b"\n") + (not data.endswith(b"\n"))
            digest.add(data)
            waiting.append(pool.submit(rows_of, data, range(line + 1, line + 1 + lines)))
            line += lines
            while waiting and (waiting[0].done() or len(waiting) > threads + 1):
                gathered.add(waiting.popleft().result())
        while waiting:
            gathered.add(waiting.popleft().result())
    finally:
        pool.shutdown(cancel_futures=True)
    _give_back()
    return digest.all(), gathered


def _sections(file: BinaryIO, size: int, threads: int) -> Iterator[bytes]:
    """The rest of a file in pieces of whole lines; raises ValueError for a line longer than a piece."""
    start = file.tell()
    while True:
        some = min(SECTION, max((size - start) // (2 * threads), SECTION // 4))  # so that threads end together
        file.seek(start + some)
        if len(file.readline(SECTION)) == SECTION:
            raise ValueError("a long line")
        end = file.tell()
        file.seek(start)
        if not (data := file.read(end - start)):
            return
        yield data
        start = end


def _rows(data: bytes, name: str, lines: range, form: Form) -> list[Rows]:
    """Rows of whole lines with those numbers, in order; raises ValueError, SamplesError."""
    if (rows := _plain_rows(data, lines, form)) is not None:
        return [rows]
    middle = data.find(b"\n", len(data) // 2) + 1
    if len(data) <= SMALLEST_SECTION or middle in (0, len(data)):
        return [_cell_by_cell(data, name, lines[0], form)]
    here = count(data[:middle], b"\n")
    return _rows(data[:middle], name, lines[:here], form) + _rows(data[middle:], name, lines[here:], form)


def _plain_rows(data: bytes, lines: range, form: Form) -> Rows | None:
    """Rows of lines that are proven plain, after pandas read them or before; None where neither succeeds."""
    plain = accountable(data, len(lines), form)
    rows = None if plain is None else _parsed(plain, lines, form)
    if plain is not None and rows is not None and (found := accounted(rows, plain, form)) is not None:
        return found
    plain = proven(data, form)
    return None if plain is None else _parsed(plain, lines, form)


def _cell_by_cell(data: bytes, name: str, first: int, form: Form) -> Rows:
    """Rows as `text` reads them."""
    text = data.decode("utf-8")
    if len(LINE_END.findall(text)) != data.count(b"\n"):
        raise ValueError("lines that end otherwise")
    table, comments = table_of_lines(text, name, form.names, first, form.delimiter)
    places = [form.names.index(name) for name in form.numbers]
    doubtful = 0 not in places and any(all(is_number(cells[k]) for k in places) for _, cells in comments)
    marks = ""
    if form.delimiter != ",":
        comma, point = decimal_marks(table)
        marks, table = "," if comma else "." if point else "", replace(table, decimal_comma=comma is not None)
    numbers = {name: np.array(table.numbers(name), dtype=np.float64) for name in form.numbers}
    labels = {name: Labels.of(table.column(name)) for name in form.texts}
    coded = {name: (each.names, each.codes) for name, each in labels.items()}
    return Rows(numbers, coded, table.lines, marks, doubtful)


def _parsed(plain: Plain, lines: range, form: Form) -> Rows | None:
    """Rows as pandas reads them; None where it cannot read a number, or one is not finite."""
    import pandas as pd

    kinds: Any = dict.fromkeys(form.numbers, "float64")
    kinds |= dict.fromkeys(form.texts, "object")  # among categories, 01 would be 1
    if len(kinds) == len(form.names) and not form.texts:
        kinds = "float64"  # one type for all is sooner dealt with than the same for each
    # before 3.1 pandas had a faster way that may be wrong in the last digit
    exact: Any = {} if _version(pd.__version__) >= (3, 1) else {"float_precision": "round_trip"}
    try:
        frame = pd.read_csv(
            _Bytes(plain.data), sep=form.delimiter, decimal=plain.mark or ".", names=list(form.names), header=None,  # type: ignore[call-overload]
            usecols=[*form.numbers, *form.texts], index_col=False, dtype=kinds, keep_default_na=False, na_filter=False,
            encoding="utf-8", quoting=csv.QUOTE_NONE, skip_blank_lines=False, low_memory=False, **exact,
        )  # fmt: skip
    except (ValueError, pd.errors.ParserError):
        return None
    numbers = {name: frame[name].to_numpy() for name in form.numbers}
    if not len(frame) == plain.lines == len(lines) or not all(np.isfinite(column).all() for column in numbers.values()):
        return None
    labels = {name: _coded(frame[name].to_numpy()) for name in form.texts}
    return Rows(numbers, labels, lines, plain.mark)


def _coded(texts: NDArray[Any]) -> tuple[Sequence[str], NDArray[Any]]:
    """Different strings, and which of them each row has; one that came as several objects may be named as often.

    pandas makes one object of equal strings, so that where they are tells them apart sooner than what they say.
    """
    import pandas as pd

    codes, places = pd.factorize(np.frombuffer(texts.tobytes(), dtype=np.intp))
    rows = np.empty(len(places), dtype=np.intp)
    rows[codes] = np.arange(len(codes))
    return texts[rows].tolist(), codes


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(".")[:2])


class _Bytes:
    """Bytes as a file; what pandas takes for a file of text, it decodes only to encode it again."""

    def __init__(self, data: bytes) -> None:
        self.read = io.BytesIO(data).read

    def __iter__(self) -> Iterator[bytes]:
        return iter(())


def _give_back() -> None:
    """Let the system have the memory that parsing leaves behind, where the C library keeps it for later."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # a C library without it, or without such a name
        ctypes.CDLL(None).malloc_trim(0)

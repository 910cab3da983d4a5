"""CSV files of a million rows: parsed by threads in sections, each number straight into its place.

What is unusual in a file is left to `tables`, which reads cell by cell, understands more and can say what is wrong in
which line.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from casacal.array_types import Array
from casacal.tables.columns import Columns
from casacal.tables.labels import Labels
from casacal.threads import thread_count

LARGE_FILE = 1 << 21
"""Bytes from which a CSV file is worth the time it takes to import pandas."""
SECTION = 1 << 23
"""Bytes that one thread parses, more or less."""
PIECE = 1 << 20
"""Bytes read at a time."""
ROWS = 25_000
"""Rows parsed at a time."""
MOST_THREADS = 4
"""One thread makes the file's SHA-256, and has no time for more that parse."""
NEWLINE = ord("\n")


def read_large_csv(
    path: Path, numbers: Callable[[tuple[str, ...]], Sequence[str]], labels: Sequence[str]
) -> Columns | None:
    """Columns of a plain large CSV file; None where the file is small, or anything in it is out of the ordinary.

    Args:
        path: of the file.
        numbers: which columns of a header must be numbers.
        labels: columns of text that are kept, where the file has them; others, such as times, are not.

    """
    try:
        if path.stat().st_size < LARGE_FILE:
            return None
        with path.open("rb") as file:
            header, before = _header(file)
    except (OSError, UnicodeDecodeError):
        return None
    delimiter = max(",;\t", key=header.count)
    names = tuple(name.strip() for name in header.split(delimiter))
    wanted = numbers(names)
    if len(set(names)) != len(names) or not all(name.isprintable() and name for name in names) or '"' in header:
        return None
    for decimal in (".",) if delimiter == "," else (".", ","):
        form = _Form(delimiter, decimal, names, frozenset(wanted), tuple(name for name in labels if name in names))
        read = _read_sections(path, before, form) if wanted else None
        if read is not None:
            digest, values, texts = read
            first, rows = before.count(b"\n") + 1, len(values[wanted[0]])
            lines = range(first, first + rows)
            return Columns(str(path), digest, names, first - 1, lines, values.__getitem__, texts.__getitem__)
    return None


@dataclass(frozen=True)
class _Form:
    """How a text file is written."""

    delimiter: str
    decimal: str
    names: tuple[str, ...]
    numbers: frozenset[str]
    texts: tuple[str, ...]


def _header(file: BinaryIO) -> tuple[str, bytes]:
    """The header line, and all up to its end; comment lines and blank ones may come first."""
    before = b""
    for line in file:
        before += line
        text = line.decode("utf-8-sig").strip()
        if text and not text.startswith("#"):
            return text, before
    return "", before


def _read_sections(path: Path, before: bytes, form: _Form) -> tuple[str, dict[str, Array], dict[str, Labels]] | None:
    """SHA-256 of the file, its numbers, its labels; sections are parsed by threads. None for what is not ordinary."""
    digest, rows = hashlib.sha256(before), 0
    most = path.stat().st_size // (2 * len(form.names)) + 1  # a cell takes two bytes at least; memory not used is free
    values = {name: np.empty(most) for name in form.numbers}
    codes = {name: np.empty(most, dtype=np.int32) for name in form.texts}
    known: dict[str, dict[str, int]] = {name: {} for name in form.texts}

    def finish(parsed: Future[list[dict[str, Any]] | None], first: int) -> bool:
        for k, texts in enumerate(parsed.result() or ()):
            for name, column in texts.items():
                numbered = [known[name].setdefault(str(label).strip(), len(known[name])) for label in column.categories]
                here = slice(first + k * ROWS, first + k * ROWS + len(column))
                codes[name][here] = np.array(numbered, dtype=np.int32)[column.codes]
        return parsed.result() is not None

    with path.open("rb", buffering=0) as file, warnings.catch_warnings():
        warnings.simplefilter("error")
        file.seek(len(before))
        pool, waiting = ThreadPoolExecutor(min(thread_count(), MOST_THREADS)), deque[tuple[Any, int]]()
        try:
            for start, end, lines in _sections(file, digest):
                places = {name: column[rows : rows + lines] for name, column in values.items()}
                waiting.append((pool.submit(_parsed, path, start, end, form, places), rows))
                rows += lines
                while waiting and waiting[0][0].done():
                    if not finish(*waiting.popleft()):
                        return None
            if not all(finish(*each) for each in waiting):
                return None
        finally:
            pool.shutdown(cancel_futures=True)
    _give_back()
    labels = {name: Labels(tuple(known[name]), codes[name][:rows]) for name in form.texts}
    return (digest.hexdigest(), {name: column[:rows] for name, column in values.items()}, labels) if rows else None


def _sections(file: FileIO, digest: Any) -> Iterator[tuple[int, int, int]]:
    """Where sections of whole lines begin and end, and how many lines each has; all that is read goes to `digest`."""
    piece, start = np.empty(PIECE, dtype=np.uint8), file.tell()
    lines, end, last = 0, start, NEWLINE
    while count := file.readinto(piece.data):
        here = piece[:count]
        digest.update(here.data)
        breaks = here == NEWLINE
        if end + count - start >= SECTION and breaks.any():
            cut = count - int(np.argmax(breaks[::-1]))
            yield start, end + cut, lines + int(np.count_nonzero(breaks[:cut]))
            start, lines, breaks = end + cut, 0, breaks[cut:]
        lines, end, last = lines + int(np.count_nonzero(breaks)), end + count, here[-1]
    if end > start:
        yield start, end, lines + (last != NEWLINE)


class _Section:
    """Some bytes of a file as a file of bytes; what pandas reads as text, it decodes only to encode it again."""

    def __init__(self, file: BinaryIO, start: int, end: int) -> None:
        file.seek(start)
        self._file, self._left = file, end - start

    def read(self, count: int) -> bytes:
        """The next bytes; raises ValueError for a zero, at which pandas would end a number."""
        some = self._file.read(min(count, self._left))
        if b"\0" in some:
            raise ValueError("zero bytes")
        self._left -= len(some)
        return some

    def __iter__(self) -> Iterator[bytes]:
        return iter(())


def _parsed(path: Path, start: int, end: int, form: _Form, numbers: dict[str, Array]) -> list[dict[str, Any]] | None:
    """Fill in the numbers of some lines; the rest as categories, some rows at a time.

    None when pandas cannot read them, when a number is not finite, or when there are other than as many rows as lines:
    blank lines or quoted ones, after which lines are not where they seem.
    """
    import pandas as pd

    # one type for all is sooner dealt with than the same for each; to leave a column out would hide cells too many
    kinds: Any = dict.fromkeys(form.names, "object") | dict.fromkeys(form.numbers, "float64")
    kinds |= dict.fromkeys(form.texts, "category")
    kinds = "float64" if set(kinds.values()) == {"float64"} else kinds
    texts, first, lines = [], 0, min(map(len, numbers.values()))
    try:
        with path.open("rb") as file:
            source: Any = _Section(file, start, end)
            frames = pd.read_csv(
                source, sep=form.delimiter, decimal=form.decimal, names=list(form.names), header=None,
                index_col=False, dtype=kinds, keep_default_na=False, na_filter=False, encoding="utf-8",
                encoding_errors="strict", chunksize=ROWS,
            )  # fmt: skip
            for frame in frames:
                here = slice(first, first + len(frame))
                for name, place in numbers.items():
                    column = frame[name].to_numpy()
                    if here.stop > lines or not np.isfinite(column).all():
                        return None
                    place[here] = column
                texts.append({name: frame[name].array for name in form.texts})
                first = here.stop
    except (OSError, ValueError, pd.errors.ParserError, pd.errors.ParserWarning, pd.errors.DtypeWarning):
        return None
    return texts if first == lines else None


def _give_back() -> None:
    """Let the system have the memory that parsing leaves behind, where the C library keeps it for later."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # a C library without it, or without such a name
        ctypes.CDLL(None).malloc_trim(0)

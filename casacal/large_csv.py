"""CSV files of a million rows: read in parts, parsed by threads, each number straight into its place.

What is unusual in a file is left to `tables`, which reads cell by cell, understands more and can say what is wrong in
which line.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.columns import Columns
from casacal.labels import Labels
from casacal.threads import thread_count

Array: TypeAlias = NDArray[np.float64]

LARGE_FILE = 1 << 21
"""Bytes from which a CSV file is worth the time it takes to import pandas."""
PART = 1 << 21
"""Bytes read and parsed at a time."""
MOST_THREADS = 4
"""One thread makes the file's SHA-256, and has no time for more that parse."""
NEWLINE = ord("\n")


def read_large_csv(path: Path, numbers: Callable[[tuple[str, ...]], Sequence[str]]) -> Columns | None:
    """Columns of a plain large CSV file; None where the file is small, or anything in it is out of the ordinary.

    Args:
        path: of the file.
        numbers: which columns of a header must be numbers; the others are labels.

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
        read = _read_parts(path, before, _Form(delimiter, decimal, names, frozenset(wanted))) if wanted else None
        if read is not None:
            digest, values, labels = read
            first, rows = before.count(b"\n") + 1, len(values[wanted[0]])
            lines = range(first, first + rows)
            return Columns(str(path), digest, names, first - 1, lines, values.__getitem__, labels.__getitem__)
    return None


@dataclass(frozen=True)
class _Form:
    """How a text file is written."""

    delimiter: str
    decimal: str
    names: tuple[str, ...]
    numbers: frozenset[str]

    @property
    def texts(self) -> list[str]:
        """What is not a number."""
        return [name for name in self.names if name not in self.numbers]


def _header(file: BinaryIO) -> tuple[str, bytes]:
    """The header line, and all up to its end; comment lines and blank ones may come first."""
    before = b""
    for line in file:
        before += line
        text = line.decode("utf-8-sig").strip()
        if text and not text.startswith("#"):
            return text, before
    return "", before


def _read_parts(path: Path, before: bytes, form: _Form) -> tuple[str, dict[str, Array], dict[str, Labels]] | None:
    """SHA-256 of the file, its numbers and its labels; parts are parsed by threads. None for what is not ordinary."""
    digest, rows, workers = hashlib.sha256(before), 0, min(thread_count(), MOST_THREADS)
    most = path.stat().st_size // (2 * len(form.names)) + 1  # a cell takes two bytes at least; memory not used is free
    values = {name: np.empty(most) for name in form.numbers}
    codes = {name: np.empty(most, dtype=np.int32) for name in form.texts}
    known: dict[str, dict[str, int]] = {name: {} for name in form.texts}

    def finish(parsed: Future[dict[str, Any] | None], here: slice) -> bool:
        columns = parsed.result()
        for name, column in (columns or {}).items():
            numbered = [known[name].setdefault(str(label).strip(), len(known[name])) for label in column.categories]
            codes[name][here] = np.array(numbered, dtype=np.int32)[column.codes]
        return columns is not None

    with path.open("rb") as file, warnings.catch_warnings(), ThreadPoolExecutor(workers) as pool:
        warnings.simplefilter("error")
        file.seek(len(before))
        waiting: deque[tuple[Future[dict[str, Any] | None], slice]] = deque()
        while part := _whole_lines(file):
            lines = int(np.count_nonzero(np.frombuffer(part, dtype=np.uint8) == NEWLINE)) + (part[-1] != NEWLINE)
            here, rows = slice(rows, rows + lines), rows + lines
            places = {name: column[here] for name, column in values.items()}
            waiting.append((pool.submit(_parsed, part, form, places), here))
            digest.update(part)
            if len(waiting) > workers and not finish(*waiting.popleft()):
                return None
        if not all(finish(*each) for each in waiting):
            return None
    _give_back()
    labels = {name: Labels(tuple(known[name]), codes[name][:rows]) for name in form.texts}
    return (digest.hexdigest(), {name: column[:rows] for name, column in values.items()}, labels) if rows else None


def _whole_lines(file: BinaryIO) -> memoryview:
    """The next lines of a file, `PART` of bytes at most or one longer line; empty at its end."""
    part = bytearray(PART)
    count = file.readinto(part)  # type: ignore[attr-defined]
    end = part.rfind(b"\n", 0, count) + 1
    if not end:
        return memoryview(part[:count] + file.readline())
    file.seek(end - count, os.SEEK_CUR)
    return memoryview(part)[:end]


class _Bytes:
    """A file of some bytes that pandas reads as they are: text it would decode, and encode again to parse it."""

    def __init__(self, part: memoryview) -> None:
        self._left = part

    def read(self, count: int) -> bytes:
        """The next bytes; at the end, the part is let go, whoever still holds this file."""
        some = bytes(self._left[:count])
        self._left = self._left[count:] if some else memoryview(b"")
        return some

    def __iter__(self) -> Iterator[bytes]:
        return iter(())


def _parsed(part: memoryview, form: _Form, numbers: Mapping[str, Array]) -> dict[str, Any] | None:
    """Fill in the numbers of some lines; the rest as categories.

    None when pandas cannot read them, when a number is not finite, or when there are other than as many rows as lines:
    blank lines or quoted ones, after which lines are not where they seem.
    """
    import pandas as pd

    source: Any = _Bytes(part)
    # one type for all is sooner dealt with than the same for each
    kinds: Any = {n: "float64" if n in form.numbers else "category" for n in form.names} if form.texts else "float64"
    try:
        frame = pd.read_csv(
            source, sep=form.delimiter, decimal=form.decimal, names=list(form.names), header=None,
            index_col=False, dtype=kinds,
            keep_default_na=False, na_filter=False, encoding="utf-8", encoding_errors="strict",
        )  # fmt: skip
    except (ValueError, pd.errors.ParserError, pd.errors.ParserWarning, pd.errors.DtypeWarning):
        return None
    for name, place in numbers.items():
        if len(frame) != len(place) or not np.isfinite(frame[name].to_numpy()).all():
            return None
        place[:] = frame[name].to_numpy()
    return {name: frame[name].array for name in form.texts}


def _give_back() -> None:
    """Let the system have the memory that parsing leaves behind, where the C library keeps it for later."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # a C library without it, or without such a name
        ctypes.CDLL(None).malloc_trim(0)

"""Samples by the million: columns of numbers from large CSV files, .npy and .npz, without a Python object a cell.

What is unusual in a CSV file is left to `tables`, which reads cell by cell, understands more and can say what is wrong
in which line.
"""

from __future__ import annotations

import hashlib
import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.errors import SamplesError
from casacal.labels import Labels

Array: TypeAlias = NDArray[np.float64]

LARGE_FILE = 1 << 21
"""Bytes from which a CSV file is worth the time it takes to import pandas."""
ARRAYS = (".npy", ".npz")
PART = 1 << 20
"""Bytes read at a time."""
TOGETHER = 1 << 18
"""Rows parsed at a time."""


@dataclass(frozen=True)
class Columns:
    """Named columns of equal length; `number` and `text` read one of them.

    header_line: where a text file has its header, 0 for arrays. lines: of each row in its file; for arrays its row,
    counted from 1.
    """

    file: str
    sha256: str
    header: tuple[str, ...]
    header_line: int
    lines: range
    number: Callable[[str], Array]
    text: Callable[[str], Labels]


def read_large_csv(path: Path, numbers: Callable[[tuple[str, ...]], Sequence[str]]) -> Columns | None:
    """Columns of a plain large CSV file; None where the file is small, or anything in it is out of the ordinary.

    Args:
        path: of the file.
        numbers: which columns of a header must be numbers; the others are labels.

    """
    try:
        if path.stat().st_size < LARGE_FILE:
            return None
        header, header_line = _header(path)
        newlines, complete = _count_lines(path)
    except (OSError, UnicodeDecodeError):
        return None
    delimiter = max(",;\t", key=header.count)
    names = tuple(name.strip() for name in header.split(delimiter))
    wanted, rows = numbers(names), newlines - header_line + (not complete)
    if len(set(names)) != len(names) or not all(name.isprintable() and name for name in names) or '"' in header:
        return None
    if not wanted or rows < 1:
        return None
    with ThreadPoolExecutor(1) as other:  # the file is hashed while it is parsed
        digest = other.submit(_digest, path)
        for decimal in (".",) if delimiter == "," else (".", ","):
            read = _parsed(path, delimiter, decimal, names, header_line, wanted, rows)
            if read is not None:
                values, labels = read
                lines = range(header_line + 1, header_line + 1 + rows)
                return Columns(
                    str(path), digest.result(), names, header_line, lines, values.__getitem__, labels.__getitem__
                )
    return None


def _header(path: Path) -> tuple[str, int]:
    """The header line and its number; comment lines and blank ones before it are counted."""
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            text = line.decode("utf-8-sig").strip()
            if text and not text.startswith("#"):
                return text, number
    return "", 0


def _count_lines(path: Path) -> tuple[int, bool]:
    """How many line ends a file has, and whether it ends with one."""
    newlines, last = 0, b""
    with path.open("rb") as file:
        while part := file.read(PART):
            newlines += part.count(b"\n")
            last = part[-1:]
    return newlines, last == b"\n"


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _parsed(
    path: Path,
    delimiter: str,
    decimal: str,
    names: Sequence[str],
    header_line: int,
    numbers: Sequence[str],
    rows: int,
) -> tuple[dict[str, Array], dict[str, Labels]] | None:
    """Numbers and labels as pandas reads them, some rows at a time; None when it cannot, or finds other than `rows`."""
    import pandas as pd

    values = {name: np.empty(rows) for name in numbers}
    texts = [name for name in names if name not in values]
    codes = {name: np.empty(rows, dtype=np.int32) for name in texts}
    known: dict[str, dict[str, int]] = {name: {} for name in texts}
    done = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            chunks = pd.read_csv(
                path, sep=delimiter, decimal=decimal, names=list(names), header=None, skiprows=header_line,
                index_col=False, dtype={name: "float64" if name in values else "category" for name in names},
                keep_default_na=False, na_filter=False, encoding="utf-8", encoding_errors="strict", chunksize=TOGETHER,
            )  # fmt: skip
            for chunk in chunks:
                here = slice(done, done + len(chunk))
                done = here.stop
                if done > rows:
                    return None
                for name in numbers:
                    values[name][here] = chunk[name].to_numpy()
                for name in texts:
                    column, places = chunk[name].cat, known[name]
                    numbered = [places.setdefault(str(label).strip(), len(places)) for label in column.categories]
                    codes[name][here] = np.array(numbered, dtype=np.int32)[column.codes.to_numpy()]
    except (ValueError, pd.errors.ParserError, pd.errors.ParserWarning, pd.errors.DtypeWarning):
        return None
    # fewer rows than lines: blank lines or quoted ones shift the count
    if done != rows or any(not np.isfinite(column).all() for column in values.values()):
        return None
    return values, {name: Labels(tuple(known[name]), codes[name]) for name in texts}


def read_arrays(path: Path) -> Columns:
    """Columns of a .npy file with named fields, mapped into memory, or of an .npz file with one array a column.

    Raises SamplesError for anything else.
    """
    file = str(path)
    try:
        loaded = np.load(path, mmap_mode="r", allow_pickle=False)
        names = loaded.dtype.names if isinstance(loaded, np.ndarray) else loaded.files
        arrays = {name: loaded[name] for name in names or ()}
        digest = _digest(path)
    except FileNotFoundError:
        raise SamplesError(file, "there is no such file", "Check the path") from None
    except (OSError, ValueError, EOFError):
        raise SamplesError(
            file, "this is not an array file of NumPy without Python objects", "Write it with numpy.save or numpy.savez"
        ) from None
    if names is None:
        raise SamplesError(
            file, "the array has no named columns", "Give fields such as q1_deg, or an .npz with one array a column"
        )
    rows = {name: _length(file, name, values) for name, values in arrays.items()}
    if len(set(rows.values())) != 1 or not next(iter(rows.values())):
        found = ", ".join(f"{name} {count}" for name, count in rows.items())
        raise SamplesError(file, f"the columns hold {found or 'no'} rows", "Give all columns the same number of rows")
    return columns_of_arrays(arrays, file, digest)


def columns_of_arrays(arrays: Mapping[str, Any], file: str, digest: str) -> Columns:
    """Columns of arrays by name, of equal length; what is read as numbers must be numbers."""

    def number(name: str) -> Array:
        values = np.asarray(arrays[name])
        if values.dtype.kind not in "iuf":
            raise SamplesError(file, f"the column holds {values.dtype}, not numbers", "Store float64", column=name)
        values = np.asarray(values, dtype=np.float64)
        for row in np.flatnonzero(~np.isfinite(values))[:1]:
            raise SamplesError(
                file,
                f"'{values[row]}' is not a finite number",
                "Mend or remove the row",
                line=int(row) + 1,
                column=name,
            )
        return values

    def text(name: str) -> Labels:
        return Labels.coded(*np.unique(np.asarray(arrays[name]), return_inverse=True))

    count = len(next(iter(arrays.values())))
    return Columns(file, digest, tuple(arrays), 0, range(1, count + 1), number, text)


def digest_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of columns: their names and their bytes."""
    digest = hashlib.sha256()
    for name, values in arrays.items():
        digest.update(name.encode() + b"\0")
        buffer = io.BytesIO()
        np.save(buffer, values, allow_pickle=False)
        digest.update(buffer.getbuffer())
    return digest.hexdigest()


def _length(file: str, name: str, values: NDArray[Any]) -> int:
    if values.ndim != 1:
        raise SamplesError(file, f"the column has the shape {values.shape}", "Give one number a row", column=name)
    return len(values)

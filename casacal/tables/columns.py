"""Columns of numbers and labels without a Python object a cell: from .npy and .npz files, and from arrays by name."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.errors import SamplesError
from casacal.tables.labels import Labels

ARRAYS = (".npy", ".npz")


@dataclass(frozen=True)
class Columns:
    """Named columns of equal length: what every form of rows is read as; `number` and `text` read one of them.

    header_line: where a text file has its header, 0 for arrays. lines: of each row in its file; for arrays its row,
    counted from 1. texts: all columns as they were written, for rows that were read cell by cell; none otherwise.
    written: one cell of a column and row as it was written, where the file is asked again.
    """

    file: str
    sha256: str
    header: tuple[str, ...]
    header_line: int
    lines: Sequence[int]
    number: Callable[[str], Array]
    text: Callable[[str], Labels]
    texts: Callable[[], Mapping[str, tuple[str, ...]]] = dict
    written: Callable[[str, int], str] | None = None

    def cell(self, name: str, row: int) -> str:
        """One cell as it was written, or where nobody keeps that, its number."""
        if self.written is not None:
            return self.written(name, row)
        texts = self.texts()
        return texts[name][row] if name in texts else f"{self.number(name)[row]:g}"


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_arrays(path: Path) -> Columns:
    """Columns of a .npy file with named fields, mapped into memory, or of an .npz file with one array per column.

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
            file, "the array has no named columns", "Give fields such as q1_deg, or an .npz with one array per column"
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
        raise SamplesError(file, f"the column has the shape {values.shape}", "Give one number per row", column=name)
    return len(values)

"""Columns of numbers and labels without a Python object a cell: what every form of rows is read as."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.errors import SamplesError
from casacal.tables.labels import Labels


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


def columns_of_arrays(arrays: Mapping[str, Any], file: str, digest: str) -> Columns:
    """Columns of arrays by name, of equal length; what is read as numbers must be numbers."""

    def number(name: str) -> Array:
        values = np.asarray(arrays[name])
        if values.dtype.kind not in "iuf" or values.dtype == np.float16:
            raise SamplesError(file, f"the column holds {_kind(values)}, not numbers", "Store float64", column=name)
        with np.errstate(all="ignore"):  # a number beyond float64 becomes infinite, and is refused as such
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
        values = np.asarray(arrays[name])
        if values.dtype.kind not in "iufbUSM":
            raise SamplesError(file, f"the column holds {_kind(values)}, not labels", "Store text", column=name)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0]) + 1
            raise SamplesError(file, "the label is not finite", "Give the row its label", line=row, column=name)
        names, codes = np.unique(values, return_inverse=True)
        try:
            return Labels.coded((each.decode() if isinstance(each, bytes) else str(each) for each in names), codes)
        except (ValueError, SystemError):  # the latter is what Python makes of signs beyond Unicode
            raise SamplesError(file, "a label is not text of Unicode", "Store it as such", column=name) from None

    count = len(next(iter(arrays.values())))
    return Columns(file, digest, tuple(arrays), 0, range(1, count + 1), number, text)


def _kind(values: NDArray[Any]) -> str:
    return "records" if values.dtype.kind == "V" else str(values.dtype)


def digest_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of columns: their names and their bytes."""
    digest = hashlib.sha256()
    for name, values in arrays.items():
        digest.update(name.encode() + b"\0")
        buffer = io.BytesIO()
        np.save(buffer, values, allow_pickle=False)
        digest.update(buffer.getbuffer())
    return digest.hexdigest()

"""Rows in arrays: in memory, in DataFrames of pandas, in files of NumPy; what is wrong is said in a sentence.

Also what all zip archives are asked, be they of arrays or workbooks: what they unpack to is known, and bounded, before
anything in them is read.
"""

from __future__ import annotations

import hashlib
import io
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.errors import CasacalError, SamplesError
from casacal.tables.columns import Columns, Labels
from casacal.tables.text import check_names

ARRAYS = (".npy", ".npz")
MOST_MEMBERS = 10_000
UNPACKED = 1 << 26  # bytes that any archive may unpack to
GROWTH = 20  # a larger archive may unpack to so many times its size; measurements seldom shrink to a half
PIECE = 1 << 20


def columns_of_arrays(arrays: Mapping[str, Any], file: str, digest: str) -> Columns:
    """Columns of arrays by name, of equal length; what is read as numbers must be numbers."""

    def number(name: str) -> Array:
        values = np.asarray(arrays[name])
        if values.dtype.kind not in "iuf" or values.dtype == np.float16:
            raise SamplesError(file, f"the column holds {_kind(values)}, not numbers", "Store float64", column=name)
        with np.errstate(all="ignore"):  # a number beyond float64 becomes infinite, and is refused as such
            values = np.asarray(values, dtype=np.float64)
        for row in np.flatnonzero(~np.isfinite(values))[:1]:
            what = f"'{values[row]}' is not a finite number"
            raise SamplesError(file, what, "Mend or remove the row", line=int(row) + 1, column=name)
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


def read_arrays(path: Path) -> Columns:
    """Columns of a .npy file with named fields, mapped into memory, or of an .npz file with one array per column.

    Raises SamplesError for anything else.
    """
    file = str(path)
    what = "this is not an array file of NumPy without Python objects, or it is damaged"
    with readable(file, what, "Write it with numpy.save or numpy.savez"):
        named = _members(path, file) if zipfile.is_zipfile(path) else _fields(path, file)
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    check_names((name for name, _ in named), file)
    for name, values in named:
        if values.ndim != 1:
            what = f"the column has the shape {values.shape}"[:80]
            raise SamplesError(file, what, "Give one number per row", column=name)
        if len(values) != len(named[0][1]):
            what = f"the columns hold {named[0][0]} {len(named[0][1])}, {name} {len(values)} rows"
            raise SamplesError(file, what, "Give all columns the same number of rows")
    if not named or not len(named[0][1]):
        raise SamplesError(file, "the columns hold no rows", "Give all columns the same number of rows")
    return columns_of_arrays(dict(named), file, digest)


@contextmanager
def readable(file: str, what: str, fix: str) -> Iterator[None]:
    """Say in a SamplesError what is wrong with a file that a library refuses, and leave the library's warnings out."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of styles, of how a header is written, and the like
            yield
    except FileNotFoundError:
        raise SamplesError(file, "there is no such file", "Check the path") from None
    except CasacalError:
        raise
    except Exception as error:  # whatever a damaged file makes of the library, it is the file that must change
        raise SamplesError(file, f"{what} ({type(error).__name__})", fix) from None


def _fields(path: Path, file: str) -> list[tuple[str, NDArray[Any]]]:
    """Fields of one array, in their order; the memory is that of the file."""
    array = np.lib.format.open_memmap(path, mode="r")
    if array.dtype.names is None:
        raise SamplesError(
            file, "the array has no named columns", "Give fields such as q1_deg, or an .npz with one array per column"
        )
    _check_size(array, path.stat().st_size - array.offset)
    return [(name, array[name]) for name in array.dtype.names]


def _members(path: Path, file: str) -> list[tuple[str, NDArray[Any]]]:
    """Arrays of an archive, in their order."""
    check_unpacked(path, file)
    named = []
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as stream:
                array = np.lib.format.read_array(stream, allow_pickle=False)
                _check_size(array, array.nbytes + len(stream.read()))  # at the end, the archive's checksum is looked at
            named.append((member.filename.removesuffix(".npy"), array))
    return named


def _check_size(array: NDArray[Any], size: int) -> None:
    """Raise ValueError unless an array is as large as what is kept of it; rows may not go without bytes."""
    if array.nbytes != size or not array.itemsize:
        raise ValueError("more or fewer rows than are said")


def check_unpacked(path: Path, file: str) -> None:
    """Raise SamplesError for an archive with too many members, or that unpacks to too much.

    Raises zipfile.BadZipFile, OSError or the like for what is no archive.
    """
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    size, most = sum(member.file_size for member in members), max(UNPACKED, GROWTH * path.stat().st_size)
    if len(members) > MOST_MEMBERS:
        what = f"the archive has {len(members)} members; at most {MOST_MEMBERS} are read"
        raise SamplesError(file, what, "Leave out what is not a sample")
    if size > most:
        what = f"the archive unpacks to {size >> 20} MB; at most {most >> 20} MB are read from one of its size"
        raise SamplesError(file, what, "Save the samples alone, or as CSV")


def pieces(path: Path) -> Iterator[bytes]:
    """All that an archive holds, piece by piece; a member ends where it was declared to."""
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as stream:
                while piece := stream.read(PIECE):
                    yield piece

"""Samples in array files of NumPy; whatever is wrong with one of them is said in a sentence."""

from __future__ import annotations

import hashlib
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.errors import CasacalError, SamplesError
from casacal.tables.archives import check_unpacked
from casacal.tables.columns import Columns, columns_of_arrays
from casacal.tables.grammar import check_names

ARRAYS = (".npy", ".npz")


def read_arrays(path: Path) -> Columns:
    """Columns of a .npy file with named fields, mapped into memory, or of an .npz file with one array per column.

    Raises SamplesError for anything else.
    """
    file = str(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what NumPy thinks of how a header is written
            named = _members(path, file) if zipfile.is_zipfile(path) else _fields(path, file)
        digest = _digest(path)
    except FileNotFoundError:
        raise SamplesError(file, "there is no such file", "Check the path") from None
    except CasacalError:
        raise
    except Exception as error:  # whatever a damaged file makes of the library, it is the file that must change
        raise SamplesError(
            file,
            f"this is not an array file of NumPy without Python objects, or it is damaged ({type(error).__name__})",
            "Write it with numpy.save or numpy.savez",
        ) from None
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


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""One door for rows: whatever form their file has, or a DataFrame of pandas, what comes out are named columns."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from casacal.files import recover
from casacal.tables.arrays import ARRAYS, columns_of_arrays, digest_of, read_arrays
from casacal.tables.columns import Columns
from casacal.tables.text import Table, read_table
from casacal.tables.workbooks import WORKBOOKS, read_workbook


def read_columns(path: str | Path) -> Columns:
    """Columns of a file: .npy with named fields, .npz with one array per column, .xlsx, or else delimited text.

    Text of a million rows takes some ten seconds and a gigabyte; arrays take neither. Raises SamplesError that names
    file, line, column, what is wrong and the fix.
    """
    path = Path(path)
    recover(path.parent)
    kind = path.suffix.lower()
    if kind in ARRAYS:
        return read_arrays(path)
    return read_workbook(path).columns if kind in WORKBOOKS else read_table(path).columns


def read_any_table(path: str | Path) -> Table:
    """The cells of a workbook's first sheet, or of delimited text; raises SamplesError."""
    return read_workbook(path) if Path(path).suffix.lower() in WORKBOOKS else read_table(path)


def is_frame(value: Any) -> bool:
    """Whether a value is a pandas DataFrame, without importing pandas for those who have none."""
    return type(value).__name__ == "DataFrame" and hasattr(value, "itertuples")


def columns_of_frame(frame: Any, numbers: Sequence[str], labels: Sequence[str], source: str = "DataFrame") -> Columns:
    """Columns of a frame: straight from its arrays where the named columns hold numbers, else cell by cell.

    "line" is the row of the frame, counted from 1.
    """
    header = tuple(str(name) for name in frame.columns)
    if numbers and len(set(header)) == len(header) and all(frame[name].dtype.kind in "iuf" for name in numbers):
        used = {name: frame[name].to_numpy() for name in numbers}
        used |= {name: frame[name].to_numpy(dtype=str) for name in labels if name in header}
        return replace(columns_of_arrays(used, source, digest_of(used)), header=header)
    return table_of_frame(frame, source).columns


def table_of_frame(frame: Any, source: str = "DataFrame") -> Table:
    """The cells of a frame as text; "line" is then its row, counted from 1."""
    header = tuple(str(name) for name in frame.columns)
    rows = tuple(tuple(_cell(value) for value in row) for row in frame.itertuples(index=False, name=None))
    digest = hashlib.sha256(repr((header, rows)).encode()).hexdigest()
    return Table(source, digest, header, 0, rows, tuple(range(1, len(rows) + 1)), decimal_comma=False)


def _cell(value: Any) -> str:
    return repr(float(value)) if isinstance(value, (float, np.floating)) else str(value).strip()

"""One door for files of rows: whatever form they have, what comes out are named columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from casacal.tables.arrays import ARRAYS, read_arrays
from casacal.tables.columns import Columns
from casacal.tables.large_csv import read_large_csv
from casacal.tables.text import Table, read_table
from casacal.tables.workbooks import WORKBOOKS, read_workbook


def read_columns(
    path: str | Path, numbers: Callable[[Sequence[str]], Sequence[str]], labels: Sequence[str] = ()
) -> Columns:
    """Columns of a file: .npy with named fields, .npz with one array per column, .xlsx, or else delimited text.

    Args:
        path: of the file.
        numbers: which columns of a header must be numbers; a large text file is read fast where these are plain.
        labels: columns of text that are wanted.

    Raises SamplesError that names file, line, column, what is wrong and the fix.

    """
    kind = Path(path).suffix.lower()
    if kind in ARRAYS:
        return read_arrays(Path(path))
    if kind in WORKBOOKS:
        return read_workbook(path).columns
    large = read_large_csv(Path(path), numbers, labels)
    return read_table(path).columns if large is None else large


def read_any_table(path: str | Path) -> Table:
    """The cells of a workbook's first sheet, or of delimited text; raises SamplesError."""
    return read_workbook(path) if Path(path).suffix.lower() in WORKBOOKS else read_table(path)

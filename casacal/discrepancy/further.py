"""Columns of a file that effects ask for beside those of the instrument: torques, ways of approach, a payload."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.samples.samples import Samples

NOT_KEPT = "Give it in a text file: of frames, arrays and large files no further columns are kept"


def check_columns_of(columns: Sequence[str], joints: int, what: str) -> None:
    """Raise ProblemError unless there is a column for each joint."""
    if len(columns) != joints:
        raise ProblemError(f"Got {len(columns)} columns of {what} for {joints} joints", "Name one for each")


def read_columns_of(samples: Samples, columns: Sequence[str], joints: int, what: str, fix: str) -> Array:
    """Numbers (N, n) of some columns that samples have beside those of their instrument, one for each joint.

    Raises ProblemError where one is missing, or holds no numbers; `fix` says which to give.
    """
    check_columns_of(columns, joints, what)
    found = []
    for column in columns:
        if column not in samples.extra:
            known = ", ".join(samples.extra)
            fix = f"Give it; further columns there are: {known}" if known else NOT_KEPT
            raise ProblemError(f"{samples.file} has no column '{column}' of {what}", fix)
        try:
            values = np.array([float(text) for text in samples.extra[column]])
        except ValueError:
            values = np.array([np.nan])
        if not np.isfinite(values).all():
            raise ProblemError(f"{samples.file}: the column '{column}' holds no {what}", f"Give {fix}")
        found.append(values)
    return np.column_stack(found)

"""Columns of a file that effects ask for beside those of the instrument: torques, ways of approach, a payload."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.samples.samples import Samples

NOT_KEPT = "Give it in a text file: of frames, arrays and large files no further columns are kept"


LOAD = 5.0  # kilograms of payload that are expected to pull about as much as all of the arm's own links
MASS = "payload"  # column of a row model


def check_payload(column: object) -> None:
    """Raise ProblemError unless this is the name of a column, or empty."""
    if not isinstance(column, str):
        raise ProblemError(f"Got {column!r} as the payload", "Name the column that holds it, such as 'payload_kg'")


def read_payload(samples: Samples, column: str) -> dict[str, Array]:
    """The payload (N,) of each row, kg, by its name in a row model; raises ProblemError where a row has none."""
    kilograms = read_columns_of(samples, (column,), 1, "payload", "kilograms")[:, 0]
    if (kilograms < 0).any():
        line = samples.lines[int(np.flatnonzero(kilograms < 0)[0])]
        raise ProblemError(f"{samples.file}, line {line}: a payload is below zero", "Give kilograms, 0 for none")
    return {MASS: kilograms}


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

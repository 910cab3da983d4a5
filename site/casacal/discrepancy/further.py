"""Columns of a file that effects ask for beside those of the instrument: torques, ways of approach, a payload."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.discrepancy.effect import Effect, Site
from casacal.errors import ProblemError
from casacal.samples.samples import Samples

NOT_KEPT = "Add it to the file; of frames, arrays and large files no further columns are kept"


LOAD = 5.0  # kilograms of payload that are expected to pull about as much as all of the arm's own links
MASS = "payload"  # column of a row model


@dataclass(frozen=True, kw_only=True)
class Loaded(Effect):
    """An effect of weights, to which a payload adds; a column of the samples may say it, kg per row."""

    payload: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.payload, str):
            fix = "Name the column that holds it, such as 'payload_kg'"
            raise ProblemError(f"Got {self.payload!r} as the payload", fix)

    @property
    def further(self) -> tuple[str, ...]:
        """The column of the payload, if there is one."""
        return (self.payload,) if self.payload else ()

    def columns(self, site: Site) -> tuple[str, ...]:
        """The payload, where a column says it."""
        del site
        return (MASS,) if self.payload else ()

    def told(self, site: Site, samples: Samples) -> Mapping[str, Array]:
        """As the rows say (N,), kg; raises ProblemError where they do not."""
        del site
        if not self.payload:
            return {}
        kilograms = read_columns_of(samples, (self.payload,), 1, "payload", "kilograms")[:, 0]
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

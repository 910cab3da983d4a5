"""Columns of a file that effects ask for beside those of the instrument: torques, ways of approach, a payload."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array, Rows
from casacal.discrepancy.effect import Effect, Site
from casacal.errors import ProblemError, SamplesError
from casacal.samples.samples import Samples
from casacal.tables.text import finite_numbers
from casacal.wording import listed

LARGEST_PAYLOAD = 10_000.0  # kg; beyond it a value is absurd whatever the arm
DOWN = (0.0, 0.0, -1.0)  # gravity in the base frame of an arm that stands
LOAD = 5.0  # kilograms of payload that are expected to pull about as much as all of the arm's own links
MASS = "payload"  # column of a row model


@dataclass(frozen=True, kw_only=True)
class Loaded(Effect):
    """An effect of weights, to which a payload adds; a column of the samples may say it, kg per row.

    size: by how much the flange sags, mm. down: direction of gravity in the base frame.
    """

    payload: str = ""
    size: float = 0.15
    doubt: float = 2.5
    down: tuple[float, float, float] = DOWN

    moves = True
    elastic = True
    unit = "mm"
    key = "give"

    def __post_init__(self) -> None:
        if not isinstance(self.payload, str):
            fix = "Name the column that holds it, such as 'payload_kg'"
            raise ProblemError(f"Got {self.payload!r} as the payload", fix)
        given = np.asarray(self.down)
        if given.shape != (3,) or given.dtype.kind not in "if" or not 0 < np.linalg.norm(given) < np.inf:
            raise ProblemError(f"Gravity points along {self.down!r}", "Give three numbers, such as down=(0, 0, -1)")
        object.__setattr__(self, "down", tuple((given / np.linalg.norm(given)).tolist()))

    @property
    def further(self) -> tuple[str, ...]:
        """The column of the payload, if there is one."""
        return (self.payload,) if self.payload else ()

    def columns(self, site: Site) -> tuple[str, ...]:
        """The payload, where a column says it."""
        del site
        return (MASS,) if self.payload else ()

    def told(self, site: Site, samples: Samples) -> Mapping[str, Array]:
        """As the rows say (N,), kg; raises ProblemError, SamplesError where they do not."""
        del site
        if not self.payload:
            return {}
        kilograms = read_columns_of(samples, (self.payload,), 1, "payload")
        said = f"is no payload from 0 to {LARGEST_PAYLOAD:,.0f} kg"
        fix = "Give kilograms, 0 for none"
        refuse_unless((kilograms >= 0) & (kilograms <= LARGEST_PAYLOAD), samples, (self.payload,), kilograms, said, fix)
        return {MASS: kilograms[:, 0]}


class ByColumns(Effect, ABC):
    """An effect of which a column of the samples for each joint says something."""

    columns_of: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns_of", tuple(self.columns_of))

    @property
    def further(self) -> tuple[str, ...]:
        """These columns."""
        return self.columns_of


def check_columns_of(columns: Sequence[str], joints: int, what: str) -> None:
    """Raise ProblemError unless there is a column for each joint."""
    if len(columns) != joints:
        raise ProblemError(f"Got {len(columns)} columns of {what} for {joints} joints", "Name one for each")


def read_columns_of(samples: Samples, columns: Sequence[str], joints: int, what: str) -> Array:
    """Numbers (N, n) of some columns that samples have beside those of their instrument, one for each joint.

    Raises ProblemError where one is missing, SamplesError for a cell that is no number.
    """
    check_columns_of(columns, joints, what)
    if missing := [column for column in columns if column not in samples.extra]:
        known = ", ".join(samples.extra)
        others = f", nor {listed(missing[1:])}" if missing[1:] else ""
        fix = f"Give it; further columns there are: {known}" if known else "Add it, and read the rows with this problem"
        raise ProblemError(f"{samples.file} has no column '{missing[0]}' of {what}{others}", fix)
    return np.column_stack([_numbers(samples, column) for column in columns])


def _numbers(samples: Samples, column: str) -> Array:
    """A further column (N,), which samples of another problem hold as text."""
    cells = samples.extra[column]
    if isinstance(cells, np.ndarray):
        return cells
    return np.array(finite_numbers(samples.file, column, cells, samples.lines))


def refuse_unless(good: Rows, samples: Samples, columns: Sequence[str], values: Array, what: str, fix: str) -> None:
    """Raise SamplesError for the first of some values (N, n) of columns that is not good (N, n)."""
    for row, j in np.argwhere(~good)[:1]:
        said, line = f"{values[row, j]:g} {what}", int(samples.lines[row])
        raise SamplesError(samples.file, said, fix, line=line, column=columns[j])

"""Which columns a samples file has: quantities with their units, joints and labels."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.errors import SamplesError
from casacal.instruments.description import Dimension
from casacal.tables.columns import Columns, Labels
from casacal.tables.grammar import UNSHOWN

UNITS: Mapping[Dimension, Mapping[str, float]] = {
    "angle": {"deg": math.pi / 180, "rad": 1.0},
    "length": {"mm": 1.0, "um": 1e-3, "in": 25.4},
    "number": {"": 1.0},
}
"""Suffixes a column may carry, with their factor to rad or mm."""

ALSO_CALLED = {"plane": ("face", "faces", "surface", "side", "wall", "plate", "plane_id", "plane_name", "label")}
"""What people call a column of labels, by its name: such a column is asked about, never overlooked."""

LARGEST = {"angle": 20 * math.pi, "length": 1e5, "number": math.inf}
"""Beyond ten turns or a hundred metres a value is absurd whatever the robot."""


@dataclass(frozen=True)
class Layout:
    """Which columns a file must have: what a problem asks of its samples."""

    joints: tuple[Dimension, ...]
    columns: Mapping[str, Dimension]
    labels: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def quantities(self) -> dict[str, Dimension]:
        """Name to dimension of all numeric columns, joints first."""
        joints: dict[str, Dimension] = {f"q{i + 1}": dimension for i, dimension in enumerate(self.joints)}
        return joints | dict(self.columns)


def numeric_columns(header: Sequence[str], layout: Layout) -> list[str]:
    """The columns of a header that hold the layout's quantities; none unless there is exactly one for each."""
    spellings = [
        {f"{name}_{unit}" if unit else name for unit in UNITS[kind]} for name, kind in layout.quantities.items()
    ]
    found = [[name for name in header if name in each] for each in spellings]
    return [each[0] for each in found] if all(len(each) == 1 for each in found) else []


def match_columns(table: Columns, layout: Layout) -> dict[str, tuple[str, float]]:
    """Find the column and the factor to mm or rad of each quantity.

    Raises SamplesError for a quantity that is missing, without unit, given twice, or refused by the instrument.
    """

    def refuse(what: str, fix: str, column: str | None = None) -> SamplesError:
        return SamplesError(table.file, what, fix, line=table.header_line or None, column=column)

    for name, reason in layout.refused.items():
        for column in table.header:
            if re.fullmatch(rf"{name}(_\w+)?", column):
                raise refuse(
                    f"the file has this column but {reason}", "Change the problem, or remove the column", column
                )
    for column in table.header:
        number = re.fullmatch(r"q(\d+)(_\w+)?", column)
        if number and not 1 <= int(number[1]) <= len(layout.joints):
            raise refuse(f"the robot has {len(layout.joints)} joints", "Use the file of this robot", column)
    taken = {f"{name}_{unit}" for name, kind in layout.quantities.items() for unit in UNITS[kind]} | {*layout.labels}
    return {name: _find(table, name, dimension, taken, refuse) for name, dimension in layout.quantities.items()}


def _find(table: Columns, name: str, dimension: Dimension, taken: set[str], refuse: Any) -> tuple[str, float]:
    spellings = {f"{name}_{unit}" if unit else name: factor for unit, factor in UNITS[dimension].items()}
    present = [column for column in table.header if column in spellings]
    wanted = " or ".join(spellings)
    if len(present) > 1:
        raise refuse(f"'{present[0]}' and '{present[1]}' both give {name}", "Keep one of the two", present[1])
    if present:
        return present[0], spellings[present[0]]
    if name in table.header:
        raise refuse(f"the column has no unit (for {name}: {wanted})", "Add the unit to its name", name)
    wrong = [column for column in table.header if column.startswith(f"{name}_")]
    if wrong:
        raise refuse(f"the column does not carry a unit known for {name}", f"Call it {wanted}", wrong[0])
    alike = [column for column in table.header if column.lower() in {key.lower() for key in spellings}]
    if not alike:  # among what is nothing else
        free = [column for column in table.header if column not in taken]
        alike = get_close_matches(next(iter(spellings)), free, n=1, cutoff=0.75)
    seen = f"(did you mean '{alike[0]}'?)" if alike else "among " + ", ".join(table.header[:20])
    fix = f"Call it {wanted}" if alike else f"Add {wanted}"
    raise refuse(f"there is no column for {name} {seen}", fix, alike[0] if alike else None)


class Quantities:
    """What a layout asks of columns; raises SamplesError where a column is missing, without unit, or refused.

    absurd: whether values pass that no robot has, for those who look for their cause.
    """

    def __init__(self, columns: Columns, layout: Layout, *, absurd: bool = False) -> None:
        self._columns, self._layout, self._absurd = columns, layout, absurd
        self._found = match_columns(columns, layout)

    def joints(self) -> Array:
        """Joint values (N, n), read-only: rad, mm; column by column in memory, as they come and as they go."""
        joints = np.empty((len(self._layout.joints), len(self._columns.lines))).T
        for i in range(len(self._layout.joints)):
            self._fill(f"q{i + 1}", joints[:, i])
        joints.setflags(write=False)
        return joints

    def columns(self) -> dict[str, Array]:
        """The instrument's columns, each (N,), read-only: mm, rad or the user's unit."""
        return {name: self._fill(name, np.empty(len(self._columns.lines))) for name in self._layout.columns}

    def labels(self) -> dict[str, Labels]:
        """Labels of each row; where the rows have none, one for all that is called as its column."""
        return {name: self._labels(name) for name in self._layout.labels}

    def rest(self) -> dict[str, tuple[str, ...]]:
        """Further columns as text, where the rows were read as text."""
        used = {column for column, _ in self._found.values()} | set(self._layout.labels)
        return {name: text for name, text in self._columns.texts().items() if name not in used}

    def _fill(self, name: str, place: Array) -> Array:
        column, factor = self._found[name]
        np.multiply(self._columns.number(column), factor, out=place)
        largest = math.inf if self._absurd else LARGEST[self._layout.quantities[name]]
        if not math.isinf(largest) and len(place) and max(place.max(), -place.min()) > largest:
            row = int(np.flatnonzero(np.abs(place) > largest)[0])
            limit = "100 m" if largest == LARGEST["length"] else "10 turns"
            raise self._refusal(
                row,
                column,
                f"{self._columns.cell(column, row)} is absurd (beyond {limit})",
                "Check the value and the unit in the column's name",
            )
        place.setflags(write=False)
        return place

    def _labels(self, name: str) -> Labels:
        if name not in self._columns.header:
            alike = get_close_matches(name, [column.lower() for column in self._columns.header], n=1, cutoff=0.8)
            for column in self._columns.header:
                if column.lower() in (*alike, *ALSO_CALLED.get(name, ())):
                    raise SamplesError(
                        self._columns.file,
                        f"there is no column '{name}' of labels (did you mean '{column}'?)",
                        f"Call it {name}, or something else if it holds no labels",
                        line=self._columns.header_line or None,
                        column=column,
                    )
            return Labels((name,), np.zeros(len(self._columns.lines), dtype=np.int32))
        labels = self._columns.text(name)
        if "" in labels.names:
            row = int(np.flatnonzero(labels.codes == labels.names.index(""))[0])
            raise self._refusal(row, name, "the label is empty", "Give the row its label")
        for name_of_row in filter(UNSHOWN.search, labels.names):
            row = int(np.flatnonzero(labels.codes == labels.names.index(name_of_row))[0])
            raise self._refusal(row, name, "the label holds a line break or control characters", "Write it plainly")
        return labels

    def _refusal(self, row: int, column: str, what: str, fix: str) -> SamplesError:
        return SamplesError(self._columns.file, what, fix, line=self._columns.lines[row], column=column)

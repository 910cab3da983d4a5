"""From columns as they were read to quantities in millimetres and radians, and labels: each checked as it is taken."""

from __future__ import annotations

import math
from difflib import get_close_matches

import numpy as np

from casacal.array_types import Array
from casacal.errors import SamplesError
from casacal.samples.layout import ALSO_CALLED, LARGEST, Layout, match_columns
from casacal.tables.columns import Columns, Labels
from casacal.tables.grammar import UNSHOWN


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

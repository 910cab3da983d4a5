"""Which columns a samples file has: quantities with their units, joints and labels."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches

import numpy as np

from casacal.array_types import Array
from casacal.errors import SamplesError
from casacal.instruments.description import Dimension
from casacal.tables.columns import Columns, Labels
from casacal.tables.grammar import UNSHOWN
from casacal.values import read_only

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
    """Which columns a file must have: what a problem asks of its samples.

    further: columns of numbers that tell its effects, under these very names; a file may lack them.
    """

    joints: tuple[Dimension, ...]
    columns: Mapping[str, Dimension]
    labels: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)
    further: tuple[str, ...] = ()

    @property
    def quantities(self) -> dict[str, Dimension]:
        """Name to dimension of all numeric columns, joints first."""
        joints: dict[str, Dimension] = {f"q{i + 1}": dimension for i, dimension in enumerate(self.joints)}
        return joints | dict(self.columns)


def _spellings(name: str, kind: Dimension) -> dict[str, float]:
    """Names that a column may have, and the factor to rad or mm that each stands for."""
    return {f"{name}_{unit}" if unit else name: factor for unit, factor in UNITS[kind].items()}


def numeric_columns(header: Sequence[str], layout: Layout) -> list[str]:
    """The columns of a header to read as numbers; none unless there is exactly one for each quantity of the layout."""
    asked = [_spellings(name, kind) for name, kind in layout.quantities.items()]
    found = [[name for name in header if name in each] for each in asked]
    if not all(len(each) == 1 for each in found):
        return []
    return [each[0] for each in found] + [name for name in header if name in layout.further]


def _taken(layout: Layout) -> set[str]:
    """All names that a layout knows columns by."""
    quantities = (each for name, kind in layout.quantities.items() for each in _spellings(name, kind))
    return {*layout.labels, *layout.further, *quantities}


def _nearly(spellings: Sequence[str], header: Sequence[str], taken: Collection[str]) -> str | None:
    """The column of a header that is nearly called like one of some spellings, among those that are nothing else."""
    lower = {spelling.lower() for spelling in spellings}
    alike = [column for column in header if column.lower() in lower]
    if not alike:
        alike = get_close_matches(spellings[0], [column for column in header if column not in taken], 1, cutoff=0.75)
    return alike[0] if alike else None


def match_columns(table: Columns, layout: Layout) -> dict[str, tuple[str, float]]:
    """The column and the factor to mm or rad of each quantity."""

    def refuse(what: str, fix: str, column: str | None = None) -> SamplesError:
        return SamplesError(table.file, what, fix, line=table.header_line or None, column=column)

    for name, reason in layout.refused.items():
        for column in table.header:
            if re.fullmatch(rf"{name}(_\w+)?", column):
                fix = "Change the problem, or remove the column"
                raise refuse(f"the file has this column but {reason}", fix, column)
    for column in table.header:
        number = re.fullmatch(r"q(\d+)(_\w+)?", column)
        if number and not 1 <= int(number[1]) <= len(layout.joints):
            raise refuse(f"the robot has {len(layout.joints)} joints", "Use the file of this robot", column)
    taken = _taken(layout)
    found = {}
    for name, kind in layout.quantities.items():
        spellings = _spellings(name, kind)
        present = [column for column in table.header if column in spellings]
        wanted = " or ".join(spellings)
        if len(present) > 1:
            raise refuse(f"'{present[0]}' and '{present[1]}' both give {name}", "Keep one of the two", present[1])
        if present:
            found[name] = present[0], spellings[present[0]]
            continue
        if name in table.header:
            raise refuse(f"the column has no unit (for {name}: {wanted})", "Add the unit to its name", name)
        wrong = [column for column in table.header if column.startswith(f"{name}_")]
        if wrong:
            raise refuse(f"the column does not carry a unit known for {name}", f"Call it {wanted}", wrong[0])
        alike = _nearly(tuple(spellings), table.header, taken)
        seen = f"(did you mean '{alike}'?)" if alike else "among " + ", ".join(table.header[:20])
        raise refuse(f"there is no column for {name} {seen}", f"{'Call it' if alike else 'Add'} {wanted}", alike)
    return found


def read_further(table: Columns, layout: Layout) -> dict[str, Array]:
    """Numbers (N,) of those of the layout's further columns that there are, read-only.

    Raises SamplesError where one is absent and another is nearly called so, and for a cell that is no number.
    """
    taken = _taken(layout)
    for name in layout.further:
        alike = None if name in table.header else _nearly((name,), table.header, taken)
        if alike is not None:
            what = f"there is no column '{name}' (did you mean '{alike}'?)"
            fix = f"Call it {name}, or something else if it is another thing"
            raise SamplesError(table.file, what, fix, line=table.header_line or None, column=alike)
    return {name: read_only(table.number(name)) for name in layout.further if name in table.header}


def read_quantities(
    table: Columns, layout: Layout, *, absurd: bool
) -> tuple[Array, dict[str, Array], dict[str, Labels], dict[str, Array | tuple[str, ...]]]:
    """What a layout asks of columns, read-only, in mm and rad: joint values (N, n), the instrument's columns, labels.

    There is one label for all rows, called as its column, where they have none. Last come the layout's further
    columns and, as text where rows were read as text, those that were not asked for. absurd: whether values pass that
    no robot has, for those who look for their cause. Raises SamplesError where a column is missing, without unit,
    given twice or refused, or holds what it may not.
    """
    found = match_columns(table, layout)

    def fill(name: str, place: Array) -> Array:
        column, factor = found[name]
        np.multiply(table.number(column), factor, out=place)
        largest = math.inf if absurd else LARGEST[layout.quantities[name]]
        if not math.isinf(largest) and len(place) and max(place.max(), -place.min()) > largest:
            row = int(np.flatnonzero(np.abs(place) > largest)[0])
            limit = "100 m" if largest == LARGEST["length"] else "10 turns"
            what = f"{table.cell(column, row)} is absurd (beyond {limit})"
            fix = "Check the value and the unit in the column's name"
            raise SamplesError(table.file, what, fix, line=table.lines[row], column=column)
        place.setflags(write=False)
        return place

    count = len(table.lines)
    joints = np.empty((len(layout.joints), count)).T  # column by column in memory, as they come and as they go
    for i in range(len(layout.joints)):
        fill(f"q{i + 1}", joints[:, i])
    joints.setflags(write=False)
    columns = {name: fill(name, np.empty(count)) for name in layout.columns}
    labels = {name: _labels(table, name) for name in layout.labels}
    used = {column for column, _ in found.values()} | set(layout.labels)
    texts = {name: text for name, text in table.texts().items() if name not in used}
    return joints, columns, labels, {**texts, **read_further(table, layout)}


def _labels(table: Columns, name: str) -> Labels:
    if name not in table.header:
        alike = get_close_matches(name, [column.lower() for column in table.header], n=1, cutoff=0.8)
        for column in table.header:
            if column.lower() in (*alike, *ALSO_CALLED.get(name, ())):
                what = f"there is no column '{name}' of labels (did you mean '{column}'?)"
                fix = f"Call it {name}, or something else if it holds no labels"
                raise SamplesError(table.file, what, fix, line=table.header_line or None, column=column)
        return Labels.alike(name, len(table.lines))
    labels = table.text(name)
    for label in sorted(labels.names, key=bool):  # an empty one first
        if not label or UNSHOWN.search(label):
            row = int(np.flatnonzero(labels.codes == labels.names.index(label))[0])
            what = "the label holds a line break or control characters" if label else "the label is empty"
            fix = "Write it plainly" if label else "Give the row its label"
            raise SamplesError(table.file, what, fix, line=table.lines[row], column=name)
    return labels

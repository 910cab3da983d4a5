"""Samples: validated, read-only rows of joint values and readings, in millimetres and radians."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.errors import SamplesError
from casacal.instruments.instrument import Dimension
from casacal.tables import Table, read_table
from casacal.unknowns.unknown import Array

UNITS: Mapping[Dimension, Mapping[str, float]] = {
    "angle": {"deg": math.pi / 180, "rad": 1.0},
    "length": {"mm": 1.0, "um": 1e-3, "in": 25.4},
    "number": {"": 1.0},
}
"""Suffixes a column may carry, with their factor to rad or mm."""

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


@dataclass(frozen=True)
class Samples:
    """Rows of measurements.

    joints: (N, n), rad or mm. columns: the instrument's own, each (N,), mm or rad. labels: label columns, each (N,) of
    str. lines: line of each row in its file (N,). extra: further columns, kept as text. All arrays are read-only.
    """

    joints: Array
    columns: Mapping[str, Array]
    labels: Mapping[str, tuple[str, ...]]
    lines: tuple[int, ...]
    extra: Mapping[str, tuple[str, ...]]
    file: str
    sha256: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", _frozen(self.joints))
        columns = {name: _frozen(values) for name, values in self.columns.items()}
        object.__setattr__(self, "columns", MappingProxyType(columns))
        object.__setattr__(self, "labels", MappingProxyType(dict(self.labels)))
        object.__setattr__(self, "extra", MappingProxyType(dict(self.extra)))

    def __len__(self) -> int:
        return len(self.joints)

    def take(self, rows: Sequence[int] | NDArray[np.intp]) -> Samples:
        """Return the given rows, in the given order, with the same provenance."""
        index = np.asarray(rows, dtype=np.intp)
        return Samples(
            self.joints[index],
            {name: values[index] for name, values in self.columns.items()},
            {name: tuple(values[i] for i in index) for name, values in self.labels.items()},
            tuple(self.lines[i] for i in index),
            {name: tuple(values[i] for i in index) for name, values in self.extra.items()},
            self.file,
            self.sha256,
        )

    @staticmethod
    def from_csv(path: str | Path, layout: Layout, *, absurd: bool = False) -> Samples:
        """Read a samples file; `absurd` lets values pass that no robot has, for those who look for their cause.

        Raises SamplesError that names file, line, column, what is wrong and the fix.
        """
        return Samples.from_table(read_table(path), layout, absurd=absurd)

    @staticmethod
    def from_frame(frame: Any, layout: Layout, *, source: str = "DataFrame") -> Samples:
        """Samples from a pandas DataFrame with the columns of a samples file.

        Raises SamplesError as `from_csv` does; "line" is then the row of the frame, counted from 1.
        """
        header = tuple(str(name) for name in frame.columns)
        rows = tuple(tuple(_cell(value) for value in row) for row in frame.itertuples(index=False, name=None))
        digest = hashlib.sha256(repr((header, rows)).encode()).hexdigest()
        table = Table(source, digest, header, 0, rows, tuple(range(1, len(rows) + 1)), decimal_comma=False)
        return Samples.from_table(table, layout)

    @staticmethod
    def from_table(table: Table, layout: Layout, *, absurd: bool = False) -> Samples:
        """Samples from the text cells of a table; raises SamplesError."""
        found = match_columns(table, layout)
        values = {
            name: _quantity(table, column, factor, math.inf if absurd else LARGEST[layout.quantities[name]])
            for name, (column, factor) in found.items()
        }
        joint_names = [f"q{i + 1}" for i in range(len(layout.joints))]
        labels = {name: _labels(table, name) for name in layout.labels}
        used = {column for column, _ in found.values()} | set(layout.labels)
        return Samples(
            np.column_stack([values[name] for name in joint_names]),
            {name: values[name] for name in layout.columns},
            labels,
            table.lines,
            {name: tuple(table.column(name)) for name in table.header if name not in used},
            table.file,
            table.sha256,
        )


def match_columns(table: Table, layout: Layout) -> dict[str, tuple[str, float]]:
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
    return {name: _find(table, name, dimension, refuse) for name, dimension in layout.quantities.items()}


def _find(table: Table, name: str, dimension: Dimension, refuse: Any) -> tuple[str, float]:
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
        raise refuse(f"the column does not carry a unit known for {name}", f"Name it {wanted}", wrong[0])
    alike = [column for column in table.header if column.lower() in {key.lower() for key in spellings}]
    seen = f"it is written '{alike[0]}'" if alike else "the columns are " + ", ".join(table.header[:20])
    raise refuse(f"there is no column for {name}: {seen}", f"Add {wanted}", None)


def _quantity(table: Table, column: str, factor: float, largest: float) -> Array:
    values = np.array(table.numbers(column)) * factor
    for i in np.flatnonzero(np.abs(values) > largest)[:1]:
        limit = "100 m" if largest == LARGEST["length"] else "10 turns"
        raise SamplesError(
            table.file,
            f"{table.column(column)[i]} is absurd (beyond {limit})",
            "Check the value and the unit in the column's name",
            line=table.lines[i],
            column=column,
        )
    return values


def _labels(table: Table, name: str) -> tuple[str, ...]:
    if name not in table.header:
        return (name,) * len(table.rows)
    cells = table.column(name)
    for cell, line in zip(cells, table.lines, strict=True):
        if not cell:
            raise SamplesError(table.file, "the label is empty", "Give the row its label", line=line, column=name)
    return tuple(cells)


def _cell(value: Any) -> str:
    return repr(float(value)) if isinstance(value, (float, np.floating)) else str(value).strip()


def _frozen(values: Array) -> Array:
    """The values as a read-only array of its own; one that is read-only already is kept."""
    if values.flags.writeable or not values.flags.c_contiguous:
        values = np.array(values, order="C")
        values.setflags(write=False)
    return values


def joined(first: Samples, second: Samples) -> Samples:
    """Rows of two sets after each other, with the provenance of the first."""
    labels = {name: (*first.labels[name], *second.labels.get(name, (name,) * len(second))) for name in first.labels}
    return Samples(
        np.vstack([first.joints, second.joints]),
        {k: np.concatenate([v, second.columns[k]]) for k, v in first.columns.items()},
        labels,
        (*first.lines, *second.lines),
        {},
        first.file,
        first.sha256,
    )


def ordered_labels(labels: Iterable[str]) -> tuple[str, ...]:
    """Different labels, in order of first appearance."""
    return tuple(dict.fromkeys(labels))

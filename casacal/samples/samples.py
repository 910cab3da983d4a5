"""Samples: validated, read-only rows of joint values and readings, in millimetres and radians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from casacal.array_types import Array, Index
from casacal.errors import SamplesError
from casacal.samples.layout import Layout, numeric_columns, read_quantities
from casacal.tables.arrays import columns_of_arrays, digest_of
from casacal.tables.columns import MANY_ROWS, Columns, Labels
from casacal.tables.read import columns_of_frame, read_columns
from casacal.tables.text import Table
from casacal.values import FrozenMapping, Value, read_only, short
from casacal.wording import html_table

SHOWN = 10  # rows that a notebook shows


@dataclass(frozen=True, eq=False)
class Samples(Value):
    """Rows of measurements.

    joints: (N, n), rad or mm. columns: the instrument's own, each (N,), mm or rad. labels: label columns, each (N,) of
    str. lines: line of each row in its file (N,). extra: further columns, numbers (N,) where an effect asks for them;
    others as text, those of large files and of arrays are left where they are. All arrays are read-only.
    """

    joints: Array
    columns: Mapping[str, Array]
    labels: Mapping[str, Labels]
    lines: Sequence[int]
    extra: Mapping[str, Array | tuple[str, ...]]
    file: str
    sha256: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", read_only(self.joints))
        columns, labels = self.columns.items(), self.labels.items()
        object.__setattr__(self, "columns", FrozenMapping({name: read_only(values) for name, values in columns}))
        object.__setattr__(self, "labels", FrozenMapping({name: Labels.of(values) for name, values in labels}))
        extra = {k: read_only(each) if isinstance(each, np.ndarray) else each for k, each in self.extra.items()}
        object.__setattr__(self, "extra", FrozenMapping(extra))

    def __len__(self) -> int:
        return len(self.joints)

    def faces(self, column: str | None = "plane") -> Labels:
        """Labels of the rows in one column, or where they have none, one label for all: "plane"."""
        if column is not None and column in self.labels:
            return self.labels[column]
        return Labels.alike("plane", len(self))

    def __repr__(self) -> str:
        read = [*self.columns, *self.labels]
        beside = f", {short(read)}" if read else ""
        return f"<{len(self)} samples of {self.file}: {self.joints.shape[1]} joints{beside}>"

    def _repr_html_(self) -> str:
        """The first rows, rad and mm: what a notebook shows."""
        header = ["line", *(f"q{j + 1}" for j in range(self.joints.shape[1])), *self.columns, *self.labels]
        rows = (
            [self.lines[i], *(f"{value:.5g}" for value in (*self.joints[i], *(v[i] for v in self.columns.values()))),
             *(labels[i] for labels in self.labels.values())]
            for i in range(min(len(self), SHOWN))
        )  # fmt: skip
        return html_table(repr(self), header, rows)

    def take(self, rows: Sequence[int] | Index) -> Samples:
        """Return the given rows, in the given order, with the same provenance."""
        index = np.asarray(rows, dtype=np.intp)
        return Samples(
            self.joints[index],
            {name: values[index] for name, values in self.columns.items()},
            {name: values.take(index) for name, values in self.labels.items()},
            _lines(self.lines, index),
            taken_from(self.extra, index),
            self.file,
            self.sha256,
        )

    @staticmethod
    def of_joints(joints: Array) -> Samples:
        """Rows of joint values (N, n; rad, mm) alone."""
        return Samples(joints, {}, {}, tuple(range(1, len(joints) + 1)), {}, "joint values", "")

    def check(self, layout: Layout) -> None:
        """Raise SamplesError unless these rows have the joints, columns and labels that a problem asks for."""
        if self.joints.ndim != 2 or self.joints.shape[1] != len(layout.joints):
            what = f"the joint values have the shape {self.joints.shape}"
            raise SamplesError(self.file, what, f"Give {len(layout.joints)} per row")
        for what, have, asked in (("column", self.columns, layout.columns), ("label", self.labels, layout.labels)):
            for name in asked:
                if name not in have:
                    known = short(list(have)) or "none"
                    raise SamplesError(self.file, f"the rows have no {what} '{name}'", f"Give it; they have: {known}")
        for name, reason in layout.refused.items():
            if name in self.columns:
                raise SamplesError(self.file, f"the rows have a column '{name}' but {reason}", "Leave it out")
        for name, values in {"q": self.joints, **self.columns}.items():
            if len(values) != len(self.joints) or not np.isfinite(values).all():
                what = f"'{name}' has {len(values)} rows of {len(self)}, or values that are not finite"
                raise SamplesError(self.file, what, "Give one finite number per row")

    @staticmethod
    def from_file(path: str | Path, layout: Layout, *, absurd: bool = False) -> Samples:
        """Read a samples file: .npy with named fields, .npz with one array per column, .xlsx, or else delimited text.

        `absurd` lets values pass that no robot has, for those who look for their cause.

        Raises SamplesError that names file, line, column, what is wrong and the fix.
        """
        columns = read_columns(path)
        return Samples.from_columns(columns, layout, absurd=absurd)

    @staticmethod
    def from_csv(path: str | Path, layout: Layout, *, absurd: bool = False) -> Samples:
        """The same, by the name of what most people have."""
        return Samples.from_file(path, layout, absurd=absurd)

    @staticmethod
    def from_frame(frame: Any, layout: Layout, *, source: str = "DataFrame") -> Samples:
        """Samples from a pandas DataFrame with the columns of a samples file; raises SamplesError."""
        numbers = numeric_columns([str(name) for name in frame.columns], layout)
        return Samples.from_columns(columns_of_frame(frame, numbers, layout.labels, source), layout)

    @staticmethod
    def from_arrays(arrays: Mapping[str, Any], layout: Layout, *, source: str = "arrays") -> Samples:
        """Samples from arrays (N,) by the column names of a samples file; raises SamplesError."""
        given = {str(name): np.asarray(values) for name, values in arrays.items()}
        given = {name: values.astype(str) if values.dtype == object else values for name, values in given.items()}
        shapes = {values.shape for values in given.values()}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1 or not next(iter(shapes))[0]:
            found = ", ".join(f"{name} {values.shape}" for name, values in given.items()) or "nothing"
            raise SamplesError(source, f"the arrays have the shapes {found}", "Give one value per row in each")
        return Samples.from_columns(columns_of_arrays(given, source, digest_of(given)), layout)

    @staticmethod
    def from_table(table: Table, layout: Layout, *, absurd: bool = False) -> Samples:
        """Samples from the cells of a table; raises SamplesError."""
        return Samples.from_columns(table.columns, layout, absurd=absurd)

    @staticmethod
    def from_columns(columns: Columns, layout: Layout, *, absurd: bool = False) -> Samples:
        """Samples from columns, which is what all of the above become; raises SamplesError."""
        if not len(columns.lines):
            raise SamplesError(columns.file, "there is no row", "Give one row per sample")
        joints, own, labels, further = read_quantities(columns, layout, absurd=absurd)
        return Samples(joints, own, labels, columns.lines, further, columns.file, columns.sha256)


def taken_from(extra: Mapping[str, Array | tuple[str, ...]], index: Index) -> dict[str, Array | tuple[str, ...]]:
    """Further columns of some rows."""
    return {
        name: values[index] if isinstance(values, np.ndarray) else tuple(values[i] for i in index.tolist())
        for name, values in extra.items()
    }


def _lines(lines: Sequence[int], index: Index) -> Sequence[int]:
    """Lines of some rows: a tuple of few, an array of many."""
    if len(index) < MANY_ROWS:
        return tuple(int(lines[k]) for k in index.tolist())
    known = np.arange(lines.start, lines.stop, lines.step) if isinstance(lines, range) else np.asarray(lines)
    return cast(Sequence[int], known[index])


def joined(first: Samples, second: Samples) -> Samples:
    """Rows of two sets after each other, with the provenance of the first."""
    return Samples(
        np.vstack([first.joints, second.joints]),
        {name: np.concatenate([values, second.columns[name]]) for name, values in first.columns.items()},
        {
            name: Labels.joined([labels, second.labels.get(name) or Labels.alike(name, len(second))])
            for name, labels in first.labels.items()
        },
        (*first.lines, *second.lines),
        {},
        first.file,
        first.sha256,
    )

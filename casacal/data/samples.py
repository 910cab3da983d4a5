"""Samples: which columns a file has, validated rows of joint values and readings, of one instrument or several.

Lengths are in millimetres, angles in radians.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from casacal.data.columns import MANY_ROWS, Columns, Dimension, Labels, row_numbers
from casacal.data.text import UNSHOWN, Table, check_names, read_table
from casacal.errors import CasacalError, SamplesError, came
from casacal.files import recover, write_text
from casacal.values import EMPTY, Array, FrozenMapping, Index, Value, read_only, short
from casacal.wording import html_table

UNITS: Mapping[Dimension, Mapping[str, float]] = {
    "angle": {"deg": math.pi / 180, "rad": 1.0},
    "length": {"mm": 1.0, "um": 1e-3, "in": 25.4},
    "number": {"": 1.0},
}
"""Suffixes a column may carry, with their factor to rad or mm."""

ALSO_CALLED = {"plane": ("face", "faces", "surface", "side", "wall", "plate", "plane_id", "plane_name", "label")}
"""Other names that people give a column of labels: such a column is asked about, never overlooked."""

LARGEST = {"angle": 20 * math.pi, "length": 1e5, "number": math.inf}
"""Beyond ten turns or a hundred metres a value is absurd whatever the robot."""

ARRAYS, WORKBOOKS = (".npy", ".npz"), (".xlsx", ".xlsm")  # endings of files that are no text

EXPECTED = "expected_"  # prefix of readings that a plan expects and that are not yet made

UNREAD = 1e12  # mm; what is beyond it is no length in another unit, but a device's sign that it read nothing


def read_columns(path: str | Path) -> Columns:
    """Columns of a file: .npy with named fields, .npz with one array per column, .xlsx, or else delimited text.

    Text of a million rows takes some ten seconds and a gigabyte; arrays take neither. Raises SamplesError.
    """
    path = Path(path)
    recover(path.parent)
    if path.suffix.lower() not in ARRAYS:
        return read_any_table(path).columns
    from casacal.data.archives import read_arrays

    return read_arrays(path)


def read_any_table(path: str | Path) -> Table:
    """The cells of a workbook's first sheet, or of delimited text; raises SamplesError."""
    if Path(path).suffix.lower() not in WORKBOOKS:
        return read_table(path)
    from casacal.data.archives import read_workbook

    return read_workbook(path)


def is_frame(value: Any) -> bool:
    """Whether a value is a pandas DataFrame, without importing pandas for those who have none."""
    return type(value).__name__ == "DataFrame" and hasattr(value, "itertuples")


@dataclass(frozen=True)
class Layout:
    """Columns that a problem requires of its samples.

    further: columns of numbers that terms of the problem ask for, under these very names; a file may lack them.
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


def _taken(layout: Layout) -> set[str]:
    """All names that a layout knows columns by."""
    quantities = (each for name, kind in layout.quantities.items() for each in _spellings(name, kind))
    return {*layout.labels, *layout.further, *quantities}


def _nearly(spellings: Sequence[str], header: Sequence[str], taken: Collection[str]) -> str | None:
    """The unclaimed column of a header whose name is closest to one of some spellings; None where none is close."""
    lower = {spelling.lower() for spelling in spellings}
    alike = [column for column in header if column.lower() in lower]
    if not alike:
        alike = get_close_matches(spellings[0], [column for column in header if column not in taken], 1, cutoff=0.75)
    return alike[0] if alike else None


JOINT_WORDS = "j|joint|axis|ax|a|q|theta|achse|axe"  # what other software calls a joint, before its number
UNIT_SIGNS = {"°": "deg", "º": "deg", "degree": "deg", "degrees": "deg", "grad": "deg", "radian": "rad", "inch": "in"}
HEADING = re.compile(r"([^\W\d_]+)[ _.]*(\d*)[ _]*[\[({<]?([^\W\d_]+|°|º)?[\])}>]?")


def _renamed(header: Sequence[str], layout: Layout) -> dict[str, str]:
    """Columns that other software called otherwise, such as "J1(deg)" or "X [mm]", by what they are called here."""
    found, quantities = dict[str, str](), layout.quantities
    for column in header:
        if (parts := HEADING.fullmatch(column.strip().lower())) is None:
            continue
        word, number, unit = parts[1], parts[2], parts[3] or ""
        name = f"q{number}" if number and re.fullmatch(JOINT_WORDS, word) else f"{word}{number}"
        unit = UNIT_SIGNS.get(unit, unit)
        if name in quantities and unit in UNITS[quantities[name]] and f"{name}_{unit}" != column:
            found.setdefault(column, f"{name}_{unit}")
    return found if len(set(found.values())) == len(found) else {}


def _refuse_other(layout: object) -> None:
    """Raise CasacalError for what is no layout, such as the problem that has it."""
    if not isinstance(layout, Layout):
        fix = "Give problem.layout(), or read a file by problem.read(path)"
        raise CasacalError(f"Got {came(layout)} as the layout of samples", fix)


def match_columns(table: Columns, layout: Layout) -> dict[str, tuple[str, float]]:
    """The column and the factor to mm or rad of each quantity."""
    for name, reason in layout.refused.items():
        for column in table.header:
            if re.fullmatch(rf"{name}(_\w+)?", column):
                fix = "Change the problem, or remove the column"
                raise table.refusal(f"the file has this column but {reason}", fix, column)
    for column in table.header:
        number = re.fullmatch(r"q(\d+)(_\w+)?", column)
        if number and not 1 <= int(number[1]) <= len(layout.joints):
            raise table.refusal(f"the robot has {len(layout.joints)} joints", "Use the file of this robot", column)
    taken = _taken(layout)
    found = {}
    for name, kind in layout.quantities.items():
        spellings = _spellings(name, kind)
        present = [column for column in table.header if column in spellings]
        wanted = " or ".join(spellings)
        if len(present) > 1:
            what = f"'{present[0]}' and '{present[1]}' both give {name}"
            raise table.refusal(what, "Keep one of the two", present[1])
        if present:
            found[name] = present[0], spellings[present[0]]
            continue
        if name in table.header:
            raise table.refusal(f"the column has no unit (for {name}: {wanted})", "Add the unit to its name", name)
        if planned := [column for column in table.header if column.startswith(f"{EXPECTED}{name}")]:
            fix = "Give what was measured in these postures: what casacal measure wrote, or simulate --plan"
            raise table.refusal(f"this is a plan, which expects a {name} and holds none", fix, planned[0])
        wrong = [column for column in table.header if column.startswith(f"{name}_")]
        if wrong:
            raise table.refusal(f"the column does not carry a unit known for {name}", f"Call it {wanted}", wrong[0])
        if len(other := _renamed(table.header, layout)) > 1:
            told = ", ".join(f"'{column}' to {right}" for column, right in other.items())
            raise table.refusal(f"there is no column for {name}, but one with another heading", f"Rename {told}", None)
        alike = _nearly(tuple(spellings), table.header, taken)
        hint = f"(did you mean '{alike}'?)" if alike else "among " + ", ".join(table.header[:20])
        raise table.refusal(f"there is no column for {name} {hint}", f"{'Call it' if alike else 'Add'} {wanted}", alike)
    return found


def read_further(table: Columns, layout: Layout) -> dict[str, Array]:
    """Further columns (N,) that there are; SamplesError for one nearly called so, and a cell that is no number."""
    taken = _taken(layout)
    for name in layout.further:
        alike = None if name in table.header else _nearly((name,), table.header, taken)
        if alike is not None:
            what = f"there is no column '{name}' (did you mean '{alike}'?)"
            raise table.refusal(what, f"Call it {name}, or something else if it is another thing", alike)
    return {name: read_only(table.number(name)) for name in layout.further if name in table.header}


def _labels(table: Columns, name: str) -> Labels:
    if name not in table.header:
        alike = get_close_matches(name, [column.lower() for column in table.header], n=1, cutoff=0.8)
        for column in table.header:
            if column.lower() in (*alike, *ALSO_CALLED.get(name, ())):
                what = f"there is no column '{name}' of labels (did you mean '{column}'?)"
                raise table.refusal(what, f"Call it {name}, or something else if it holds no labels", column)
        return Labels.alike(name, len(table.lines))
    labels = table.text(name)
    for label in sorted(labels.names, key=bool):  # an empty one first
        if not label or UNSHOWN.search(label):
            row = int(np.flatnonzero(labels.codes == labels.names.index(label))[0])
            what = "the label holds a line break or control characters" if label else "the label is empty"
            fix = "Write it plainly" if label else "Give the row its label"
            raise SamplesError(table.file, what, fix, line=table.lines[row], column=name)
    return labels


SHOWN = 10  # rows that a notebook shows


STAYS = 1e-5  # rad or mm by which a joint moves that stays where it is


@dataclass(frozen=True, eq=False)
class Samples(Value):
    """Rows of measurements.

    joints: (N, n), rad or mm. columns: the instrument's own, each (N,), mm or rad. labels: label columns, each (N,) of
    str. lines: line of each row in its file (N,). extra: further columns, numbers (N,) where a term asks for them;
    others as text, those of large files and of arrays are left where they are. All arrays are read-only.
    """

    joints: Array
    columns: Mapping[str, Array]
    labels: Mapping[str, Labels]
    lines: Sequence[int]
    extra: Mapping[str, Array | tuple[str, ...]]
    file: str
    sha256: str
    came: NDArray[np.int8] | None = field(default=None, repr=False, compare=False)
    """As `ways`, where these rows are some of others."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", read_only(self.joints))
        came = None if self.came is None or self.came.shape != self.joints.shape else read_only(self.came)
        object.__setattr__(self, "came", came)
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
        columns = f", {short(read)}" if read else ""
        return f"<{len(self)} samples of {self.file}: {self.joints.shape[1]} joints{columns}>"

    def _repr_html_(self) -> str:
        """The first rows, rad and mm: what a notebook shows."""
        header = ["line", *(f"q{j + 1}" for j in range(self.joints.shape[1])), *self.columns, *self.labels]
        rows = (
            [self.lines[i], *(f"{value:.5g}" for value in (*self.joints[i], *(v[i] for v in self.columns.values()))),
             *(labels[i] for labels in self.labels.values())]
            for i in range(min(len(self), SHOWN))
        )  # fmt: skip
        return html_table(repr(self), header, rows)

    @property
    def ways(self) -> NDArray[np.int8]:
        """How each joint came to each row (N, n): 1 or -1 as it last grew or fell, 0 where it has not moved so far.

        By the order of lines, over all rows of the file, also those that were not taken.
        """
        if self.came is not None:
            return self.came
        order = np.argsort(np.asarray(self.lines), kind="stable")
        steps = np.diff(self.joints[order], axis=0, prepend=self.joints[order[:1]])
        moved = np.where(np.abs(steps) > STAYS, np.arange(len(order))[:, None], 0)
        last = np.maximum.accumulate(moved, axis=0)  # a joint that stays lies on the side on which it lay
        found = np.zeros(self.joints.shape, dtype=np.int8)
        found[order] = np.sign(np.take_along_axis(np.where(moved > 0, steps, 0.0), last, axis=0))
        return found

    def take(self, rows: Sequence[int] | Index) -> Samples:
        """Return the given rows, in the given order, with the same provenance."""
        index, lines = row_numbers(rows, len(self)), self.lines
        if len(index) < MANY_ROWS:
            kept: Sequence[int] = tuple(int(lines[k]) for k in index.tolist())
        else:
            known = np.arange(lines.start, lines.stop, lines.step) if isinstance(lines, range) else np.asarray(lines)
            kept = cast(Sequence[int], read_only(known[index]))
        columns = {name: values[index] for name, values in self.columns.items()}
        labels = {name: values.take(index) for name, values in self.labels.items()}
        extra = taken_from(self.extra, index)
        came = None if self.came is None and np.array_equal(index, np.arange(len(self))) else self.ways[index]
        return Samples(self.joints[index], columns, labels, kept, extra, self.file, self.sha256, came)

    @staticmethod
    def of_joints(joints: Array) -> Samples:
        """Rows of joint values (N, n; rad, mm) alone."""
        return Samples(joints, {}, {}, tuple(range(1, len(joints) + 1)), {}, "joint values", "")

    def check(self, layout: Layout) -> None:
        """Raise SamplesError unless these rows have the joints, columns and labels that a problem asks for."""
        if self.joints.ndim != 2 or self.joints.shape[1] != len(layout.joints):
            what = f"the joint values have the shape {self.joints.shape}"
            raise SamplesError(self.file, what, f"Give {len(layout.joints)} per row")
        for what, have, required in (("column", self.columns, layout.columns), ("label", self.labels, layout.labels)):
            for name in required:
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

        absurd: whether values pass that no robot has. Raises SamplesError that names file, line, column and the fix.
        """
        return Samples.from_columns(read_columns(path), layout, absurd=absurd)

    @staticmethod
    def from_csv(path: str | Path, layout: Layout, *, absurd: bool = False) -> Samples:
        """`from_file`, under the name of the usual format."""
        return Samples.from_file(path, layout, absurd=absurd)

    @staticmethod
    def from_frame(frame: Any, layout: Layout, *, source: str = "DataFrame") -> Samples:
        """Samples from a pandas DataFrame with the columns of a samples file; raises SamplesError."""
        from casacal.data.archives import columns_of_arrays, digest_of, table_of_frame, text_of_cell

        _refuse_other(layout)
        header = [str(name) for name in frame.columns]
        found = [[name for name in header if name in _spellings(*each)] for each in layout.quantities.items()]
        numbers = [name for each in found for name in each] + [name for name in header if name in layout.further]
        once = all(len(each) == 1 for each in found) and len(set(header)) == len(header)
        if once and numbers and all(frame[name].dtype.kind in "iuf" for name in numbers):
            used = {name: frame[name].to_numpy() for name in numbers}
            for name in (name for name in layout.labels if name in header):
                codes, met = frame[name].factorize(use_na_sentinel=False)
                used[name] = np.array([text_of_cell(each) for each in met])[codes]
            columns = replace(columns_of_arrays(used, source, digest_of(used)), header=tuple(header))
            if "purpose" in header and "purpose" not in numbers:  # of columns that nothing asks for it alone counts
                columns = replace(columns, texts=lambda: {"purpose": tuple(map(text_of_cell, frame["purpose"]))})
        else:  # cell by cell, where what is wrong is said
            columns = table_of_frame(frame, source).columns
        return Samples.from_columns(columns, layout)

    @staticmethod
    def from_arrays(arrays: Mapping[str, Any], layout: Layout, *, source: str = "arrays") -> Samples:
        """Samples from arrays (N,) by the column names of a samples file; raises SamplesError."""
        from casacal.data.archives import columns_of_arrays, digest_of, text_of_cell

        for name, values in arrays.items():
            if np.ma.is_masked(values):
                row = int(np.flatnonzero(np.ma.getmaskarray(values))[0]) + 1
                raise SamplesError(source, "the value is masked", "Leave the row out", line=row, column=str(name))
        columns = dict[str, NDArray[Any]]()
        check_names(map(str, arrays), source)
        for name, values in arrays.items():
            try:
                columns[str(name)] = np.asarray(values)
            except ValueError:
                what, fix = "the rows of the column differ in length", "Give one value per row"
                raise SamplesError(source, what, fix, column=str(name)) from None
        for name, values in columns.items():
            if values.dtype == object:
                columns[name] = np.array([text_of_cell(each) for each in values.ravel()]).reshape(values.shape)
        shapes = {values.shape for values in columns.values()}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1 or not next(iter(shapes))[0]:
            found = ", ".join(f"{name} {values.shape}" for name, values in columns.items()) or "nothing"
            raise SamplesError(source, f"the arrays have the shapes {found}", "Give one value per row in each")
        return Samples.from_columns(columns_of_arrays(columns, source, digest_of(columns)), layout)

    @staticmethod
    def from_table(table: Table, layout: Layout, *, absurd: bool = False) -> Samples:
        """Samples from the cells of a table; raises SamplesError."""
        return Samples.from_columns(table.columns, layout, absurd=absurd)

    @staticmethod
    def from_columns(columns: Columns, layout: Layout, *, absurd: bool = False) -> Samples:
        """Samples from columns, which is what all of the above become: what a layout asks, read-only, in mm and rad.

        There is one label for all rows, called as its column, where they have none. Beside the layout's further columns
        those that were not asked for are kept, where rows were read as text. absurd: whether values pass that no robot
        has, for those who look for their cause. Raises SamplesError where a column is missing, without unit, given
        twice or refused, or holds what it may not.
        """
        _refuse_other(layout)
        count = len(columns.lines)
        if not count:
            raise SamplesError(columns.file, "there is no row", "Give one row per sample")
        found = match_columns(columns, layout)

        def fill(name: str, place: Array) -> Array:
            column, factor = found[name]
            np.multiply(columns.number(column), factor, out=place)
            largest = math.inf if absurd else LARGEST[layout.quantities[name]]
            if not math.isinf(largest) and max(place.max(), -place.min()) > largest:
                row, *further = np.flatnonzero(np.abs(place) > largest).tolist()
                limit = "100 m" if largest == LARGEST["length"] else "10 turns"
                what = f"{columns.cell(column, row)} is absurd (beyond {limit})"
                fix = "Check the value and the unit in the column's name"
                fix += "; devices write such numbers where they read nothing" if np.abs(place[row]) > UNREAD else ""
                also = [int(columns.lines[k]) for k in further]
                raise SamplesError(columns.file, what, fix, line=columns.lines[row], column=column, also=also)
            place.setflags(write=False)
            return place

        joints = np.empty((len(layout.joints), count))  # column by column in memory, as they come and as they go
        for i in range(len(layout.joints)):
            fill(f"q{i + 1}", joints[i])
        joints.setflags(write=False)
        joints = joints.T
        own = {name: fill(name, np.empty(count)) for name in layout.columns}
        labels = {name: _labels(columns, name) for name in layout.labels}
        used = {column for column, _ in found.values()} | set(layout.labels)
        texts = {name: text for name, text in columns.texts().items() if name not in used}
        further: dict[str, Array | tuple[str, ...]] = {**texts, **read_further(columns, layout)}
        return Samples(joints, own, labels, columns.lines, further, columns.file, columns.sha256)


def taken_from(extra: Mapping[str, Array | tuple[str, ...]], index: Index) -> dict[str, Array | tuple[str, ...]]:
    """Further columns of some rows."""
    return {
        name: values[index] if isinstance(values, np.ndarray) else tuple(values[i] for i in index.tolist())
        for name, values in extra.items()
    }


def joined(first: Samples, second: Samples) -> Samples:
    """Rows of two sets after each other, with the provenance of the first."""
    columns = {name: np.concatenate([values, second.columns[name]]) for name, values in first.columns.items()}
    labels = {
        name: Labels.joined([labels, second.labels.get(name) or Labels.alike(name, len(second))])
        for name, labels in first.labels.items()
    }
    joints, lines = np.vstack([first.joints, second.joints]), (*first.lines, *second.lines)
    return Samples(joints, columns, labels, lines, {}, first.file, first.sha256, np.vstack([first.ways, second.ways]))


WRITTEN = FrozenMapping({"angle": ("_deg", 180 / math.pi, 7), "length": ("_mm", 1.0, 4), "number": ("", 1.0, 9)})
"""Format of a written quantity: suffix of its column's name, factor from rad or mm, and decimals."""
JOINT_DECIMALS = 7


def write_samples(path: str | Path, layout: Layout, samples: Samples, comments: Sequence[str]) -> None:
    """Write samples as a CSV file that `Problem.read` reads: angles in degrees, lengths in mm, numbers as they are.

    layout: of `Problem.layout`. comments: lines above the header. What touches of a plan are for, and what the layout
    asks for beside readings, stand beside them.
    """
    beside = [name for name in (*layout.further, "purpose") if name in samples.extra]
    after = {name: [str(cell) for cell in samples.extra[name]] for name in beside}
    write_text(path, samples_text(layout, samples, comments, after=after))


def samples_text(
    layout: Layout,
    samples: Samples,
    comments: Sequence[str],
    *,
    before: Mapping[str, Sequence[str]] = EMPTY,
    after: Mapping[str, Sequence[str]] = EMPTY,
    joint_decimals: int = JOINT_DECIMALS,
    least_decimals: int = 0,
    prefix: str = "",
) -> str:
    """Samples file as text.

    before, after: further columns of cells (N,), by name. joint_decimals, least_decimals: of joint values, and of
    readings at least. prefix: what the names of readings begin with.
    """
    columns = dict(before)
    joints = zip(layout.joints, samples.joints.T, strict=True)
    quantities = [(f"q{i}", kind, values, joint_decimals) for i, (kind, values) in enumerate(joints, 1)]
    for name, kind in layout.columns.items():
        quantities.append((prefix + name, kind, samples.columns[name], max(WRITTEN[kind][2], least_decimals)))
    for name, kind, values, decimals in quantities:
        ending, factor, _ = WRITTEN[kind]
        written = np.asarray(values) * factor
        exact = kind == "number"  # of whatever size
        columns[name + ending] = [repr(value) if exact else f"{value:.{decimals}f}" for value in written.tolist()]
    columns |= {name: list(labels) for name, labels in samples.labels.items()} | dict(after)
    text = io.StringIO()
    text.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


@dataclass(frozen=True, eq=False)
class Measurements(Value):
    """Samples by name of instrument, empty for an only one; rows are numbered through all of them in this order."""

    names: tuple[str, ...]
    sets: tuple[Samples, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "sets", tuple(self.sets))

    def __len__(self) -> int:
        return sum(map(len, self.sets))

    def __repr__(self) -> str:
        return f"<{', '.join(f'{len(some)} of {name}' for name, some in zip(self.names, self.sets, strict=True))}>"

    @staticmethod
    def of(samples: Samples | Measurements) -> Measurements:
        """Samples of an only instrument, or what there is of several."""
        return samples if isinstance(samples, Measurements) else Measurements(("",), (samples,))

    @property
    def plain(self) -> Samples | Measurements:
        """Samples where there is one instrument, else itself."""
        return self if len(self.sets) > 1 else self.sets[0]

    @cached_property
    def starts(self) -> Index:
        """Number of the first row of each instrument, and of all rows (instruments + 1,)."""
        return np.cumsum([0, *map(len, self.sets)])

    @property
    def joints(self) -> Array:
        """Joint values (N, n; rad, mm) of all rows."""
        return self.sets[0].joints if len(self.sets) == 1 else np.vstack([some.joints for some in self.sets])

    @property
    def lines(self) -> Sequence[int]:
        """Line of each row in the file of its instrument (N,)."""
        return self.sets[0].lines if len(self.sets) == 1 else tuple(line for some in self.sets for line in some.lines)

    @property
    def instruments(self) -> Index:
        """Which instrument each row is of (N,)."""
        return np.repeat(np.arange(len(self.sets)), [len(some) for some in self.sets])

    @property
    def file(self) -> str:
        """The files, in the order of the instruments."""
        return " and ".join(dict.fromkeys(some.file for some in self.sets))

    @property
    def sha256(self) -> str:
        """SHA-256 of the only file, or of the hashes of all."""
        if len(self.sets) == 1:
            return self.sets[0].sha256
        return hashlib.sha256(" ".join(some.sha256 for some in self.sets).encode()).hexdigest()

    def place(self, row: int) -> int | str:
        """The line of a row; with the name of its instrument where there are several."""
        if len(self.sets) == 1:
            return int(self.sets[0].lines[row])
        i = int(np.searchsorted(self.starts, row, side="right")) - 1
        return f"{self.names[i]} {self.sets[i].lines[row - int(self.starts[i])]}"

    def take(self, rows: Sequence[int] | Index) -> Measurements:
        """Some rows, those of each instrument in the order in which they are named."""
        apart = self.apart(row_numbers(rows, len(self)))
        return Measurements(self.names, tuple(map(Samples.take, self.sets, apart)))

    def apart(self, rows: Index) -> list[Index]:
        """Rows of each instrument, numbered within it."""
        which = np.searchsorted(self.starts, rows, side="right") - 1
        return [rows[which == k] - first for k, first in enumerate(self.starts[:-1])]

    def labelled(self, groups: Sequence[str | None]) -> Labels:
        """Labels (N,) by a column of each instrument; where there are several, after the instrument's name."""
        faces = [some.faces(column) for some, column in zip(self.sets, groups, strict=True)]
        if len(faces) == 1:
            return faces[0]
        parts = []
        for name, some, column, own in zip(self.names, self.sets, groups, faces, strict=True):
            have = column is not None and column in some.labels
            parts.append(Labels([f"{name} {label}" if have else name for label in own.names], own.codes))
        return Labels.joined(parts)

    def map(self, change: Callable[[Samples], Samples]) -> Measurements:
        """The samples of each instrument changed alike."""
        return Measurements(self.names, tuple(map(change, self.sets)))


def sets_of(samples: Sequence[Samples | Measurements]) -> tuple[Samples, ...]:
    """The samples of each instrument, whether they come one after another or together."""
    return tuple(some for each in samples for some in (each.sets if isinstance(each, Measurements) else (each,)))

"""Where each unknown stands in x, and what each row sees of it: settled once, when samples are bound."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.enough_rows import check_rows, instances
from casacal.errors import ProblemError, came
from casacal.instruments import Sight
from casacal.kinematics import stacked_poses
from casacal.problem.compile import RowModel
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.tables.labels import combinations, rows_by_code
from casacal.unknowns import Parameter, Unknown
from casacal.values import Value, read_only

ENOUGH = 20_000
"""Rows of a face that propose where it is."""
TOGETHER = 16_384
"""Rows looked at together, so that a million are never copied at once."""


@dataclass(frozen=True, eq=False)
class Slot(Value):
    """One instance of an unknown, and where its local coordinates stand in x."""

    key: str
    unknown: Unknown
    label: str | None
    nominal: Array
    first: int
    datum: bool

    @property
    def name(self) -> str:
        """Key, with the label where there is one instance per label."""
        return self.key if self.label is None else f"{self.key}.{self.label}"

    @property
    def columns(self) -> range:
        """Its positions in x."""
        return range(self.first, self.first + self.unknown.size)

    def value(self, x: Array) -> Any:
        """Its value at x (n,)."""
        return self.unknown.at(self.nominal, x[self.first : self.first + self.unknown.size])

    def numbers(self) -> Iterator[tuple[str, str, float, int | None]]:
        """Every number of a parameter: name, unit, nominal, position in x (None when held); none of another kind."""
        if isinstance(self.unknown, Parameter):
            free = dict(zip(self.unknown.names(self.name), self.columns, strict=True))
            names = self.unknown.component_names(self.name)
            for name, nominal in zip(names, self.nominal, strict=True):
                yield name, self.unknown.unit, float(nominal), free.get(name)


@dataclass(frozen=True)
class Block:
    """The rows of one instrument: which of x each row sees, its constants and its data."""

    model: RowModel
    samples: Samples
    slots: tuple[tuple[Slot, ...], ...]
    """For each row pattern the slots of the model's unknowns, in the model's order."""
    pattern: NDArray[np.int32]
    """Row pattern of each sample (N,)."""
    columns: NDArray[np.intp]
    """Positions in x of the model's z, by row pattern (patterns, nz)."""
    constants: Array
    """c by row pattern (patterns, nc)."""
    known: tuple[Array, ...]
    """Columns of d beside the joint values, each (N,): mm, rad."""
    noise: Array
    """Standard deviation of each residual at the nominal, (N, m): method of errors in variables."""

    def rows(self, index: NDArray[np.intp] | slice) -> Array:
        """d of some samples (rows, nd): mm, rad; a million rows are never copied at once."""
        return np.column_stack([self.samples.joints[index], *(column[index] for column in self.known)])

    @cached_property
    def data(self) -> Array:
        """d of all samples (N, nd)."""
        return self.rows(slice(None))


def make_slots(problem: Problem, samples: Sequence[Samples], known: Mapping[str, Array] | None = None) -> list[Slot]:
    """Lay out x: the robot's parameters, then each instrument's unknowns, those that differ by label last.

    What is known, by name of its slot, has that nominal however few rows see it. Raises ProblemError as `bind` does.
    """
    if not isinstance(problem, Problem):
        raise ProblemError(f"{came(problem)} came as the problem", "Give a Problem; load_problem(path).problem is one")
    for some in samples:
        if not isinstance(some, Samples):
            raise ProblemError(f"{came(some)} came as samples", "Give Samples; problem.read(path) returns them")
    if len(samples) != len(problem.instruments):
        raise ProblemError(
            f"{len(samples)} sets of samples came for {len(problem.instruments)} instruments", "Give one set each"
        )
    slots: list[Slot] = []
    fits_all, known = known is None, known or {}

    def add(key: str, unknown: Unknown, label: str | None, nominal: Array, datum: bool) -> None:
        first = slots[-1].first + slots[-1].unknown.size if slots else 0
        slots.append(Slot(key, unknown, label, read_only(nominal), first, datum))

    for key, unknown in problem.robot.parameters.items():
        if unknown.nominal is None:
            raise ProblemError(f"Robot parameter '{key}' has no nominal value", "Declare one")
        add(key, unknown, None, unknown.nominal, False)
    for i, instrument in enumerate(problem.instruments):
        for key, unknown in sorted(instrument.unknowns.items(), key=lambda item: item[1].per is not None):
            for label, rows in instances(instrument, key, unknown, samples[i]):
                name = problem.prefix(i) + (key if label is None else f"{key}.{label}")
                nominal = known.get(name, unknown.nominal)
                if name not in known:
                    check_rows(problem, i, key, unknown, label, rows, samples[i], fits_all=fits_all)
                if nominal is None:
                    few = rows[:: -(-len(rows) // ENOUGH) or 1]
                    nominal = instrument.propose(key, nominal_sight(problem, i, samples[i].take(few)))
                add(problem.prefix(i) + key, unknown, label, nominal, key in instrument.datum)
    return slots


def make_block(problem: Problem, i: int, slots: Sequence[Slot], samples: Samples) -> Block:
    """Gather what the rows of instrument `i` see: positions in x, constants, data, noise.

    Raises ProblemError for a label without unknowns, and for a row whose noise is zero or not finite.
    """
    model, instrument = problem.models[i], problem.instruments[i]
    row_slots, pattern = _patterns(problem, i, slots, samples)
    nz = sum(unknown.size for unknown in model.unknowns.values())
    columns = np.array([[j for slot in row for j in slot.columns] for row in row_slots], dtype=np.intp)
    index = [list(model.unknowns).index(key) for key in model.constants]
    constants = np.array([np.concatenate([row[j].nominal for j in index] or [np.zeros(0)]) for row in row_slots])
    columns, constants = columns.reshape(len(row_slots), nz), constants.reshape(len(row_slots), -1)
    known = tuple(_columns(problem, i, samples).values())
    noise = np.empty((len(samples), model.components))
    block = Block(model, samples, row_slots, pattern, columns, constants, known, noise)
    for constant, seen in zip(constants, rows_by_code(pattern, len(constants)), strict=True):
        for rows in np.array_split(seen, 1 + seen.size // TOGETHER):
            noise[rows] = model.columns.noise(np.zeros(nz), constant, block.rows(rows))
    good = (np.isfinite(noise) & (noise > 0)).all(axis=1)
    if not good.all():
        bad = int(np.flatnonzero(~good)[0])
        raise ProblemError(
            f"{samples.file}, line {samples.lines[bad]}: the noise of {type(instrument).__name__} is {noise[bad][0]:g} "
            "in this row, as when a plunger lies in the face or a residual does not change with what errs",
            "Declare a noise of the residual itself (contact_std, residual_std), or remove the row",
        )
    return block


def _patterns(
    problem: Problem, i: int, slots: Sequence[Slot], samples: Samples
) -> tuple[tuple[tuple[Slot, ...], ...], NDArray[np.int32]]:
    """Different combinations of slots that rows see, and which of them each row (N,) sees."""
    by_name = {slot.name: slot for slot in slots}
    label_columns = problem.layout(i).labels
    distinct, pattern = combinations([samples.labels[name] for name in label_columns], len(samples))
    patterns = []
    for labels in distinct:
        here = dict(zip(label_columns, labels, strict=True))
        names = []
        for key, unknown in problem.models[i].unknowns.items():
            full = key if key in problem.robot.parameters else problem.prefix(i) + key
            if unknown.per is not None:
                full = f"{full}.{problem.instruments[i].instance(key, here[unknown.per])}"
            names.append(full)
            if full not in by_name:
                raise ProblemError(
                    f"{samples.file}: some rows are labelled '{here[unknown.per or '']}', the fitted rows are not",
                    "Fit some rows of each label",
                )
        patterns.append(tuple(by_name[name] for name in names))
    return tuple(patterns), pattern


def _columns(problem: Problem, i: int, samples: Samples) -> dict[str, Array]:
    """Columns that were read, then those known from labels, each (N,)."""
    instrument = problem.instruments[i]
    columns = {name: samples.columns[name] for name in instrument.columns}
    for name, values in instrument.known_columns.items():
        labels = samples.labels[instrument.known_by]
        columns[name] = np.array([values.get(label, 0.0) for label in labels.names])[labels.codes]
    return columns


def nominal_sight(problem: Problem, i: int, samples: Samples) -> Sight:
    """What the nominal robot says about all rows of instrument `i`; raises ProblemError when a tip is not finite."""
    flat = problem.models[i].columns.pose(*_nominal_inputs(problem, i, samples))
    poses = stacked_poses(flat)
    model = problem.models[i]
    plungers = None if model.plunger is None else model.columns.plunger(*_nominal_inputs(problem, i, samples))
    return Sight(poses, nominal_tips(problem, i, samples), _columns(problem, i, samples), plungers)


def nominal_tips(problem: Problem, i: int, samples: Samples) -> Array:
    """Tips (N, 3; mm) of all rows of instrument `i` at the nominal; raises ProblemError when one is not finite."""
    tips: Array = problem.models[i].columns.tip(*_nominal_inputs(problem, i, samples))
    if not np.isfinite(tips).all():
        raise ProblemError(
            f"The tip of {type(problem.instruments[i]).__name__} is not finite at the nominal",
            "Check nominal values, and that tip uses no unknown without one",
        )
    return tips


def _nominal_inputs(problem: Problem, i: int, samples: Samples) -> tuple[Array, Array, Array]:
    """(z, c, d) of the nominal robot for all rows."""
    model = problem.models[i]
    z = np.zeros(sum(u.size for u in model.unknowns.values()))
    known = [
        np.full(model.unknowns[k].nominal_size, np.nan) if (n := model.unknowns[k].nominal) is None else n
        for k in model.constants
    ]
    data = np.column_stack([samples.joints, *_columns(problem, i, samples).values()])
    return z, np.concatenate(known or [np.zeros(0)]), data

"""The rows of each instrument, ready to be evaluated: which of x each row sees, its constants, its data, its noise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.nominal import proposed_by, row_columns
from casacal.binding.slots import Slot, nominals
from casacal.discrepancy.effect import Site
from casacal.discrepancy.survey import Survey
from casacal.errors import ProblemError
from casacal.instruments import Instrument
from casacal.kernels.batch import Columnwise
from casacal.problem.compile import RowModel
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.tables.columns import combinations, rows_by_code

TOGETHER = 16_384
"""Rows looked at together, so that a million are never copied at once."""


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
    elsewhere: Array
    """What stands in these columns (k,) at postures that are no rows: zero, or what an effect says."""
    noise: Array
    """Standard deviation of each residual at the nominal, (N, m): method of errors in variables."""

    def rows(self, index: NDArray[np.intp] | slice) -> Array:
        """d of some samples (rows, nd): mm, rad; a million rows are never copied at once."""
        return np.column_stack([self.samples.joints[index], *(column[index] for column in self.known)])

    def posture(self, name: str, x: Array, joints: Array) -> list[Array]:
        """Tips, their slopes or poses at x (n,) and joint values (N, n; rad, mm), at reading zero."""
        data = np.hstack([joints, np.tile(self.elsewhere, (len(joints), 1))])
        outputs: list[Array] = getattr(self.model.batch, name)(x[self.columns[0]], self.constants[0], data)
        return outputs

    @cached_property
    def by_pattern(self) -> list[NDArray[np.intp]]:
        """The samples that have each pattern, in order."""
        return rows_by_code(self.pattern, len(self.slots))

    @cached_property
    def joint_noise(self) -> Array:
        """Standard deviation (N, m) of each residual at the nominal where every joint errs by one radian of its own."""
        return self.at_nominal(self.model.columns.joint_noise)

    def at_nominal(self, function: Columnwise) -> Array:
        """Values (N, m) of a function of one row at the nominal."""
        found = np.empty((len(self.samples), self.model.components))
        for constant, seen in zip(self.constants, self.by_pattern, strict=True):
            for rows in np.array_split(seen, 1 + seen.size // TOGETHER):
                found[rows] = function(np.zeros(self.columns.shape[1]), constant, self.rows(rows))
        return found

    @cached_property
    def data(self) -> Array:
        """d of all samples (N, nd)."""
        return self.rows(slice(None))


def make_block(
    problem: Problem, i: int, slots: Sequence[Slot], samples: Samples, survey: Survey | None = None
) -> Block:
    """Gather what the rows of instrument `i` see: positions in x, constants, data, noise.

    Raises ProblemError for a label without unknowns, and for a row whose noise is zero or not finite.
    """
    model, instrument = problem.models[i], problem.instruments[i]
    _check_stds(instrument, samples)
    row_slots, pattern = _patterns(problem, i, slots, samples)
    nz = sum(unknown.size for unknown in model.unknowns.values())
    columns = np.array([[j for slot in row for j in slot.columns] for row in row_slots], dtype=np.intp)
    index = [list(model.unknowns).index(key) for key in model.constants]
    constants = np.array([np.concatenate([row[j].nominal for j in index] or [np.zeros(0)]) for row in row_slots])
    nc = sum(model.unknowns[key].nominal_size for key in model.constants)
    columns, constants = columns.reshape(len(row_slots), nz), constants.reshape(len(row_slots), nc)
    known = tuple(row_columns(problem, i, samples, survey, proposed_by(problem, i, nominals(slots))).values())
    noise = np.empty((len(samples), model.components))
    block = Block(model, samples, row_slots, pattern, columns, constants, known, _elsewhere(problem, i), noise)
    noise[:] = block.at_nominal(model.columns.noise)
    good = (np.isfinite(noise) & (noise > 0)).all(axis=1)
    if not good.all():
        bad = int(np.flatnonzero(~good)[0])
        raise ProblemError(
            f"{samples.file}, line {samples.lines[bad]}: the noise of {type(instrument).__name__} is "
            f"{noise[bad][0]:g} in this row, as when the plunger is parallel to the face",
            "Declare a noise of the residual itself (contact_std, residual_std), or remove the row",
        )
    return block


def _check_stds(instrument: Instrument, samples: Samples) -> None:
    """Raise ProblemError where a column that says a noise holds none."""
    for block in instrument.blocks:
        if isinstance(block.std, str) and block.std in samples.columns:
            values = samples.columns[block.std]
            wrong = np.flatnonzero(~((values > 0) & np.isfinite(values)))
            if wrong.size:
                line = samples.lines[int(wrong[0])]
                raise ProblemError(
                    f"{samples.file}, line {line}: the noise in the column '{block.std}' is {values[wrong[0]]:g}",
                    "Give a positive standard deviation in every row, or remove the row",
                )


def _elsewhere(problem: Problem, i: int) -> Array:
    model = problem.models[i]
    values = dict.fromkeys(model.names, 0.0)
    for effect in model.effects:
        values |= effect.away(Site(problem.robot, problem.instruments[i]))
    return np.array(list(values.values()))


def _patterns(
    problem: Problem, i: int, slots: Sequence[Slot], samples: Samples
) -> tuple[tuple[tuple[Slot, ...], ...], NDArray[np.int32]]:
    """Different combinations of slots that rows see, and which of them each row (N,) sees."""
    by_name = {slot.name: slot for slot in slots}
    label_columns = problem.layout(i).labels
    full_names = _full_names(problem, i)
    distinct, pattern = combinations([samples.labels[name] for name in label_columns], len(samples))
    if not len(samples):  # an instrument left out: its tip is asked for all the same
        return (_any_slots(full_names.values(), slots),), pattern
    patterns = []
    for labels in distinct:
        here = dict(zip(label_columns, labels, strict=True))
        names = []
        for key, unknown in problem.models[i].unknowns.items():
            full = full_names[key]
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


def _full_names(problem: Problem, i: int) -> dict[str, str]:
    """What the problem calls each unknown that instrument `i` sees: its own, the arm's, and those of effects."""
    of_all = {*problem.robot.parameters, *(effect.key for effect in problem.effects if effect.moves)}
    own = problem.full_names[i]
    return {key: own.get(key, key if key in of_all else problem.prefix(i) + key) for key in problem.models[i].unknowns}


def _any_slots(keys: Iterable[str], slots: Sequence[Slot]) -> tuple[Slot, ...]:
    """A slot of each unknown, whatever its label."""
    first = dict[str, Slot]()
    for slot in slots:
        first.setdefault(slot.key, slot)
    return tuple(first[key] for key in keys)

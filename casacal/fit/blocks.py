"""The rows of each instrument, ready to be evaluated: which of x each row sees, its constants, its data, its noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from casacal.data.columns import combinations, rows_by_code
from casacal.data.samples import Samples
from casacal.errors import ProblemError
from casacal.fit.nominal import proposed_by, row_columns
from casacal.fit.slots import Slot, nominals
from casacal.kernels.block_rows import Columnwise
from casacal.model.instrument import Instrument
from casacal.model.problem import Problem
from casacal.model.term import Survey
from casacal.model.trace import RowModel
from casacal.values import Array, Index

LARGEST = 1e30  # noise beyond which, or below whose inverse, squares of residuals are no numbers any more
TOGETHER = 16_384  # rows looked at together, so that a million are never copied at once


@dataclass(frozen=True)
class Block:
    """The rows of one instrument: the unknowns that each depends on, its constants and its data."""

    model: RowModel
    samples: Samples
    slots: tuple[tuple[Slot, ...], ...]
    """For each row pattern the slots of the model's unknowns, in the model's order."""
    pattern: NDArray[np.int32]
    """Row pattern of each sample (N,)."""
    columns: Index
    """Positions in x of the model's z, by row pattern (patterns, nz)."""
    constants: Array
    """c by row pattern (patterns, nc)."""
    row_columns: tuple[Array, ...]
    """Columns of d beside the joint values, each (N,): mm, rad."""
    elsewhere: Array
    """Values of these columns (k,) at postures that are no rows: zero, or what a term says."""
    usual: Array
    """As `elsewhere` (k,), but the RMS over the rows in columns that rows tell: for the size of an uncorrected term."""
    noise: Array
    """Standard deviation of each residual at the nominal, (N, m): method of errors in variables."""

    def rows(self, index: Index | slice) -> Array:
        """d of some samples (rows, nd): mm, rad; a million rows are never copied at once."""
        return np.column_stack([self.samples.joints[index], *(column[index] for column in self.row_columns)])

    def posture(self, name: str, x: Array, joints: Array, *, usual: bool = True) -> list[Array]:
        """Tips, their slopes or poses at x (n,) and joint values (N, n; rad, mm), at reading zero.

        usual: with columns that rows tell as large as they were on average; else as where nobody knows them.
        """
        data = np.hstack([joints, np.tile(self.usual if usual else self.elsewhere, (len(joints), 1))])
        outputs: list[Array] = self.model.batch(name)(x[self.columns[0]], self.constants[0], data)
        return outputs

    def tips_where(self, x: Array, joints: Array, columns: Array) -> Array:
        """Tips (N, 3; mm) at x (n,) and joint values (N, n; rad, mm), the columns beside these (k,) as given."""
        data = np.hstack([joints, np.tile(columns, (len(joints), 1))])
        return np.asarray(self.model.batch("tip")(x[self.columns[0]], self.constants[0], data)[0])

    def slopes(
        self, what: Literal["tip", "flange"], x: Array, joints: Array, by: Index | None = None, *, usual: bool = True
    ) -> tuple[Array, Array]:
        """Points (N, 3; mm) of the arm as `posture` has them, their derivative (3 N, s) by x or some (s,) of it."""
        points, slopes = self.posture(f"{what}_jacobian", x, joints, usual=usual)
        by = np.arange(x.size) if by is None else by
        _, inside, own = np.intersect1d(by, self.columns[0], return_indices=True)
        jacobian = np.zeros((3 * len(joints), by.size))
        jacobian[:, inside] = slopes.reshape(len(jacobian), -1)[:, own]
        return points, jacobian

    @property
    def by_pattern(self) -> list[Index]:
        """The samples that have each pattern, in order."""
        return rows_by_code(self.pattern, len(self.slots))

    @cached_property
    def joint_slopes(self) -> Array:
        """Derivative (N, m, joints) of each residual at the nominal by each joint, per rad or its equivalent in mm."""
        joints, m = self.samples.joints.shape[1], self.model.components
        return self.at_nominal(self.model.columnwise("joint_slopes"), m * joints).reshape(-1, m, joints)

    def joint_noise(self, joint: int = 0) -> Array:
        """Standard deviation (N, m) of each residual where every joint errs by one radian of its own, or one alone.

        joint: its number, from 1.
        """
        slopes = self.joint_slopes if joint == 0 else self.joint_slopes[..., joint - 1 : joint]
        return np.asarray(np.sqrt((slopes**2).sum(axis=2)))

    def at_nominal(self, function: Columnwise, width: int | None = None) -> Array:
        """Values (N, m) of a function of one row at the nominal; width: how many values a row has, m by default."""
        found = np.empty((len(self.samples), self.model.components if width is None else width))
        for constant, samples in zip(self.constants, self.by_pattern, strict=True):
            for rows in np.array_split(samples, 1 + samples.size // TOGETHER):
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
    columns = np.array([[j for slot in row for j in slot.columns] for row in row_slots], dtype=np.intp)
    index, none = [list(problem.symbols_of(i).unknowns).index(key) for key in model.constants], np.zeros(0)
    constants = np.array([np.concatenate([none, *(row[j].nominal for j in index)]) for row in row_slots])
    columns = columns.reshape(len(row_slots), model.residual.numel_in(0))
    constants = constants.reshape(len(row_slots), model.residual.numel_in(1))
    of_rows = row_columns(problem, i, samples, survey, proposed_by(problem, i, nominals(slots)))
    elsewhere, site = dict.fromkeys(model.names, 0.0), problem.symbols_of(i).site
    for term in model.terms:
        elsewhere |= term.away(site)
    usual = dict(elsewhere)
    for term in model.terms:
        amounts = term.told(site, survey.samples) if term.further and survey is not None else {}
        usual |= {name: float(np.sqrt((values**2).mean())) for name, values in amounts.items()}
    noise, away = np.empty((len(samples), model.components)), np.array(list(elsewhere.values()))
    usually, columns_of_d = np.array(list(usual.values())), tuple(of_rows.values())
    block = Block(model, samples, row_slots, pattern, columns, constants, columns_of_d, away, usually, noise)
    noise[:] = block.at_nominal(model.columnwise("noise"))
    for bad in np.flatnonzero(~((noise > 1 / LARGEST) & (noise < LARGEST)).all(axis=1))[:1]:
        raise ProblemError(
            f"{samples.file}, line {samples.lines[bad]}: the noise of {type(instrument).__name__} is "
            f"{noise[bad][0]:g} in this row, as when the plunger is parallel to the face",
            f"State noise_std between {1 / LARGEST:g} and {LARGEST:g}; or declare a noise of the residual "
            "itself (contact_std, residual_std), or remove the row",
        )
    return block


def _check_stds(instrument: Instrument, samples: Samples) -> None:
    """Raise ProblemError where a column that says a noise holds none."""
    for block in instrument.blocks:
        if isinstance(block.std, str) and block.std in samples.columns:
            values = samples.columns[block.std]
            for row in np.flatnonzero(~((values > 0) & np.isfinite(values)))[:1]:
                where = f"{samples.file}, line {samples.lines[int(row)]}"
                raise ProblemError(
                    f"{where}: the noise in the column '{block.std}' is {values[row]:g}",
                    "Give a positive standard deviation in every row, or remove the row",
                )


def _patterns(
    problem: Problem, i: int, slots: Sequence[Slot], samples: Samples
) -> tuple[tuple[tuple[Slot, ...], ...], NDArray[np.int32]]:
    """Different combinations of slots that rows see, and which of them each row (N,) sees."""
    label_columns, unknowns, own = problem.layout(i).labels, problem.symbols_of(i).unknowns, problem.full_names[i]
    of_all = {*problem.robot.parameters, *(term.key for term in problem.terms if term.moves)}
    # what the problem calls each unknown that the instrument sees: its own, the arm's, and those of terms
    names = {key: own.get(key, key if key in of_all else problem.prefix(i) + key) for key in unknowns}
    distinct, pattern = combinations([samples.labels[name] for name in label_columns], len(samples))
    if not len(samples):  # an instrument left out: its tip is asked for all the same, whatever its label
        first = {slot.key: slot for slot in reversed(slots)}
        return (tuple(first[name] for name in names.values()),), pattern
    by_name = {slot.name: slot for slot in slots}
    patterns = []
    for labels in distinct:
        here, row_slots = dict(zip(label_columns, labels, strict=True)), []
        for key, unknown in unknowns.items():
            name = names[key]
            if unknown.per is not None:
                name = f"{name}.{problem.instruments[i].instance(key, here[unknown.per])}"
            if name not in by_name:
                raise ProblemError(
                    f"{samples.file}: some rows are labelled '{here[unknown.per or '']}', the fitted rows are not",
                    "Fit some rows of each label",
                )
            row_slots.append(by_name[name])
        patterns.append(tuple(row_slots))
    return tuple(patterns), pattern

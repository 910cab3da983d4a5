"""Layout of x, settled when samples are bound: the place of each unknown, its nominal, and which of x each row sees."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from casacal.data.columns import Labels, combinations, rows_by_code
from casacal.data.samples import Samples
from casacal.errors import CasacalError, ProblemError, came, said
from casacal.fit.nominal import Place, nominal_sight, proposed_by, row_columns, sought
from casacal.kernels.block_rows import Columnwise
from casacal.model.instrument import Instrument, NoProposalError, Sight
from casacal.model.problem import Problem
from casacal.model.term import Survey
from casacal.model.trace import RowModel
from casacal.model.unknown import Parameter, Unknown
from casacal.values import Array, Index, Value, read_only, short
from casacal.wording import counted


def instances(instrument: Instrument, key: str, unknown: Unknown, samples: Samples) -> list[tuple[str | None, Index]]:
    """Labels of an unknown's instances (None when there is one for all), with the rows of each."""
    if unknown.per is None:
        return [(None, np.arange(len(samples)))]
    labels = samples.labels[unknown.per]
    have = Labels.coded((instrument.instance(key, label) for label in labels.names), labels.codes)
    return list(have.rows().items())


def _check_arguments(problem: object, samples: Sequence[object]) -> None:
    """Raise ProblemError for what is no problem, no samples, or not a set for each instrument."""
    if not isinstance(problem, Problem):
        raise ProblemError(f"Got {came(problem)} as the problem", "Give a Problem; load_problem(path).problem is one")
    for some in samples:
        if not isinstance(some, Samples):
            raise ProblemError(f"Got {came(some)} as samples", "Give Samples; problem.read(path) returns them")
    if len(samples) != len(problem.instruments):
        what = f"Got {len(samples)} sets of samples for {len(problem.instruments)} instruments"
        raise ProblemError(what, "Give one set each")


def _check_rows(
    problem: Problem, i: int, unknown: Unknown, which: str, rows: int, samples: Samples, *, fits_all: bool
) -> None:
    """Raise ProblemError where a datum of instrument `i` has no more rows than flat unknowns of its own.

    fits_all: whether the arm is to be fitted to these rows too, so that the sentence says how many that takes.
    """
    components = problem.models[i].components
    flat = int((~np.isfinite(unknown.prior_stds)).sum())
    if rows * components > flat:
        return
    fix, instrument = f"Take at least {flat // components + 1} rows there", problem.instruments[i]
    if fits_all and len(problem.instruments) > 1:
        fix += ", and many more to learn about the arm"
    elif fits_all:
        own = sum(u.size * len(instances(instrument, key, u, samples)) for key, u in instrument.unknowns.items())
        total = own + sum(unknown.size for unknown in problem.robot.parameters.values())
        for_all = f"at least {-(-total // components)} in all for {counted(total, 'unknown')}"
        fix += f", and {for_all}, better twice as many; or hold parameters with --fix"
    what = f"{samples.file}: '{which}' has {counted(rows, 'row')} for {counted(flat, 'unknown')} of its own"
    raise ProblemError(what, fix)


def proposed(instrument: Instrument, key: str, unknown: Unknown, sight: Sight) -> Array | None:
    """Nominal value that an instrument proposes, None to search for it; raises ProblemError for an invalid one."""
    whose = f"`propose` of {type(instrument).__name__}"
    try:
        found = np.asarray(instrument.propose(key, sight), dtype=np.float64)
    except NoProposalError:
        return None
    except CasacalError:
        raise
    except Exception as error:
        fix = "Mend it, or leave it out: the residuals then find where it stands"
        raise ProblemError(f"{whose} failed for '{key}': {said(error)}", fix) from error
    if found.shape != (unknown.nominal_size,) or not np.isfinite(found).all():
        what = f"{whose} gave {short(np.ravel(found).tolist())} for '{key}'"
        raise ProblemError(what, f"Give {unknown.nominal_size} finite numbers, as `encode` of its kind does")
    return found


ENOUGH = 20_000  # rows of a face that propose where it is


@dataclass(frozen=True, eq=False)
class Slot(Value):
    """One instance of an unknown, and the place of its local coordinates in x."""

    key: str
    unknown: Unknown
    label: str | None
    nominal: Array
    first: int
    datum: bool
    term: str = ""  # key of the term beside the geometry that it belongs to; empty for the geometry

    @property
    def name(self) -> str:
        """Key, with the label where there is one instance per label."""
        return self.key if self.label is None else f"{self.key}.{self.label}"

    @property
    def columns(self) -> range:
        """Its positions in x."""
        return range(self.first, self.first + self.unknown.size)

    @property
    def held_as_drawn(self) -> bool:
        """Whether it, or part of it, is held where the samples have it if the arm is as drawn: it has no nominal."""
        if self.unknown.nominal is not None or not getattr(self.unknown, "held_as_proposed", False):
            return False
        return self.unknown.size < self.unknown.freed().size

    def sized(self, times: float) -> Slot:
        """Slot with prior standard deviations scaled."""
        stds = [float(std) * times for std in self.unknown.prior_stds]
        return self if times == 1 else replace(self, unknown=self.unknown.with_prior(stds))

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


def nominals(slots: Sequence[Slot]) -> dict[str, Array]:
    """Nominal values, by name, of unknowns that do not differ by label."""
    return {slot.name: slot.nominal for slot in slots if slot.label is None}


def make_slots(problem: Problem, samples: Sequence[Samples], known: Mapping[str, Array] | None = None) -> list[Slot]:
    """Lay out x: the robot's parameters, then each instrument's unknowns, those that differ by label last.

    known: nominals by name of the slot, kept however few rows see them. Raises ProblemError as `bind` does.
    """
    _check_arguments(problem, samples)
    slots: list[Slot] = []
    taken: set[str] = set()
    fits_all, known = known is None, known or {}

    def add(key: str, unknown: Unknown, label: str | None, nominal: Array, datum: bool, term: str = "") -> None:
        first = slots[-1].first + slots[-1].unknown.size if slots else 0
        slots.append(Slot(key, unknown, label, read_only(nominal), first, datum, term))
        taken.add(slots[-1].name)

    for key, unknown in problem.robot.parameters.items():
        add(key, unknown, None, np.asarray(unknown.nominal), False)
    for i, instrument in enumerate(problem.instruments):
        places: list[Place] = []
        whole: Sight | None = None  # of all rows, unless they are many
        for key, unknown in sorted(instrument.unknowns.items(), key=lambda item: item[1].per is not None):
            for label, rows in instances(instrument, key, unknown, samples[i]):
                full = problem.full_names[i][key]
                name = full if label is None else f"{full}.{label}"
                if name in taken:  # shared with an instrument before
                    there = next(slot.nominal for slot in slots if slot.name == name)
                    places.append(Place(name, key, unknown, rows, there))
                    continue
                nominal = known.get(name)
                nominal = unknown.nominal if nominal is None else nominal
                if name not in known and key in instrument.datum:
                    _check_rows(problem, i, unknown, label or key, len(rows), samples[i], fits_all=fits_all)
                if nominal is None:
                    few = rows[:: -(-len(rows) // ENOUGH) or 1]
                    if whole is None and len(samples[i]) <= ENOUGH:
                        whole = nominal_sight(problem, i, samples[i])
                    sight = nominal_sight(problem, i, samples[i].take(few)) if whole is None else whole.of(few)
                    nominal = proposed(instrument, key, unknown, sight)
                places.append(Place(name, key, unknown, rows, nominal))
                add(full, unknown, label, np.zeros(0) if nominal is None else nominal, key in instrument.datum)
        if any(place.nominal is None for place in places):
            found = sought(problem, i, samples[i], places)
            slots[:] = [replace(slot, nominal=read_only(found.get(slot.name, slot.nominal))) for slot in slots]
        for term, unknowns in problem.symbols_of(i).of_terms:
            for key, unknown in unknowns.items():
                for label, _ in instances(instrument, key, unknown, samples[i]):
                    full = key if term.moves else problem.prefix(i) + key
                    if (full if label is None else f"{full}.{label}") not in taken:
                        add(full, unknown, label, np.zeros(unknown.nominal_size), False, term.key)
    return slots


LARGEST = 1e30  # noise beyond which, or below whose inverse, squares of residuals are no numbers any more
TOGETHER = 16_384  # rows looked at together, so that a million are never copied at once


@dataclass(frozen=True)
class Block:
    """The rows of one instrument: the unknowns that each depends on, its constants and its data."""

    model: RowModel
    samples: Samples
    slots: tuple[tuple[Slot, ...], ...]  # for each row pattern the slots of the model's unknowns, in the model's order
    pattern: NDArray[np.int32]  # row pattern of each sample (N,)
    columns: Index  # positions in x of the model's z, by row pattern (patterns, nz)
    constants: Array  # c by row pattern (patterns, nc)
    row_columns: tuple[Array, ...]  # columns of d beside the joint values, each (N,): mm, rad
    elsewhere: Array  # values of these columns (k,) at postures that are no rows: zero, or what a term says
    usual: Array  # as `elsewhere` (k,), but the RMS over rows of what rows tell: for the size of an uncorrected term
    noise: Array  # standard deviation of each residual at the nominal, (N, m): method of errors in variables

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

    Raises ProblemError for a label without unknowns, and for a row whose noise is zero or not finite, or stated so.
    """
    model, instrument = problem.models[i], problem.instruments[i]
    for part in instrument.blocks:
        if isinstance(part.std, str) and part.std in samples.columns:
            values = samples.columns[part.std]
            for row in np.flatnonzero(~((values > 0) & np.isfinite(values)))[:1]:
                what = f"the noise in the column '{part.std}' is {values[row]:g}"
                fix = "Give a positive standard deviation in every row, or remove the row"
                raise ProblemError(f"{samples.file}, line {samples.lines[int(row)]}: {what}", fix)
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
                what = f"some rows are labelled '{here[unknown.per or '']}', the fitted rows are not"
                raise ProblemError(f"{samples.file}: {what}", "Fit some rows of each label")
            row_slots.append(by_name[name])
        patterns.append(tuple(row_slots))
    return tuple(patterns), pattern

"""Instruments: which columns a row has, which unknowns the measurement adds, and its residual.

Whatever depends on the kind of measurement is asked of it, with defaults that work: `columns` and `residual` suffice.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, TypeAlias, get_args

import numpy as np

from casacal.data.columns import Dimension
from casacal.errors import ProblemError, came, refuse_unknown
from casacal.model.geometry import Plane, fitted_plane
from casacal.model.kinematics import Expression, position
from casacal.model.unknown import Parameter, Unknown, check_own_kind
from casacal.user_code import Portable
from casacal.values import Array, FrozenMapping, Index, Rows, is_real


@dataclass(frozen=True)
class ResidualBlock:
    """Some components of a residual, in their order.

    name: as reports call them. size: how many. unit: theirs. std: standard deviation of each, in that unit; or the name
    of the column that says it row by row.
    """

    name: str
    size: int
    unit: str
    std: float | str


@dataclass(frozen=True)
class Suspect:
    """A mistake that people make with columns: what it is called, seems to be, and needs.

    Undone by the factor; where they stand in the wrong order, each takes what stands in the column of `order`. What is
    no matter of single columns is undone by `change`, from all columns to all.
    """

    about: str
    cause: str
    fix: str
    columns: tuple[str, ...]
    factor: float
    order: tuple[str, ...] = ()
    change: Callable[[Mapping[str, Array]], Mapping[str, Array]] | None = None

    @staticmethod
    def units(columns: Mapping[str, Dimension]) -> tuple[Suspect, ...]:
        """All lengths in another unit than their columns say."""
        lengths, about = tuple(name for name, kind in columns.items() if kind == "length"), "unit of the readings"
        found = ((f"the readings seem to be {words}", factor) for factor, words in UNIT_MISTAKES.items() if lengths)
        return tuple(Suspect(about, cause, RENAME_UNIT, lengths, factor) for cause, factor in found)


@dataclass(frozen=True)
class Sight:
    """Nominal poses and readings of the rows that share one instance of an unknown."""

    poses: Array
    """Nominal flange poses, (N, 4, 4), mm."""
    tips: Array
    """Nominal tips, (N, 3), mm."""
    columns: Mapping[str, Array]
    """The rows' own columns and those known from labels, each (N,), in mm, rad or the user's unit."""
    plungers: Array | None = None
    """Nominal directions of the plunger, (N, 3), out of the tool; None for an instrument without one."""

    def of(self, rows: Index) -> Sight:
        """The same of some rows."""
        plungers = None if self.plungers is None else self.plungers[rows]
        columns = {name: values[rows] for name, values in self.columns.items()}
        return Sight(self.poses[rows], self.tips[rows], columns, plungers)

    def touched_plane(self, heights: Array | None = None) -> Array:
        """Numbers (12,) of the total-least-squares plane through the tips, known heights (N,) above it taken off, mm.

        Its normal is towards the tool. Raises ProblemError when the tips lie on a line, so that no plane is seen.
        """
        heights = np.zeros(len(self.tips)) if heights is None else heights
        values, counts = np.unique(heights, return_counts=True)
        normal = self.touched_normal(heights == values[np.argmax(counts)])
        return Plane.encode(normal, (self.tips - heights[:, None] * normal).mean(axis=0))

    def touched_normal(self, rows: Rows) -> Array:
        """Total-least-squares normal (3,) of the tips of some rows, against the mean plunger where there is one."""
        plane = fitted_plane(self.tips[rows])
        if not plane.flat:
            what = f"A plane was touched at {int(rows.sum())} tips on one line"
            raise ProblemError(what, "Spread the touches over the face")
        if self.plungers is None:
            return np.asarray(plane.normal)
        towards = float((self.plungers[rows] @ plane.normal).mean()) > 0
        return np.asarray(-plane.normal if towards else plane.normal)


@dataclass(frozen=True, kw_only=True)
class Trusted:
    """A constant that an instrument takes for exact, and how wrong it may well be.

    words: as people call it. std: standard deviation of its error, in `unit`. scales: columns that err in proportion,
    with `std` in percent. shifts: key of a held unknown that stands elsewhere, by `count` numbers. cure: what
    would tell it, as a noun.
    """

    words: str
    std: float
    unit: str
    scales: tuple[str, ...] = ()
    shifts: str = ""
    count: int = 1
    cure: str = ""

    @staticmethod
    def scale(words: str, percent: float, *columns: str, cure: str) -> Mapping[str, Trusted]:
        """The scale of some columns, which nothing else in the rows tells from the size of the arm."""
        return FrozenMapping({"scale": Trusted(words=words, std=percent, unit="%", scales=columns, cure=cure)})

    @staticmethod
    def held(key: str, unknown: Unknown, words: str, std: float, *, cure: str) -> dict[str, Trusted]:
        """An unknown that is held, with the prior that it states or else `std`; nothing where it is estimated."""
        if unknown.size or unknown.nominal is None:
            return {}
        stated: Any = getattr(unknown, "prior_std", None)
        std = float(stated) if is_real(stated) and math.isfinite(stated) else std
        units = unknown.freed().units
        return {key: Trusted(words=words, std=std, unit=units[0], shifts=key, count=len(units), cure=cure)}


COORDINATE = "residual of each coordinate"


@dataclass(frozen=True)
class Words:
    """How people read what an instrument measures."""

    residual: str = "residual"
    """Name of the residual, as in "distance from the planes"."""
    unit: str = "mm"
    """Unit of the residual."""
    things: str = "samples"
    """Plural noun of the rows measured, as in "the arm misses the held-out planes"."""
    before: str = "before"
    """Words for the fit of the control M0, as in "planes fitted alone"."""
    trusted: str = ""
    """Assumptions that readings cannot test, as in "noise, priors and the dial's gain are right"."""
    group: str = "face"
    """Noun for rows of one label, as in "each face by the others"."""
    accuracy: bool = False
    """Whether its residual is the error of the tip itself, all three axes; a distance from a face is not."""
    approach: str = ""
    """Advice for each posture, as in "if the dial is at the end of its travel, move along the plunger"."""


Travel: TypeAlias = float | tuple[float, float]  # largest reading of a dial from zero, or smallest and largest, mm

OVERTRAVEL = 0.01  # part of its travel by which a dial may show more


def readings_within(travel: Travel) -> tuple[float, float]:
    """Smallest and largest reading, mm."""
    low, high = travel if isinstance(travel, tuple) else (0.0, travel)
    return float(low), float(high)


@dataclass(frozen=True)
class Probe:
    """A tip that touches flat faces, as simulation, checks and pictures know it.

    noise_std: of one measurement, mm. contact_std: of touch and form beside it, mm. column: what the reading along the
    plunger is called, None for contact alone. sign: +1 where a larger reading lengthens the tool. travel: smallest and
    largest reading, mm, or the largest alone where the smallest is zero. label: the column that names the faces, None
    where there is one face for all. moves: keys of the instrument's unknowns that tip and plunger depend on.
    knows_angles: whether the faces' angles to one another are certified. steps: labels of faces at a known height on
    another one. turn: what one turn of a pointer shows, mm; zero where there is none. zero, zero_label: key of the
    unknown that says where its zero stands, and the column whose values have one each; None where it was set once.
    """

    noise_std: float
    contact_std: float = 0.0
    column: str | None = None
    sign: int = 1
    travel: Travel = 0.0
    label: str | None = "plane"
    moves: tuple[str, ...] = ()
    knows_angles: bool = False
    steps: tuple[str, ...] = ()
    turn: float = 0.0
    zero: str | None = None
    zero_label: str | None = None


UNIT_MISTAKES = {
    25.4: "inches, written as mm",
    1 / 25.4: "mm, written as inches",
    10.0: "centimetres, written as mm",
    1000.0: "metres, written as mm, or mm, written as micrometres",
    0.001: "micrometres, written as mm",
    0.01: "hundredths of a millimetre, written as mm",
    0.0254: "thousandths of an inch, written as mm",
}
"""Units in which readings may be by mistake, by the factor that corrects them."""

ANGLE_UNITS = {180 / math.pi: "radians, written as degrees", math.pi / 180: "degrees, written as radians"}
"""Units in which angles may be by mistake, by the factor that corrects them."""

RENAME_UNIT = "Correct the unit in the column's name"


def mistakes_in(columns: Mapping[str, Dimension]) -> tuple[Suspect, ...]:
    """Signs of lengths and angles, one by one, their units, and any two of one kind swapped."""
    kinds = {kind: [name for name, each in columns.items() if each == kind] for kind in ("length", "angle")}
    signs = []
    if len(kinds["length"]) == 1:
        cause, fix = "a longer way seems to be read as a shorter one", "Reverse the sign of the readings"
        signs.append(Suspect("sign of the lengths", cause, fix, tuple(kinds["length"]), -1.0))
    for name in (*(kinds["length"] if len(kinds["length"]) > 1 else ()), *kinds["angle"]):
        cause = f"column '{name}' seems to have the wrong sign"
        signs.append(Suspect(f"sign of '{name}'", cause, f"Reverse the sign of column '{name}'", (name,), -1.0))
    units = list(Suspect.units(columns))
    for factor, words in ANGLE_UNITS.items() if kinds["angle"] else ():
        cause = f"the angles that are read seem to be {words}"
        units.append(Suspect("unit of the angles", cause, RENAME_UNIT, tuple(kinds["angle"]), factor))
    swapped = (
        Suspect(f"'{one}' and '{two}' swapped", f"columns '{one}' and '{two}' seem to be swapped",
                "Swap the two column names", (one, two), 1.0, (two, one))
        for same in kinds.values()
        for one, two in combinations(same, 2)
    )  # fmt: skip
    return (*signs, *units, *swapped)


class NoProposalError(ProblemError):
    """An unknown without a nominal value for which an instrument has no formula."""


class Instrument(Portable, ABC):
    """A way of measuring: the columns it reads, its own unknowns, and a signed smooth residual.

    A subclass gives `residual`, mostly `columns`, `unknowns` and its noise (`residual_std` or `column_stds`), and
    overrides what differs from the defaults below, by a property or by a plain attribute. A subclass that is a frozen
    dataclass has its fields for unknowns, and can have them held or given other priors by `Problem.fix` and
    `Problem.with_prior`.
    """

    @abstractmethod
    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Signed, smooth residual: a scalar or a column (m, 1), in the unit of its noise.

        Args:
            pose: 4x4 flange pose, mm.
            p: values of the robot's parameters and of this instrument's unknowns, by name.
            row: values of `columns`, by name.

        """

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """Columns it reads from a row, beside the joints: name to dimension."""
        return {}

    @property
    def refused_columns(self) -> Mapping[str, str]:
        """Columns that contradict the declaration: name to the sentence that says why."""
        return {}

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Its own unknowns: planes, tool, zero; by default the fields of a dataclass that are unknowns, in order."""
        return {key: value for key, value in _fields(self).items() if isinstance(value, Unknown)}

    @property
    def datum(self) -> tuple[str, ...]:
        """Keys of the unknowns that only say where the touched or watching thing stands; the control M0 fits these.

        By default the unknowns whose prior is flat: nobody knew beforehand where such a thing stands.
        """
        return tuple(key for key, u in self.unknowns.items() if u.size and not np.isfinite(u.prior_stds).any())

    @property
    def column_stds(self) -> Mapping[str, float]:
        """Standard deviation of the error of each column, in mm, rad or the user's unit."""
        return {}

    @property
    def residual_std(self) -> float:
        """Standard deviation of the residual apart from errors of columns and joints, in its unit."""
        return 0.0

    @property
    def blocks(self) -> tuple[ResidualBlock, ...]:
        """Parts of the residual that differ in unit or noise, in order; none where `residual_std` says it all."""
        return ()

    @property
    def ranges(self) -> tuple[str, ...]:
        """Fields that may be two numbers, the smallest and the largest."""
        return ()

    @property
    def begins_at(self) -> Mapping[str, float]:
        """Readings from which simulated ones are looked for, where zero is none."""
        return {}

    @property
    def reading_limits(self) -> Mapping[str, tuple[float, float]]:
        """Smallest and largest reading of columns that have one, which simulated ones keep to; mm, rad or own unit."""
        return {}

    def as_read(self, columns: Mapping[str, Array]) -> Mapping[str, Array]:
        """Simulated readings (N,) by name as a device would say them: of those that mean the same, one."""
        return columns

    def stands(self, key: str, near: Array, normal: Array) -> Array:
        """Nominal of an unknown that was declared without one where it is simulated, near a place (3, mm)."""
        return self.unknowns[key].placed(near, normal)

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Where the instrument touches or is watched (3, mm); the flange's origin unless overridden."""
        del p, row
        return position(pose)

    def plunger_direction(self, pose: Expression, p: Any) -> Expression | None:
        """Direction (3) of a plunger in the base frame, out of the tool; None for an instrument without one."""
        del pose, p
        return None

    def propose(self, key: str, sight: Sight) -> Array:
        """Nominal of an unknown that was declared without one, from what the nominal robot says.

        Raises NoProposalError where the residual is to find it, ProblemError where the rows cannot tell.
        """
        del sight
        fix = "Give it one, or override `propose`, which finds it from the samples"
        raise NoProposalError(f"Unknown '{key}' of {type(self).__name__} has no nominal value", fix)

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Columns that follow from the row's `known_by` label instead of being read: name to label to value, else 0."""
        return {}

    @property
    def known_by(self) -> str:
        """The label column that `known_columns` follow from."""
        return "plane"

    @property
    def knows_every_label(self) -> bool:
        """Whether a label that `known_columns` do not list is a mistake; by default it stands for zero."""
        return False

    def instance(self, key: str, label: str) -> str:
        """Which instance of an unknown, or of what a term adds by label, a label shares; its own unless overridden."""
        del key
        return label

    @property
    def groups(self) -> str | None:
        """The label column by which rows are drawn and listed; by default the first that its unknowns differ by."""
        return next((unknown.per for unknown in self.unknowns.values() if unknown.per is not None), None)

    @property
    def words(self) -> Words:
        """Words for reports; by default in the unit of the first block."""
        unit = self.blocks[0].unit if self.blocks else "mm"
        return Words(unit=unit, before=f"{' and '.join(self.datum)} fitted alone" if self.datum else "nothing fitted")

    @property
    def probe(self) -> Probe | None:
        """The probe that touches flat faces; None for other instruments."""
        return None

    @property
    def trusted(self) -> Mapping[str, Trusted]:
        """Constants that it takes for exact, by name; `calibrate` lets each be as wrong as is said here."""
        return {}

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Mistakes in its columns that `check` undoes one by one to see whether all fits then: signs, units, swaps."""
        return mistakes_in(self.columns)

    def with_faces_by_label(self) -> Instrument | None:
        """A copy with a face of its own for each label, for `cures` that add one; None where that has no meaning."""
        return None

    def with_step(self, label: str, on: str, height: float) -> Instrument | None:
        """A copy with a face at a known height (mm) on another one; None where that has no meaning."""
        del label, on, height
        return None


DECLARABLE = [name for name in vars(Instrument) if not name.startswith("_")]


def check_declaration(instrument: object) -> None:
    """Raise ProblemError for what is no instrument, or says of itself what cannot be."""
    if isinstance(instrument, type) and issubclass(instrument, Instrument):
        what = f"Got the class {instrument.__name__}, not an instrument"
        raise ProblemError(what, f"Make one: {instrument.__name__}(...)")
    if not isinstance(instrument, Instrument):
        fix = "Give instruments one by one, such as DialOnPlane"
        raise ProblemError(f"Got {came(instrument)} as an instrument", fix)
    name = type(instrument).__name__
    for what in ("columns", "column_stds", "reading_limits", "begins_at", "known_columns", "unknowns"):
        if not isinstance(getattr(instrument, what), Mapping):
            raise ProblemError(f"{what} of {name} is {came(getattr(instrument, what))}", "Make it a dict by name")
    for column, dimension in instrument.columns.items():
        if dimension not in get_args(Dimension):
            fix = f"Known: {', '.join(get_args(Dimension))}"
            raise ProblemError(f"Column '{column}' of {name} is a '{dimension}'", fix)
    for what in ("column_stds", "reading_limits", "begins_at"):
        for column in getattr(instrument, what):
            if column not in instrument.columns:
                known = ", ".join(instrument.columns) or "none"
                raise ProblemError(f"{what} of {name} names '{column}', which is no column", f"Its columns: {known}")
    for key, unknown in instrument.unknowns.items():
        if not isinstance(unknown, Unknown):
            raise ProblemError(f"Unknown '{key}' of {name} is {came(unknown)}", "Make it a Parameter or its like")
        check_own_kind(unknown, f"unknown '{key}' of {name}")
    others = [cls for cls in type(instrument).__mro__ if not cls.__module__.startswith("casacal.")]
    for own in {name for cls in others if not issubclass(Instrument, cls) for name in vars(cls)}:
        for meant in [] if hasattr(Instrument, own) else difflib.get_close_matches(own, DECLARABLE, 1, 0.85):
            fix = f"Call it '{meant}', or else something else"
            raise ProblemError(f"{name} has '{own}', which nobody asks for", fix)
    if (units := {block.unit for block in instrument.blocks}) and instrument.words.unit not in units:
        what = f"{name} speaks of {instrument.words.unit}, and its blocks are in {' and '.join(sorted(units))}"
        raise ProblemError(what, "Give words=Words(unit=...) the unit of the first block")
    for key, constant in instrument.trusted.items():
        _check_trusted(instrument, f"The trusted constant '{key}' of {name}", constant)


def _check_trusted(instrument: Instrument, what: str, constant: object) -> None:
    """Raise ProblemError for what is no constant, or shifts and scales what is not there to be shifted or scaled."""
    if not isinstance(constant, Trusted):
        raise ProblemError(f"{what} is {came(constant)}", "Make it a Trusted")
    if not is_real(constant.std) or not 0 < constant.std < math.inf:
        raise ProblemError(f"{what} has the standard deviation {constant.std!r}", "Give a positive number")
    columns = [*instrument.columns, *instrument.known_columns]
    if strange := [column for column in constant.scales if column not in columns]:
        raise ProblemError(f"{what} scales '{strange[0]}', which is no column", f"Its columns: {', '.join(columns)}")
    if bool(constant.scales) == bool(constant.shifts):
        fix = "Name the columns that it scales, or the unknown that it shifts"
        raise ProblemError(f"{what} scales and shifts {'two things' if constant.scales else 'nothing'}", fix)
    if not constant.shifts:
        return
    unknown = instrument.unknowns.get(constant.shifts)
    if unknown is None or unknown.size or unknown.nominal is None:
        known = "is no unknown" if unknown is None else "is not held at a value"
        fix = "Name an unknown that is declared with free=False; what is free has its own prior"
        raise ProblemError(f"{what} shifts '{constant.shifts}', which {known}", fix)
    if len(units := sorted(set(unknown.freed().units))) > 1:
        what += f" shifts '{constant.shifts}' by one size in {' and '.join(units)}"
        raise ProblemError(what, "Declare it free, with a prior for each of its numbers")
    if unknown.freed().size != constant.count:
        fix = f"Give count={unknown.freed().size}"
        raise ProblemError(f"{what} shifts {constant.count} numbers of '{constant.shifts}'", fix)


def with_unknown(instrument: Instrument, key: str, unknown: Unknown) -> Instrument:
    """The instrument with another unknown: a field of a dataclass, or an entry of a plain `unknowns`."""
    if key in _fields(instrument):
        return dataclasses.replace(instrument, **{key: unknown})  # type: ignore[type-var]
    if isinstance(getattr(type(instrument), "unknowns", None), property):
        what = f"'{key}' of {type(instrument).__name__} cannot be replaced"
        raise ProblemError(what, "Make the instrument a dataclass with that field")
    changed: Instrument = object.__new__(type(instrument))
    for name, item in {**vars(instrument), "unknowns": {**instrument.unknowns, key: unknown}}.items():
        object.__setattr__(changed, name, item)
    return changed


def with_setting(instrument: Instrument, name: str, value: float | tuple[float, float]) -> Instrument:
    """The instrument with another number, such as its sign or its noise_std, or pair of them, such as its travel.

    Raises UnknownNameError for what is none of its numbers, ProblemError where the instrument refuses the value.
    """
    present = _fields(instrument)
    numbers = [key for key, held in present.items() if isinstance(held, (int, float)) and not isinstance(held, bool)]
    refuse_unknown(f"number of {type(instrument).__name__}", [name], [*numbers, *instrument.ranges])
    if isinstance(value, tuple):
        if name not in instrument.ranges:
            raise ProblemError(f"{name} of {type(instrument).__name__} is one number, not {value}", "Give one")
    else:
        value = int(value) if isinstance(present[name], int) and float(value).is_integer() else float(value)
    return dataclasses.replace(instrument, **{name: value})  # type: ignore[type-var]


def _fields(instrument: Instrument) -> dict[str, object]:
    """The fields of a dataclass by name; none of another class."""
    if not dataclasses.is_dataclass(instrument):
        return {}
    return {each.name: getattr(instrument, each.name) for each in dataclasses.fields(instrument)}


def tool_point(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, *, prior_std: float = math.inf, free: bool = True
) -> Parameter:
    """Tool point (3, mm) in the flange frame, with components tool_x, tool_y, tool_z; its prior is flat by default."""
    return Parameter((x, y, z), unit="mm", prior_std=prior_std, free=free, labels=("_x", "_y", "_z"))

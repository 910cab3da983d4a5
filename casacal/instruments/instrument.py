"""A way of measuring: the columns it reads, its own unknowns, and a signed smooth residual."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError, came, refuse_unknown
from casacal.instruments.description import Dimension, Probe, ResidualBlock, Sight, Suspect, Words
from casacal.instruments.usual_mistakes import mistakes_in
from casacal.kinematics import Expression, position
from casacal.unknowns import Unknown
from casacal.user_code import Portable


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
        """Standard deviation of what the residual sees beside errors of columns and joints, in its unit."""
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
        raise NoProposalError(
            f"Unknown '{key}' of {type(self).__name__} has no nominal value",
            "Give it one, or override `propose`, which finds it from the samples",
        )

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
        """Which instance of an unknown a label shares; its own unless overridden."""
        del key
        return label

    @property
    def groups(self) -> str | None:
        """The label column by which rows are drawn and listed; by default the first that its unknowns differ by."""
        return next((unknown.per for unknown in self.unknowns.values() if unknown.per is not None), None)

    @property
    def words(self) -> Words:
        """How reports call what it measures."""
        return Words(before=f"{' and '.join(self.datum)} fitted alone" if self.datum else "nothing fitted")

    @property
    def probe(self) -> Probe | None:
        """What touches flat faces; None for an instrument that measures otherwise."""
        return None

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Mistakes in its columns that `check` undoes one by one to see whether all fits then: signs, units, swaps."""
        return mistakes_in(self.columns)

    def with_faces_by_label(self) -> Instrument | None:
        """The same with a face of its own for each label, for `cures` that add one; None where that means nothing."""
        return None

    def with_step(self, label: str, on: str, height: float) -> Instrument | None:
        """The same with a face at a known height (mm) on another one; None where that means nothing."""
        del label, on, height
        return None


def check_declaration(instrument: object) -> None:
    """Raise ProblemError for what is no instrument, or says of itself what cannot be."""
    if isinstance(instrument, type) and issubclass(instrument, Instrument):
        raise ProblemError(
            f"Got the class {instrument.__name__}, not an instrument", f"Make one: {instrument.__name__}(...)"
        )
    if not isinstance(instrument, Instrument):
        raise ProblemError(
            f"Got {came(instrument)} as an instrument", "Give instruments one by one, such as DialOnPlane"
        )
    name = type(instrument).__name__
    for what in ("columns", "column_stds", "reading_limits", "begins_at", "known_columns", "unknowns"):
        if not isinstance(getattr(instrument, what), Mapping):
            raise ProblemError(f"{what} of {name} is {came(getattr(instrument, what))}", "Make it a dict by name")
    for column, dimension in instrument.columns.items():
        if dimension not in get_args(Dimension):
            raise ProblemError(
                f"Column '{column}' of {name} is a '{dimension}'", f"Known: {', '.join(get_args(Dimension))}"
            )
    for what in ("column_stds", "reading_limits", "begins_at"):
        for column in getattr(instrument, what):
            if column not in instrument.columns:
                known = ", ".join(instrument.columns) or "none"
                raise ProblemError(f"{what} of {name} names '{column}', which is no column", f"Its columns: {known}")
    for key, unknown in instrument.unknowns.items():
        if not isinstance(unknown, Unknown):
            raise ProblemError(f"Unknown '{key}' of {name} is {came(unknown)}", "Make it a Parameter or its like")


def with_unknown(instrument: Instrument, key: str, unknown: Unknown) -> Instrument:
    """The instrument with another unknown: a field of a dataclass, or an entry of a plain `unknowns`."""
    if key in _fields(instrument):
        return dataclasses.replace(instrument, **{key: unknown})  # type: ignore[type-var]
    if isinstance(getattr(type(instrument), "unknowns", None), property):
        raise ProblemError(
            f"'{key}' of {type(instrument).__name__} cannot be replaced",
            "Make the instrument a dataclass with that field",
        )
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
        return dataclasses.replace(instrument, **{name: value})  # type: ignore[type-var]
    whole = isinstance(present[name], int) and float(value).is_integer()
    changed: Instrument = dataclasses.replace(instrument, **{name: int(value) if whole else float(value)})  # type: ignore[type-var]
    return changed


def _fields(instrument: Instrument) -> dict[str, object]:
    """The fields of a dataclass by name; none of another class."""
    if not dataclasses.is_dataclass(instrument):
        return {}
    return {each.name: getattr(instrument, each.name) for each in dataclasses.fields(instrument)}

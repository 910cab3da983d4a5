"""What an instrument says of itself: checked when a problem is made, and changed field by field."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import get_args

from casacal.errors import ProblemError, UnknownNameError, came
from casacal.instruments.description import Dimension
from casacal.instruments.instrument import Instrument
from casacal.unknowns import Unknown


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
    for what in ("columns", "column_stds", "known_columns", "unknowns"):
        if not isinstance(getattr(instrument, what), Mapping):
            raise ProblemError(f"{what} of {name} is {came(getattr(instrument, what))}", "Make it a dict by name")
    for column, dimension in instrument.columns.items():
        if dimension not in get_args(Dimension):
            raise ProblemError(
                f"Column '{column}' of {name} is a '{dimension}'", f"Known: {', '.join(get_args(Dimension))}"
            )
    for column in instrument.column_stds:
        if column not in instrument.columns:
            known = ", ".join(instrument.columns) or "none"
            raise ProblemError(f"column_stds of {name} names '{column}', which is no column", f"Its columns: {known}")
    for key, unknown in instrument.unknowns.items():
        if not isinstance(unknown, Unknown):
            raise ProblemError(f"Unknown '{key}' of {name} is {came(unknown)}", "Make it a Parameter or its like")


def with_unknown(instrument: Instrument, key: str, unknown: Unknown) -> Instrument:
    """The instrument with another unknown: a field of a dataclass, or an entry of a plain `unknowns`."""
    if dataclasses.is_dataclass(instrument) and key in {field.name for field in dataclasses.fields(instrument)}:
        return dataclasses.replace(instrument, **{key: unknown})
    if isinstance(getattr(type(instrument), "unknowns", None), property):
        raise ProblemError(
            f"'{key}' of {type(instrument).__name__} cannot be replaced",
            "Make the instrument a dataclass with that field",
        )
    changed: Instrument = object.__new__(type(instrument))
    for name, item in {**vars(instrument), "unknowns": {**instrument.unknowns, key: unknown}}.items():
        object.__setattr__(changed, name, item)
    return changed


def with_setting(instrument: Instrument, name: str, value: float) -> Instrument:
    """The instrument with another number, such as its sign or its noise_std.

    Raises UnknownNameError for what is none of its numbers, ProblemError where the instrument refuses the value.
    """
    present: dict[str, object] = {}
    if dataclasses.is_dataclass(instrument):
        present = {field.name: getattr(instrument, field.name) for field in dataclasses.fields(instrument)}
    numbers = [key for key, held in present.items() if isinstance(held, (int, float)) and not isinstance(held, bool)]
    if name not in numbers:
        raise UnknownNameError(f"number of {type(instrument).__name__}", name, numbers)
    whole = isinstance(present[name], int) and float(value).is_integer()
    changed: Instrument = dataclasses.replace(instrument, **{name: int(value) if whole else float(value)})  # type: ignore[type-var]
    return changed

"""Mistakes that people make with the columns of any instrument: signs, units, two of them in each other's place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations

from casacal.instruments.description import Dimension, Suspect

UNIT_MISTAKES = {
    25.4: "inches, written as mm",
    1 / 25.4: "mm, written as inches",
    10.0: "centimetres, written as mm",
    1000.0: "metres, written as mm, or mm, written as micrometres",
    0.001: "micrometres, written as mm",
}
"""What readings may be by mistake, by the factor that mends it."""

ANGLE_UNITS = {180 / math.pi: "radians, written as degrees", math.pi / 180: "degrees, written as radians"}
"""The same of angles."""

RENAME_UNIT = "Correct the unit in the column's name"


def units_mistaken(columns: Mapping[str, Dimension]) -> tuple[Suspect, ...]:
    """All lengths in another unit than their columns say."""
    lengths = tuple(name for name, dimension in columns.items() if dimension == "length")
    return tuple(
        Suspect("unit of the readings", f"the readings seem to be {words}", RENAME_UNIT, lengths, factor)
        for factor, words in UNIT_MISTAKES.items()
        if lengths
    )


def mistakes_in(columns: Mapping[str, Dimension]) -> tuple[Suspect, ...]:
    """Signs of lengths and angles, one by one, their units, and any two of one kind swapped."""
    kinds = {kind: [name for name, each in columns.items() if each == kind] for kind in ("length", "angle")}
    units = list(units_mistaken(columns))
    for factor, words in ANGLE_UNITS.items() if kinds["angle"] else ():
        cause = f"the angles that are read seem to be {words}"
        units.append(Suspect("unit of the angles", cause, RENAME_UNIT, tuple(kinds["angle"]), factor))
    swapped = (
        Suspect(f"'{one}' and '{two}' swapped", f"columns '{one}' and '{two}' seem to be swapped",
                "Swap the two column names", (one, two), 1.0, (two, one))
        for same in kinds.values()
        for one, two in combinations(same, 2)
    )  # fmt: skip
    return (*_signs(kinds["length"], kinds["angle"]), *units, *swapped)


def _signs(lengths: list[str], angles: list[str]) -> list[Suspect]:
    found = []
    if len(lengths) == 1:
        cause, fix = "a longer way seems to be read as a shorter one", "Reverse the sign of the readings"
        found = [Suspect("sign of the lengths", cause, fix, tuple(lengths), -1.0)]
    for name in (*(lengths if len(lengths) > 1 else ()), *angles):
        cause = f"column '{name}' seems to have the wrong sign"
        found.append(Suspect(f"sign of '{name}'", cause, f"Reverse the sign of column '{name}'", (name,), -1.0))
    return found

"""What a problem asks of its samples: which columns a file must have, in which units."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

from casacal.errors import SamplesError
from casacal.instruments.instrument import Dimension
from casacal.tables.columns import Columns

UNITS: Mapping[Dimension, Mapping[str, float]] = {
    "angle": {"deg": math.pi / 180, "rad": 1.0},
    "length": {"mm": 1.0, "um": 1e-3, "in": 25.4},
    "number": {"": 1.0},
}
"""Suffixes a column may carry, with their factor to rad or mm."""

ALSO_CALLED = {"plane": ("face", "faces", "surface", "side", "wall", "plate", "plane_id", "plane_name", "label")}
"""What people call a column of labels, by its name: such a column is asked about, never overlooked."""

LARGEST = {"angle": 20 * math.pi, "length": 1e5, "number": math.inf}
"""Beyond ten turns or a hundred metres a value is absurd whatever the robot."""


@dataclass(frozen=True)
class Layout:
    """Which columns a file must have: what a problem asks of its samples."""

    joints: tuple[Dimension, ...]
    columns: Mapping[str, Dimension]
    labels: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def quantities(self) -> dict[str, Dimension]:
        """Name to dimension of all numeric columns, joints first."""
        joints: dict[str, Dimension] = {f"q{i + 1}": dimension for i, dimension in enumerate(self.joints)}
        return joints | dict(self.columns)


def numeric_columns(header: Sequence[str], layout: Layout) -> list[str]:
    """The columns of a header that hold the layout's quantities; none unless there is exactly one for each."""
    spellings = [
        {f"{name}_{unit}" if unit else name for unit in UNITS[kind]} for name, kind in layout.quantities.items()
    ]
    found = [[name for name in header if name in each] for each in spellings]
    return [each[0] for each in found] if all(len(each) == 1 for each in found) else []


def match_columns(table: Columns, layout: Layout) -> dict[str, tuple[str, float]]:
    """Find the column and the factor to mm or rad of each quantity.

    Raises SamplesError for a quantity that is missing, without unit, given twice, or refused by the instrument.
    """

    def refuse(what: str, fix: str, column: str | None = None) -> SamplesError:
        return SamplesError(table.file, what, fix, line=table.header_line or None, column=column)

    for name, reason in layout.refused.items():
        for column in table.header:
            if re.fullmatch(rf"{name}(_\w+)?", column):
                raise refuse(
                    f"the file has this column but {reason}", "Change the problem, or remove the column", column
                )
    for column in table.header:
        number = re.fullmatch(r"q(\d+)(_\w+)?", column)
        if number and not 1 <= int(number[1]) <= len(layout.joints):
            raise refuse(f"the robot has {len(layout.joints)} joints", "Use the file of this robot", column)
    taken = {f"{name}_{unit}" for name, kind in layout.quantities.items() for unit in UNITS[kind]} | {*layout.labels}
    return {name: _find(table, name, dimension, taken, refuse) for name, dimension in layout.quantities.items()}


def _find(table: Columns, name: str, dimension: Dimension, taken: set[str], refuse: Any) -> tuple[str, float]:
    spellings = {f"{name}_{unit}" if unit else name: factor for unit, factor in UNITS[dimension].items()}
    present = [column for column in table.header if column in spellings]
    wanted = " or ".join(spellings)
    if len(present) > 1:
        raise refuse(f"'{present[0]}' and '{present[1]}' both give {name}", "Keep one of the two", present[1])
    if present:
        return present[0], spellings[present[0]]
    if name in table.header:
        raise refuse(f"the column has no unit (for {name}: {wanted})", "Add the unit to its name", name)
    wrong = [column for column in table.header if column.startswith(f"{name}_")]
    if wrong:
        raise refuse(f"the column does not carry a unit known for {name}", f"Call it {wanted}", wrong[0])
    alike = [column for column in table.header if column.lower() in {key.lower() for key in spellings}]
    if not alike:  # among what is nothing else
        free = [column for column in table.header if column not in taken]
        alike = get_close_matches(next(iter(spellings)), free, n=1, cutoff=0.75)
    seen = f"(did you mean '{alike[0]}'?)" if alike else "among " + ", ".join(table.header[:20])
    fix = f"Call it {wanted}" if alike else f"Add {wanted}"
    raise refuse(f"there is no column for {name} {seen}", fix, alike[0] if alike else None)

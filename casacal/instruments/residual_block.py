"""Parts of a residual that differ in what they are: a position in mm beside an orientation in rad."""

from __future__ import annotations

from dataclasses import dataclass


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

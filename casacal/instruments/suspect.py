"""Mistakes that people make with what an instrument reads, for `check` to try."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Suspect:
    """A mistake that people make with columns: what it is called, seems to be, and needs.

    Undone by the factor; where they stand in the wrong order, each takes what stands in the column of `order`.
    """

    about: str
    cause: str
    fix: str
    columns: tuple[str, ...]
    factor: float
    order: tuple[str, ...] = ()


UNIT_MISTAKES = {
    25.4: "inches, written as mm",
    1 / 25.4: "mm, written as inches",
    1000.0: "metres, written as mm, or mm, written as micrometres",
    0.001: "micrometres, written as mm",
}
"""What readings may be by mistake, by the factor that mends it."""

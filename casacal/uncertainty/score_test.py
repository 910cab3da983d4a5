"""One effect beside the geometry, as it was tested."""

from __future__ import annotations

import math
from dataclasses import dataclass

CLEAR = 0.01
"""Chance, after all that was tested, below which an effect is taken to be there."""

SUSPICIOUS = 0.05
"""Chance of one test alone below which an effect may be there."""

SMALL_UNITS = {"mm": ("um", 1e3), "rad": ("urad", 1e6), "1": ("parts per million", 1e6)}


@dataclass(frozen=True)
class ScoreTest:
    """One effect beside the geometry: whether the rows show it, and what it would do.

    key, words: as effects and reports call it. p: chance of rows like these where there is no such effect. p_holm: the
    same of the least of as many tests. size: at which the rows are likeliest, the effect alone. expected_size: of any
    arm, NaN where nothing is expected. tip_mm: what an effect of that size does to the tip where only the geometry is
    fitted, its own motion and what it makes of the estimate, RMS over the workspace apart from where the base stands.
    """

    key: str
    words: str
    p: float
    p_holm: float
    size: float
    expected_size: float
    unit: str
    tip_mm: float
    leads: bool = False
    """Whether it is one of those that explain the rows, each beside those before it (`leading_tests`)."""

    @property
    def shown(self) -> str:
        """Whether the rows show it; what a likelier effect explains as well they do not."""
        if self.leads:
            return "yes"
        return "explained" if self.p_holm < CLEAR else "perhaps" if self.p < SUSPICIOUS else "no"

    @property
    def shown_size(self) -> str:
        """The size as people read it."""
        return sized(self.size, self.unit)

    @property
    def shown_expected(self) -> str:
        """The expected size as people read it; a dash where nothing is expected."""
        return sized(self.expected_size, self.unit) if math.isfinite(self.expected_size) else "-"


def sized(value: float, unit: str) -> str:
    """A small size in a unit that suits it."""
    name, factor = SMALL_UNITS.get(unit, (unit, 1.0))
    number = value * factor
    return f"{number:,.0f} {name}" if number >= 100 else f"{number:.2g} {name}"

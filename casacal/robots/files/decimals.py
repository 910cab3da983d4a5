"""Numbers as exported files show them."""

from __future__ import annotations

import math


def plain(value: float) -> str:
    """A number to twelve digits, without trailing zeros; zero, never -0, for what is rounding alone."""
    return f"{value:.12g}" if abs(value) > 1e-12 else "0"


def degrees(value: float) -> str:
    """An angle in rad, in degrees to twelve digits."""
    return plain(math.degrees(value))

"""How much is held at once, and where that ends."""

from __future__ import annotations

from collections.abc import Sized

from casacal.errors import ProblemError

MOST_SUMS = 4_000_000
"""Numbers that the sums of all pieces may take: beyond, each piece sums what it sees alone."""

MOST_UNKNOWNS = 3_000
"""Unknowns whose matrices, of which a calibration holds about ten, fit into a gigabyte."""

COMPACT = 50_000
"""Rows beyond which no whole Jacobian is held."""


def check_unknowns(slots: Sized, unknowns: int) -> None:
    """Raise ProblemError where the things to be found have more unknowns than matrices can hold."""
    if unknowns > MOST_UNKNOWNS:
        raise ProblemError(
            f"{len(slots)} things with {unknowns:,} unknowns are to be found, and at most {MOST_UNKNOWNS:,} can be",
            "Take the rows of fewer labels",
        )

"""How much is held at once."""

from __future__ import annotations

MOST_SUMS = 4_000_000
"""Numbers that the sums of all pieces may take: beyond, each piece sums what it sees alone."""

COMPACT = 50_000
"""Rows beyond which no whole Jacobian is held."""

MANY = 300
"""Unknowns from which those of one label alone are taken out, one label after the other."""

"""Values of unknowns as symbols, each packed into one matrix: the arguments of a graph of poses or residuals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from casacal.unknowns.unknown import Unknown


def packed_symbols(unknowns: Mapping[str, Unknown]) -> tuple[list[ca.SX], dict[str, Any]]:
    """A matrix of symbols for the value of each unknown, and these values, by key."""
    symbols, values = [], {}
    for key, unknown in unknowns.items():
        nominal = ca.SX.zeros(unknown.nominal_size) if unknown.nominal is None else ca.SX(ca.DM(unknown.nominal))
        rows, columns = ca.SX(unknown.packed(unknown.at(nominal, ca.SX.zeros(unknown.size)))).shape
        symbols.append(ca.SX.sym(key, rows, columns))
        values[key] = unknown.unpacked(symbols[-1])
    return symbols, values

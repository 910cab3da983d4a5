"""The extended Kalman filter's pass over all rows of a problem, in one call of compiled C."""

from __future__ import annotations

import ctypes
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.kernels.native_pieces import PackedPieces

Array: TypeAlias = NDArray[np.float64]

LANES = 8
"""Lanes that a row is evaluated with: as many as C pads to."""


def extended_pass(
    packed: PackedPieces, place: NDArray[np.intp], x0: Array, scale: Array, mean: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """Take in all rows, changing mean and covariance in place.

    Args:
        packed: pieces that together hold the rows.
        place: piece, lane in it and component of each row (rows, 3).
        x0, scale: (n,), of the coordinates (x - x0) / scale.
        mean, covariance: belief (n,), (n, n).

    Returns means (rows, n) after each row, innovations and their standard deviations (rows,).

    """
    n, rows = x0.size, len(place)
    run, long, pointer = packed.compiled.extended_pass, ctypes.c_long, ctypes.c_void_p
    run.argtypes, run.restype = [long, long, *[pointer] * 10], None
    means, innovations, stds = np.empty((rows, n)), np.empty(rows), np.empty(rows)
    needed = (
        piece.parameters + LANES * (len(piece.lanes.d) + piece.kernels.components * (piece.kernels.unknowns + 1))
        for piece in packed.pieces
    )
    given = (np.ascontiguousarray(place, dtype=ctypes.c_long), np.ascontiguousarray(x0), np.ascontiguousarray(scale))
    made = (mean, covariance, means, innovations, stds, np.empty(max(needed) + 4 * n))
    run(rows, n, packed.address(0), *(each.ctypes.data for each in (*given, *made)))
    return means, innovations, stds

"""The filters' passes over rows as compiled C: the cubature filter's for one model, the extended one's for all rows."""

from __future__ import annotations

import ctypes
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.kernels.c_source import filter_source
from casacal.kernels.lanes import PAD
from casacal.kernels.libraries import load_library
from casacal.kernels.native_normal import PackedPieces
from casacal.kernels.reading import read_program
from casacal.least_squares.linalg import LEAST_LEFT

Integers: TypeAlias = NDArray[np.integer[Any]]


class NativeCubature:
    """`cubature_pass` of a residual function of (z, c, d), in C: states innermost, an exact downdate in place of a QR.

    Raises CompilerError when it cannot be printed or compiled.
    """

    def __init__(self, residual: ca.Function) -> None:
        program = read_program(residual, ("lane", "once", "once"), ahead=False)
        self.unknowns, self.components = residual.numel_in(0), residual.numel_out(0)
        once = residual.numel_in(1) + residual.numel_in(2)
        self._pass = load_library(filter_source(program, self.unknowns, once), ("cubature_pass",)).cubature_pass
        long, pointer = ctypes.c_long, ctypes.c_void_p
        self._pass.argtypes = [long, long, long, *[pointer] * 6, ctypes.c_double, *[pointer] * 6]
        self._pass.restype = long

    def __call__(
        self,
        first: int,
        pattern: Integers,
        columns: Integers,
        x0: Array,
        scale: Array,
        once: Array,
        weight: Array,
        mean: Array,
        root: Array,
    ) -> tuple[int, Array, Array, Array]:
        """Take in residuals from `first` on, changing mean and root in place.

        Args:
            first: scalar residual to begin with.
            pattern: of each sample (N,).
            columns: positions in x of z, by pattern (patterns, z).
            x0, scale: (n,), of the coordinates.
            once: constants and data of each sample (N, c + d).
            weight: 1 / noise of each residual (N, m).
            mean, root: belief (n,), (n, n) lower triangular.

        Returns the first residual that was not taken in, or their number; and, by residual, means (N m, n),
        innovations and their standard deviations (N m,).

        """
        n, rows = x0.size, weight.size
        means, innovations, stds = np.empty((rows, n)), np.empty(rows), np.empty(rows)
        lanes = -(-2 * n // PAD) * PAD
        work = np.empty(lanes * (self.unknowns + self.components) + 4 * n)
        arrays: list[NDArray[Any]] = [np.ascontiguousarray(each, dtype=ctypes.c_long) for each in (pattern, columns)]
        arrays += [np.ascontiguousarray(each) for each in (x0, scale, once, weight)]
        belief = (mean, root, means, innovations, stds, work)
        at = [each.ctypes.data for each in (*arrays, *belief)]
        stopped = self._pass(first, rows, n, *at[:6], LEAST_LEFT, *at[6:])
        return int(stopped), means, innovations, stds


def extended_pass(
    packed: PackedPieces, place: NDArray[np.intp], x0: Array, scale: Array, mean: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """The extended filter: take in all rows, changing mean and covariance in place.

    A row is evaluated with as many lanes as C pads to.

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
        piece.parameters + PAD * (len(piece.lanes.d) + piece.kernels.components * (piece.kernels.unknowns + 1))
        for piece in packed.pieces
    )
    given = (np.ascontiguousarray(place, dtype=ctypes.c_long), np.ascontiguousarray(x0), np.ascontiguousarray(scale))
    made = (mean, covariance, means, innovations, stds, np.empty(max(needed) + 4 * n))
    run(rows, n, packed.address(0), *(each.ctypes.data for each in (*given, *made)))
    return means, innovations, stds

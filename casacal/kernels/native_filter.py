"""The cubature filter's pass over rows as compiled C: states innermost, an exact downdate in place of a QR."""

from __future__ import annotations

import ctypes
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.kernels.c_source import filter_source
from casacal.kernels.compiler import load_library
from casacal.kernels.reading import read_program
from casacal.linalg import LEAST_LEFT

Array: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.integer[Any]]


class NativeFilter:
    """`cubature_pass` of a residual function of (z, c, d), in C.

    Raises CompilerError when it cannot be printed or compiled.
    """

    def __init__(self, residual: ca.Function) -> None:
        program = read_program(residual, ("lane", "once", "once"), ahead=False)
        self.unknowns, self.components = residual.numel_in(0), residual.numel_out(0)
        once = residual.numel_in(1) + residual.numel_in(2)
        self._pass = load_library(filter_source(program, self.unknowns, once)).cubature_pass
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
        lanes = -(-2 * n // 8) * 8
        work = np.empty(lanes * (self.unknowns + self.components) + 4 * n)
        arrays: list[NDArray[Any]] = [np.ascontiguousarray(each, dtype=ctypes.c_long) for each in (pattern, columns)]
        arrays += [np.ascontiguousarray(each) for each in (x0, scale, once, weight)]
        belief = (mean, root, means, innovations, stds, work)
        at = [each.ctypes.data for each in (*arrays, *belief)]
        stopped = self._pass(first, rows, n, *at[:6], LEAST_LEFT, *at[6:])
        return int(stopped), means, innovations, stds

"""Kernels as compiled C: samples innermost, normal equations accumulated where the Jacobian is made."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.kernels.c_source import kernel_source, rows_of_normal
from casacal.kernels.compiler import load_library
from casacal.kernels.program import Program

Array: TypeAlias = NDArray[np.float64]

PAD = 8
"""Lanes are padded to a multiple of this, so that loops over them need no tail."""
LARGE = 1 << 20
"""Bytes of a Jacobian beyond which it is written past the caches."""


@dataclass(frozen=True)
class Lanes:
    """Data of n rows, column by column: d (columns, ld) and weights w (m, ld).

    The padding repeats the last row, with weight zero.
    """

    n: int
    d: Array
    w: Array

    @property
    def ld(self) -> int:
        """Lanes in memory: n and the padding."""
        return int(self.d.shape[1])


class NativeKernels:
    """The four kernels of a row model in C."""

    name = "c"

    def __init__(self, slopes: Program, parameters: int) -> None:
        self.components = len(slopes.outputs[0])
        self.unknowns = len(slopes.outputs[1]) // self.components
        self.rows = rows_of_normal(self.unknowns)
        self.compiled = load_library(kernel_source(slopes, parameters))
        long, pointer = ctypes.c_long, ctypes.c_void_p
        self._residual = self._function("residual", long, long, pointer, pointer, pointer)
        self._slopes = self._function("slopes", long, long, pointer, pointer, pointer, pointer, long)
        self._costs = self._function("costs", long, long, long, pointer, pointer, pointer, pointer)
        self._normal = self._function("normal", long, long, pointer, pointer, pointer, pointer)

    def lanes(self, d: Array, w: Array) -> Lanes:
        """Data (columns, n) and weights (m, n) as the kernels read them."""
        return Lanes(d.shape[1], _padded(d, repeat=True), _padded(w))

    def reweighted(self, lanes: Lanes, w: Array) -> Lanes:
        """The same rows with other weights (m, n)."""
        return replace(lanes, w=_padded(w))

    def residual(self, p: Array, lanes: Lanes) -> Array:
        """Plain residuals (m, n)."""
        e = np.empty((self.components, lanes.ld))
        self._residual(lanes.n, lanes.ld, _at(p), _at(lanes.d), _at(e))
        return e[:, : lanes.n]

    def slopes(self, p: Array, lanes: Lanes) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""
        e = np.empty((self.components, lanes.ld))
        j = _aligned(self.components * self.unknowns, lanes.ld)
        self._slopes(lanes.n, lanes.ld, _at(p), _at(lanes.d), _at(e), _at(j), j.nbytes > LARGE)
        return e[:, : lanes.n], j.reshape(self.components, self.unknowns, -1)[:, :, : lanes.n]

    def costs(self, states: Array, lanes: Lanes) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""
        states, cost = np.ascontiguousarray(states), np.zeros(len(states))
        self._costs(lanes.n, lanes.ld, len(states), _at(states), _at(lanes.d), _at(lanes.w), _at(cost))
        return cost

    def normal(self, p: Array, lanes: Lanes) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""
        s = np.empty((self.rows, self.rows))
        self._normal(lanes.n, lanes.ld, _at(p), _at(lanes.d), _at(lanes.w), _at(s))
        return s[: self.unknowns + 1, : self.unknowns + 1]

    def _function(self, name: str, *types: Any) -> Callable[..., None]:
        function = getattr(self.compiled, name)
        function.argtypes, function.restype = types, None
        return function  # type: ignore[no-any-return]


def _padded(columns: Array, *, repeat: bool = False) -> Array:
    """Columns (k, n) with lanes added up to a multiple of `PAD`: zeros, or the last one again."""
    count, n = columns.shape
    padded = _aligned(count, -(-n // PAD) * PAD)
    padded[:, :n] = columns
    padded[:, n:] = columns[:, -1:] if repeat and n else 0.0
    return padded


def _aligned(rows: int, columns: int) -> Array:
    """An uninitialised array whose numbers begin at a multiple of 64 bytes."""
    raw = np.empty(rows * columns + 8)
    skipped = -(raw.ctypes.data // 8) % 8
    return raw[skipped : skipped + rows * columns].reshape(rows, columns)


def _at(array: Array) -> int:
    return array.ctypes.data

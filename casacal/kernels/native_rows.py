"""Kernels as compiled C: samples innermost, normal equations accumulated where the Jacobian is made."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.kernels.c_source import kernel_source, rows_of_normal
from casacal.kernels.lanes import PaddedLanes, aligned
from casacal.kernels.libraries import load_library
from casacal.kernels.program import Program

LARGE = 1 << 20
"""Bytes of a Jacobian beyond which it is written around the caches, straight to memory."""
FUNCTIONS = ("residual", "slopes", "costs", "normal", "accumulate", "damped_step", "extended_pass")
"""What the C source of a row model defines."""


class NativeKernels:
    """The four kernels of a row model in C."""

    name = "c"

    def __init__(self, slopes: Program, parameters: int) -> None:
        self.components = len(slopes.outputs[0])
        self.unknowns = len(slopes.outputs[1]) // self.components
        self.rows = rows_of_normal(self.unknowns)
        self.compiled = load_library(kernel_source(slopes, parameters), FUNCTIONS)
        long, pointer = ctypes.c_long, ctypes.c_void_p
        self._residual = self._function("residual", long, long, pointer, pointer, pointer)
        self._slopes = self._function("slopes", long, long, pointer, pointer, pointer, pointer, long)
        self._costs = self._function("costs", long, long, long, pointer, pointer, pointer, pointer)
        self._normal = self._function("normal", long, long, pointer, pointer, pointer, pointer)

    def lanes(self, d: Array, w: Array) -> PaddedLanes:
        """Data (columns, n) and weights (m, n) as the kernels read them."""
        return PaddedLanes.of(d, w)

    def reweighted(self, lanes: PaddedLanes, w: Array) -> PaddedLanes:
        """The same rows with other weights (m, n)."""
        return lanes.reweighted(w)

    def residual(self, p: Array, lanes: PaddedLanes) -> Array:
        """Plain residuals (m, n)."""
        e = np.empty((self.components, lanes.ld))
        self._residual(lanes.n, lanes.ld, _at(p), _at(lanes.d), _at(e))
        return e[:, : lanes.n]

    def slopes(self, p: Array, lanes: PaddedLanes) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""
        e = np.empty((self.components, lanes.ld))
        j = aligned(self.components * self.unknowns, lanes.ld)
        self._slopes(lanes.n, lanes.ld, _at(p), _at(lanes.d), _at(e), _at(j), j.nbytes > LARGE)
        return e[:, : lanes.n], j.reshape(self.components, self.unknowns, lanes.ld)[:, :, : lanes.n]

    def costs(self, states: Array, lanes: PaddedLanes) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""
        states, cost = np.ascontiguousarray(states), np.zeros(len(states))
        self._costs(lanes.n, lanes.ld, len(states), _at(states), _at(lanes.d), _at(lanes.w), _at(cost))
        return cost

    def normal(self, p: Array, lanes: PaddedLanes) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""
        s = np.empty((self.rows, self.rows))
        self._normal(lanes.n, lanes.ld, _at(p), _at(lanes.d), _at(lanes.w), _at(s))
        return s[: self.unknowns + 1, : self.unknowns + 1]

    def _function(self, name: str, *types: Any) -> Callable[..., None]:
        function = getattr(self.compiled, name)
        function.argtypes, function.restype = types, None
        return function  # type: ignore[no-any-return]


def _at(array: Array) -> int:
    return array.ctypes.data

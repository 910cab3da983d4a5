"""Kernels as compiled C: samples innermost, normal equations accumulated where the Jacobian is made."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.kernels.c_source import kernel_source, rows_of_normal
from casacal.kernels.lanes import PaddedLanes, aligned
from casacal.kernels.libraries import load_library
from casacal.kernels.program import Program
from casacal.threads import shared_out

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


@dataclass(frozen=True)
class NativePiece:
    """Some rows that see the same unknowns: their kernels, where z stands in x, what follows z in p, their lanes."""

    kernels: NativeKernels
    columns: NDArray[np.intp]
    constants: Array
    lanes: PaddedLanes

    @property
    def parameters(self) -> int:
        """Numbers in p."""
        return self.columns.size + self.constants.size


class _Piece(ctypes.Structure):
    """`piece` of c/piece.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("normal", "slopes")),
        *((name, ctypes.c_long) for name in ("n", "ld", "z", "rows", "constants", "components", "lanes")),
        *((name, ctypes.c_void_p) for name in ("column", "constant", "d", "w")),
    )


class PackedPieces:
    """Pieces in memory that stays as long as this object: `address(k)` of piece k, and the library that takes them."""

    def __init__(self, pieces: Sequence[NativePiece]) -> None:
        self.pieces = tuple(pieces)
        self.compiled: Any = pieces[0].kernels.compiled
        self._kept: list[object] = []
        self._structs = (_Piece * len(pieces))(*(self._packed(piece) for piece in pieces))

    def address(self, k: int) -> int:
        """Where piece k stands, and those after it."""
        return ctypes.addressof(self._structs[k])

    def _packed(self, piece: NativePiece) -> _Piece:
        columns = np.ascontiguousarray(piece.columns, dtype=ctypes.c_long)
        constants = np.ascontiguousarray(piece.constants)
        self._kept += [columns, constants]
        kernels, lanes = piece.kernels, piece.lanes
        compiled = kernels.compiled
        entries = (ctypes.cast(each, ctypes.c_void_p).value for each in (compiled.normal, compiled.slopes))
        sizes = (lanes.n, lanes.ld, columns.size, kernels.rows, constants.size, kernels.components, len(lanes.d))
        return _Piece(*entries, *sizes, *(each.ctypes.data for each in (columns, constants, lanes.d, lanes.w)))


class NativeNormal:
    """Sums over pieces of rows at one x, and damped steps about x0 in units of `scale` with a prior's information.

    Args:
        packed: at least one piece.
        x0, scale, prior: (n,).
        threads: how many may share the pieces; sums do not depend on it.

    """

    def __init__(self, packed: PackedPieces, x0: Array, scale: Array, prior: Array, threads: int) -> None:
        pieces = packed.pieces
        n, self._threads, self._count = x0.size, threads, len(pieces)
        about = np.array([x0, scale, prior])
        each = max(piece.parameters + piece.kernels.rows**2 for piece in pieces)
        # numbers go in and come out through memory that stays, as finding an array's address takes as long as a step
        self._lock = threading.Lock()
        self._x, self._normal, self._out = np.empty(n), np.empty(n * n + n), np.empty(n + 2)
        self._sums, work = np.empty((len(pieces), n * n + n + 1)), np.empty((len(pieces), max(each, 2 * n * (n + 1))))
        self._kept = (packed, about, work)
        library, long, pointer = packed.compiled, ctypes.c_long, ctypes.c_void_p
        accumulate, step = library.accumulate, library.damped_step
        accumulate.argtypes, accumulate.restype = [long, pointer, long, *[pointer] * 3], None
        step.argtypes, step.restype = [long, *[pointer] * 6, ctypes.c_double, *[pointer] * 2], long
        x, sums, normal = self._x.ctypes.data, self._sums.ctypes.data, self._normal.ctypes.data
        shares = [(k, 1) for k in range(len(pieces))] if threads > 1 else [(0, len(pieces))]
        self._shares = [
            (count, packed.address(k), n, x, sums + k * self._sums.strides[0], work[k].ctypes.data)
            for k, count in shares
        ]
        self._accumulate, self._step = accumulate, step
        self._before = (n, normal, normal + 8 * n * n, x, *(row.ctypes.data for row in about))
        self._after = (self._out.ctypes.data, work.ctypes.data)

    def sums(self, x: Array) -> tuple[float, Array, Array]:
        """Half the whitened sum of squares at x (n,), its gradient (n,), and J'J (n, n)."""
        n = x.size
        with self._lock:
            self._x[:] = x
            shared_out(lambda share: self._accumulate(*share), self._shares, self._threads)
            total = self._sums[0].copy() if self._count == 1 else self._sums.sum(axis=0)
        return float(total[-1]), total[n * n : -1], total[: n * n].reshape(n, n)

    def step(self, x: Array, gradient: Array, information: Array, damping: float) -> tuple[Array, float, float] | None:
        """Where a damped step leads from x (n,), its squared length, the fall it predicts; None when it has none."""
        n = x.size
        with self._lock:
            self._x[:] = x
            self._normal[: n * n] = information.ravel()
            self._normal[n * n :] = gradient
            if not self._step(*self._before, damping, *self._after):
                return None
            out = self._out.copy()
        return out[:n], float(out[n]), float(out[n + 1])

"""Pieces of a problem's rows as compiled C takes them, whatever kernels each of them has."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.kernels.native import Lanes, NativeKernels

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class NativePiece:
    """Some rows that see the same unknowns: their kernels, where z stands in x, what follows z in p, their lanes."""

    kernels: NativeKernels
    columns: NDArray[np.intp]
    constants: Array
    lanes: Lanes

    @property
    def parameters(self) -> int:
        """Numbers in p."""
        return self.columns.size + self.constants.size


class _Piece(ctypes.Structure):
    """`piece` of c_normal."""

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

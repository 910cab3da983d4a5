"""Rows as kernels read them, column by column: padded for C, in blocks for CasADi's machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from casacal.array_types import Array
from casacal.kernels.operations import evaluate
from casacal.kernels.program import Program

PAD = 8
"""Lanes for C are padded to a multiple of this, so that loops over them need no tail."""
WIDTHS = (64, 128, 512)
"""Samples per block: for a face, for few rows, and for many."""

MOST = (64, 512)
"""Samples up to which blocks have the first of these widths, and the second."""


@dataclass(frozen=True)
class PaddedLanes:
    """Data of n rows, column by column: d (columns, ld) and weights w (m, ld).

    The padding repeats the last row, with weight zero.
    """

    n: int
    d: Array
    w: Array

    @staticmethod
    def of(d: Array, w: Array) -> PaddedLanes:
        """Lanes of data (columns, n) and weights (m, n)."""
        return PaddedLanes(d.shape[1], _padded(d, repeat=True), _padded(w))

    def reweighted(self, w: Array) -> PaddedLanes:
        """The same rows with other weights (m, n)."""
        return replace(self, w=_padded(w))

    @property
    def ld(self) -> int:
        """Lanes in memory: n and the padding."""
        return int(self.d.shape[1])


@dataclass(frozen=True)
class BlockLanes:
    """Data of n rows in blocks: d (blocks, columns, width) and weights w (blocks, m, width).

    The last block repeats the last row, with weight zero.
    """

    n: int
    d: Array
    w: Array

    @staticmethod
    def of(d: Array, w: Array) -> BlockLanes:
        """Lanes of data (columns, n) and weights (m, n)."""
        n = d.shape[1]
        width = next((width for width, most in zip(WIDTHS, MOST, strict=False) if n <= most), WIDTHS[-1])
        return BlockLanes(n, _blocked(d, width, "edge"), _blocked(w, width, "constant"))

    def reweighted(self, w: Array) -> BlockLanes:
        """The same rows with other weights (m, n)."""
        return replace(self, w=_blocked(w, self.width, "constant"))

    @property
    def width(self) -> int:
        """Samples per block."""
        return int(self.d.shape[2])

    def joined(self, blocks: Array) -> Array:
        """Columns (k, n) from blocks (blocks, k, width)."""
        return np.asarray(blocks.transpose(1, 0, 2).reshape(blocks.shape[1], -1)[:, : self.n])


def lane_data(program: Program, arguments: Sequence[Array], rows: int) -> Array:
    """What lanes read of rows (columns, rows); element k of argument i is arguments[i][k], as `evaluate` takes them."""
    d = np.zeros((len(program.lanes), rows))
    if len(d):  # a residual may ignore its data
        d[...] = evaluate(program, program.lanes, arguments).reshape(len(d), -1)
    return d


def aligned(rows: int, columns: int) -> Array:
    """An uninitialised array whose numbers begin at a multiple of 64 bytes."""
    raw = np.empty(rows * columns + 8)
    skipped = -(raw.ctypes.data // 8) % 8
    return raw[skipped : skipped + rows * columns].reshape(rows, columns)


def _padded(columns: Array, *, repeat: bool = False) -> Array:
    """Columns (k, n) with lanes added up to a multiple of `PAD`: zeros, or the last one again."""
    count, n = columns.shape
    padded = aligned(count, -(-n // PAD) * PAD)
    padded[:, :n] = columns
    padded[:, n:] = columns[:, -1:] if repeat and n else 0.0
    return padded


def _blocked(columns: Array, width: int, fill: Literal["edge", "constant"]) -> Array:
    """Blocks (blocks, k, width) of columns (k, n), the last one filled up."""
    padded = np.pad(columns, ((0, 0), (0, -columns.shape[1] % width)), mode=fill)
    return np.ascontiguousarray(padded.reshape(len(columns), -1, width).transpose(1, 0, 2))

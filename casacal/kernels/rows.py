"""Interface of the back ends that evaluate rows, and rows packed column by column as they read them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casacal.kernels.program import Program, evaluate
from casacal.values import Array, Index


@dataclass(frozen=True)
class Lanes:
    """n rows in the form a back end reads: data d and weights w, filled up by the last row with weight zero.

    For C, columns d (columns, lanes) and w (m, lanes); for CasADi's machine, blocks of them (blocks, columns, width).
    """

    n: int
    d: Array
    w: Array


class Kernels(ABC):
    """A residual with its slopes, evaluated over rows.

    Args:
        slopes: outputs e (m) and, unless residuals alone are wanted, its derivative row by row (m * z).
        parameters: numbers in p, all arguments but the last, which is the row's data.

    """

    name: str

    def __init__(self, slopes: Program, parameters: int) -> None:
        self.components = len(slopes.outputs[0])
        self.unknowns = sum(map(len, slopes.outputs[1:])) // self.components
        self._program, self._parameters = slopes, parameters

    def lanes(self, data: Array, noise: Array) -> Lanes:
        """Rows of data (n, columns) with standard deviations (n, m) as the kernels read them."""
        d = lane_data(self._program, data)
        return Lanes(len(data), self._packed(d, repeat=True), self._packed(1.0 / noise.T))

    def reweighted(self, lanes: Lanes, w: Array) -> Lanes:
        """Rows with other weights (m, n)."""
        return Lanes(lanes.n, lanes.d, self._packed(w))

    @abstractmethod
    def _packed(self, columns: Array, *, repeat: bool = False) -> Array:
        """Columns (k, n) as the back end reads them, filled up by zeros, or by the last row again."""

    @abstractmethod
    def residual(self, p: Array, lanes: Lanes) -> Array:
        """Plain residuals (m, n)."""

    @abstractmethod
    def slopes(self, p: Array, lanes: Lanes) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""

    @abstractmethod
    def costs(self, states: Array, lanes: Lanes) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""

    @abstractmethod
    def normal(self, p: Array, lanes: Lanes) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""


@dataclass(frozen=True)
class Piece:
    """Rows that depend on the same unknowns, with their kernels."""

    kernels: Kernels
    lanes: Lanes
    numbers: Index  # positions of their residuals among all (n, m)
    columns: Index  # positions of z in x
    constants: Array  # constants, which follow z in p

    @property
    def size(self) -> int:
        """Numbers in p."""
        return self.columns.size + self.constants.size

    def parameters(self, x: Array) -> Array:
        """Kernel argument p at x (n,) or at many (m, n)."""
        if self.size == x.shape[-1] == self.columns.size and self._in_order:
            return np.ascontiguousarray(x, dtype=np.float64)
        if x.ndim == 1:
            return np.concatenate([x[self.columns], self.constants])
        constants = np.broadcast_to(self.constants, (len(x), self.constants.size))
        return np.concatenate([x[:, self.columns], constants], axis=1)

    @cached_property
    def _in_order(self) -> bool:
        return np.array_equal(self.columns, np.arange(self.columns.size))


def lane_data(program: Program, data: Array) -> Array:
    """Lane data (columns, rows) from rows of data (rows, k), the program's last argument."""
    d = np.zeros((len(program.lanes), len(data)))
    if len(d):  # a residual may ignore its data
        nothing = [np.zeros(0)] * (len(program.starts) - 1)
        d[...] = evaluate(program, program.lanes, [*nothing, data.T]).reshape(len(d), -1)
    return d

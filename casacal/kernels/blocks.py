"""Kernels without a compiler: the program replayed on columns of some hundred samples by CasADi's machine."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.kernels.program import Program

Array: TypeAlias = NDArray[np.float64]

WIDTHS = (128, 512)
"""Samples a block: for few rows, and for many."""


@dataclass(frozen=True)
class Lanes:
    """Data of some rows in blocks: d (blocks, columns, width), w (blocks, m, width); n rows.

    The last block repeats the last row, with weight zero.
    """

    n: int
    d: Array
    w: Array


class BlockKernels:
    """The four kernels of a row model on CasADi's virtual machine."""

    name, shareable = "blocks", True

    def __init__(self, slopes: Program, parameters: int) -> None:
        self.components = len(slopes.outputs[0])
        self.unknowns = len(slopes.outputs[1]) // self.components
        self._slopes, self._parameters = slopes, parameters
        # one set a thread: CasADi's machine works in memory of its function's own
        self._local = threading.local()

    def lanes(self, d: Array, w: Array) -> Lanes:
        """Data (columns, n) and weights (m, n) as the kernels read them."""
        n = d.shape[1]
        width = WIDTHS[0] if n <= 4 * WIDTHS[0] else WIDTHS[1]
        return Lanes(n, _blocked(d, width, "edge"), _blocked(w, width, "constant"))

    def reweighted(self, lanes: Lanes, w: Array) -> Lanes:
        """The same rows with other weights (m, n)."""
        return replace(lanes, w=_blocked(w, lanes.w.shape[2], "constant"))

    def residual(self, p: Array, lanes: Lanes) -> Array:
        """Plain residuals (m, n)."""
        function = self._function("residual", lanes)
        e = np.empty((len(lanes.d), self.components, lanes.d.shape[2]))
        for d, out in zip(lanes.d, e, strict=True):
            function((p, d), (out,))
        return _joined(e, lanes.n)

    def slopes(self, p: Array, lanes: Lanes) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""
        function, width = self._function("slopes", lanes), lanes.d.shape[2]
        e = np.empty((len(lanes.d), self.components, width))
        j = np.empty((len(lanes.d), self.components * self.unknowns, width))
        for d, some_e, some_j in zip(lanes.d, e, j, strict=True):
            function((p, d), (some_e, some_j))
        return _joined(e, lanes.n), _joined(j, lanes.n).reshape(self.components, self.unknowns, -1)

    def costs(self, states: Array, lanes: Lanes) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""
        function, out, cost = self._function("cost", lanes), np.empty(1), np.zeros(len(states))
        states = np.ascontiguousarray(states)
        for d, w in zip(lanes.d, lanes.w, strict=True):
            for k, p in enumerate(states):
                function((p, d, w), (out,))
                cost[k] += out[0]
        return cost

    def normal(self, p: Array, lanes: Lanes) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""
        function = self._function("normal", lanes)
        out, s = np.empty((2, self.unknowns + 1, self.unknowns + 1))
        s[...] = 0.0
        for d, w in zip(lanes.d, lanes.w, strict=True):
            function((p, d, w), (out,))
            s += out
        return s

    def _function(self, name: str, lanes: Lanes) -> _Buffered:
        if not hasattr(self._local, "functions"):
            self._local.functions = {}
        functions: dict[tuple[str, int], _Buffered] = self._local.functions
        key = (name, lanes.d.shape[2])
        if key not in functions:
            functions[key] = _Buffered(self._built(*key))
        return functions[key]

    def _built(self, name: str, width: int) -> ca.Function:
        slopes, residual = self._slopes, self._slopes.only(0)
        p = ca.MX.sym("p", self._parameters)
        d, w = ca.MX.sym("d", width, len(residual.lanes)), ca.MX.sym("w", width, self.components)
        if name in ("residual", "cost"):
            e = _replayed(residual, residual.outputs[0], p, d)
            if name == "residual":
                return ca.Function(name, [p, d], [e])
            return ca.Function(name, [p, d, w], [ca.sumsqr(w * e) / 2])
        e = _replayed(slopes, slopes.outputs[0], p, d)
        j = _replayed(slopes, slopes.outputs[1], p, d)
        if name == "slopes":
            return ca.Function(name, [p, d], [e, j])
        total = ca.MX.zeros(self.unknowns + 1, self.unknowns + 1)
        for m in range(self.components):
            row = [j[:, m * self.unknowns : (m + 1) * self.unknowns], e[:, m]]
            weighted = ca.horzcat(*row) * w[:, m]
            total += _product(weighted.T, weighted)
        return ca.Function(name, [p, d, w], [total])


class _Buffered:
    """A CasADi function called on memory that NumPy owns; the function must outlive its buffer, so both are kept."""

    def __init__(self, function: ca.Function) -> None:
        self._kept = function
        self._buffer: Any
        self._buffer, self._evaluate = function.buffer()

    def __call__(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        for i, array in enumerate(inputs):
            self._buffer.set_arg(i, array.reshape(-1).data)
        for i, array in enumerate(outputs):
            self._buffer.set_res(i, array.reshape(-1).data)
        self._evaluate()


def _replayed(program: Program, values: Sequence[int], p: ca.MX, d: ca.MX) -> ca.MX:
    """Some values, one column each, with the operations of a program on columns of samples."""
    known: dict[int, ca.MX] = {value: d[:, k] for k, value in enumerate(program.lanes)}
    for value in program.needed(values):
        operation = program.operations[value]
        if value in known or program.kinds[value] == "lane":
            continue
        if operation.op == ca.OP_CONST:
            known[value] = ca.MX(operation.constant)
        elif operation.op == ca.OP_INPUT:
            known[value] = p[program.position(value)]
        elif len(operation.args) == 1:
            known[value] = ca.MX.unary(operation.op, known[operation.args[0]])
        else:
            one, other = (known[arg] for arg in operation.args)
            known[value] = ca.MX.binary(operation.op, one, other)
    ones = ca.MX.ones(d.shape[0], 1)
    return ca.horzcat(*(known[v] if known[v].shape == ones.shape else known[v] * ones for v in values))


def _product(one: ca.MX, other: ca.MX) -> ca.MX:
    """Matrix product by the BLAS that CasADi was built with, several times faster than its own; 3.8 lets one choose."""
    try:
        return ca.mtimes(one, other, "classic")
    except (TypeError, NotImplementedError, RuntimeError):
        return ca.mtimes(one, other)


def _blocked(columns: Array, width: int, fill: Literal["edge", "constant"]) -> Array:
    """Blocks (blocks, k, width) of columns (k, n), the last one filled up."""
    padded = np.pad(columns, ((0, 0), (0, -columns.shape[1] % width)), mode=fill)
    return np.ascontiguousarray(padded.reshape(len(columns), -1, width).transpose(1, 0, 2))


def _joined(blocks: Array, n: int) -> Array:
    """Columns (k, n) from blocks (blocks, k, width)."""
    return np.asarray(blocks.transpose(1, 0, 2).reshape(blocks.shape[1], -1)[:, :n])

"""Kernels without a compiler: the program replayed on columns of some hundred samples by CasADi's machine."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.kernels.lanes import BlockLanes
from casacal.kernels.program import Program


class Buffered:
    """A CasADi function called on memory that NumPy owns, by any number of threads.

    Work memory belongs to a buffer, not to a function, and CasADi lets go of Python's lock while it evaluates. Each
    thread has a buffer of its own, therefore; the function is one for all.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._own = threading.local()

    def __call__(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        """Evaluate: arrays of float64 in C order, the outputs' overwritten; shapes are as CasADi's, transposed."""
        self.bound(inputs, outputs)()

    def bound(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> Callable[[], None]:
        """What evaluates from and to the same memory whenever this thread calls it, as long as this object lives."""
        buffer, evaluate = self._buffer()
        for i, array in enumerate(inputs):
            buffer.set_arg(i, _flat(array))
        for i, array in enumerate(outputs):
            buffer.set_res(i, _flat(array))
        self._own.arrays = (inputs, outputs)
        return evaluate

    def feed(self, i: int, array: Array) -> None:
        """Read argument i from other memory from now on."""
        self._buffer()[0].set_arg(i, _flat(array))
        self._own.fed = array

    def _buffer(self) -> tuple[Any, Callable[[], None]]:
        if not hasattr(self._own, "buffer"):
            self._own.buffer = self._function.buffer()
        buffer: tuple[Any, Callable[[], None]] = self._own.buffer
        return buffer


def _flat(array: Array) -> memoryview:
    """An array's own memory; a copy would be gone before CasADi reads it."""
    if not array.flags.c_contiguous:
        raise ValueError("an array must lie in memory row by row")
    return array.reshape(-1).data


def prepared(program: Program, parameters: int) -> ca.Function:
    """p -> the program's values of parameters alone, which a call needs once for all blocks."""
    p = ca.MX.sym("p", parameters)
    if not program.once:
        return ca.Function("prepared", [p], [ca.MX(0, 1)])
    return ca.Function("prepared", [p], [ca.vertcat(*replayed(program, program.once, p, ca.MX(1, len(program.lanes))))])


def replayed(program: Program, values: Sequence[int], p: ca.MX, d: ca.MX, *, is_prepared: bool = False) -> list[ca.MX]:
    """Some values, a column each, with the operations of a program on columns of samples.

    p: all parameters, or what `prepared` made of them. Values that share operations belong in one call: CasADi does not
    see that two calls do the same.
    """
    known: dict[int, ca.MX] = dict(zip(program.lanes, ca.horzsplit(d), strict=True)) if program.lanes else {}
    parameters = ca.vertsplit(p) if p.numel() else []
    if is_prepared:
        known |= dict(zip(program.once, parameters, strict=True))
    for value in program.needed(values):
        operation = program.operations[value]
        if value in known or program.kinds[value] == "lane" or (is_prepared and program.kinds[value] == "once"):
            continue
        if operation.op == ca.OP_CONST:
            known[value] = ca.MX(operation.constant)
        elif operation.op == ca.OP_INPUT:
            known[value] = parameters[program.position(value)]
        elif len(operation.args) == 1:
            known[value] = ca.MX.unary(operation.op, known[operation.args[0]])
        else:
            one, other = (known[arg] for arg in operation.args)
            known[value] = ca.MX.binary(operation.op, one, other)
    ones = ca.MX.ones(d.shape[0], 1)
    return [known[v] if known[v].shape == ones.shape else known[v] * ones for v in values]


def product(one: ca.MX, other: ca.MX) -> ca.MX:
    """Matrix product by the BLAS that CasADi was built with, several times faster than its own, where there is one."""
    try:
        return ca.mtimes(one, other, "classic")
    except RuntimeError:
        return ca.mtimes(one, other)


class BlockKernels:
    """The four kernels of a row model on CasADi's virtual machine."""

    name = "blocks"

    def __init__(self, slopes: Program, parameters: int) -> None:
        self.components = len(slopes.outputs[0])
        self.unknowns = len(slopes.outputs[1]) // self.components
        self._slopes, self._residual, self._parameters = slopes, slopes.only(0), parameters
        self._functions: dict[tuple[str, int], Buffered] = {}

    def lanes(self, d: Array, w: Array) -> BlockLanes:
        """Data (columns, n) and weights (m, n) as the kernels read them."""
        return BlockLanes.of(d, w)

    def reweighted(self, lanes: BlockLanes, w: Array) -> BlockLanes:
        """The same rows with other weights (m, n)."""
        return lanes.reweighted(w)

    def residual(self, p: Array, lanes: BlockLanes) -> Array:
        """Plain residuals (m, n)."""
        function, o = self._function("residual", lanes), self._prepared("residual", p)
        e = np.empty((len(lanes.d), self.components, lanes.width))
        for d, out in zip(lanes.d, e, strict=True):
            function((o, d), (out,))
        return lanes.joined(e)

    def slopes(self, p: Array, lanes: BlockLanes) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""
        function, blocks, width = self._function("slopes", lanes), len(lanes.d), lanes.width
        m, z = self.components, self.unknowns
        some, values = np.empty((m * (z + 1), width)), np.empty((m * (z + 1), blocks * width))
        evaluate = function.bound((self._prepared("slopes", p), lanes.d[0]), tuple(some))
        for k, d in enumerate(lanes.d):
            function.feed(1, d)
            evaluate()
            values[:, k * width : (k + 1) * width] = some
        return values[:m, : lanes.n], values[m:].reshape(m, z, values.shape[1])[:, :, : lanes.n]

    def costs(self, states: Array, lanes: BlockLanes) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""
        function, out, cost = self._function("cost", lanes), np.empty(1), np.zeros(len(states))
        states = np.ascontiguousarray(states)
        for k, p in enumerate(states):
            o = self._prepared("residual", p)
            for d, w in zip(lanes.d, lanes.w, strict=True):
                function((o, d, w), (out,))
                cost[k] += out[0]
        return cost

    def normal(self, p: Array, lanes: BlockLanes) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""
        function, o = self._function("normal", lanes), self._prepared("slopes", p)
        out, s = np.empty((2, self.unknowns + 1, self.unknowns + 1))
        s[...] = 0.0
        for d, w in zip(lanes.d, lanes.w, strict=True):
            function((o, d, w), (out,))
            s += out
        return s

    def _prepared(self, name: str, p: Array) -> Array:
        """What depends on parameters alone, of the residual or of all, once for all blocks."""
        program = self._residual if name == "residual" else self._slopes
        o = np.empty(len(program.once))
        self._kept(f"prepared {name}", 0, lambda: prepared(program, self._parameters))((p,), (o,))
        return o

    def _function(self, name: str, lanes: BlockLanes) -> Buffered:
        return self._kept(name, lanes.width, lambda: self._built(name, lanes.width))

    def _kept(self, name: str, width: int, build: Callable[[], ca.Function]) -> Buffered:
        if (name, width) not in self._functions:  # threads that come at once may build it twice, alike
            self._functions[name, width] = Buffered(build())
        return self._functions[name, width]

    def _built(self, name: str, width: int) -> ca.Function:
        program = self._residual if name in ("residual", "cost") else self._slopes
        o, d = ca.MX.sym("o", len(program.once)), ca.MX.sym("d", width, len(program.lanes))
        w = ca.MX.sym("w", width, self.components)
        columns = replayed(program, program.results, o, d, is_prepared=True)
        e, j = columns[: self.components], columns[self.components :]
        if name == "residual":
            return ca.Function(name, [o, d], [ca.horzcat(*e)])
        if name == "cost":
            return ca.Function(name, [o, d, w], [ca.sumsqr(w * ca.horzcat(*e)) / 2])
        if name == "slopes":  # column by column, so that nothing is put together only to be taken apart
            return ca.Function(name, [o, d], columns)
        total = ca.MX.zeros(self.unknowns + 1, self.unknowns + 1)
        for m in range(self.components):
            weighted = ca.horzcat(*j[m * self.unknowns : (m + 1) * self.unknowns], e[m]) * w[:, m]
            total += product(weighted.T, weighted)
        return ca.Function(name, [o, d, w], [total])

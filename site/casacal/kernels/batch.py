"""CasADi's machine over many rows: functions on memory that is filled once and kept, mapped or column by column."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.kernels.program import Program

BLOCK = 256  # rows that a map evaluates in one call; larger ones cost memory and time to build


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
        if not hasattr(self._own, "buffer"):
            self._own.buffer, self._own.evaluate = self._function.buffer()
        buffer: Any = self._own.buffer  # CasADi's stubs do not know that it takes a memoryview
        evaluate: Callable[[], None] = self._own.evaluate
        for i, array in enumerate(inputs):
            buffer.set_arg(i, _flat(array))
        for i, array in enumerate(outputs):
            buffer.set_res(i, _flat(array))
        self._own.arrays = (inputs, outputs)
        return evaluate

    def feed(self, i: int, array: Array) -> None:
        """Read argument i from other memory from now on."""
        self._own.buffer.set_arg(i, _flat(array))
        self._own.fed = array


def _flat(array: Array) -> memoryview:
    """An array's own memory; a copy would be gone before CasADi reads it."""
    if not array.flags.c_contiguous:
        raise ValueError("an array must lie in memory row by row")
    return array.reshape(-1).data


def replayed(program: Program, values: Sequence[int], p: ca.MX, d: ca.MX, *, is_prepared: bool = False) -> list[ca.MX]:
    """Some values, a column each, with the operations of a program on columns of samples.

    p: all parameters or, prepared, the values of `program.once`. Values that share operations belong in one call:
    CasADi does not see that two calls do the same.
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


class Batch:
    """A CasADi function of dense columns, evaluated for many rows at once.

    Threads may share it: each has arguments, results and CasADi's work memory of its own.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._own = threading.local()

    def __call__(self, *inputs: Array) -> list[Array]:
        """Evaluate: inputs (N, k), or (k,) for all rows alike; outputs (N, size)."""
        count = max((len(values) for values in inputs if values.ndim == 2), default=1)
        sizes = [self.function.numel_out(i) for i in range(self.function.n_out())]
        outputs = [np.empty((count, size)) for size in sizes]
        for first in range(0, count, BLOCK):
            last = min(first + BLOCK, count)
            arguments, results, evaluate, *_ = self._width(last - first)
            for argument, values in zip(arguments, inputs, strict=True):
                argument[...] = values[first:last] if values.ndim == 2 else values
            evaluate()
            for output, result in zip(outputs, results, strict=True):
                output[first:last] = result
        return outputs

    def _width(self, width: int) -> tuple[Any, ...]:
        """Arguments, results and the call that fills them, of this thread."""
        if not hasattr(self._own, "widths"):
            self._own.widths = {}
        widths: dict[int, tuple[Any, ...]] = self._own.widths
        if width not in widths:
            function = self.function
            # one row of these arrays is one column of the mapped function
            arguments = [np.zeros((width, function.numel_in(i))) for i in range(function.n_in())]
            results = [np.zeros((width, function.numel_out(i))) for i in range(function.n_out())]
            mapped = Buffered(function.map(width) if width > 1 else function)  # kept, as its buffer needs it
            widths[width] = (arguments, results, mapped.bound(arguments, results), mapped)
        return widths[width]

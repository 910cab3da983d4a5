"""A program replayed on columns of some hundred samples: CasADi's machine does each operation for all of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca

from casacal.array_types import Array
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

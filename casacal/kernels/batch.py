"""CasADi functions mapped over rows, on memory that is filled once and kept, or as columns."""

from __future__ import annotations

import threading
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.kernels.block_rows import Buffered, replayed
from casacal.kernels.lanes import WIDTHS
from casacal.kernels.program import Program
from casacal.kernels.reading import read_program

BLOCK = 256
"""Rows evaluated in one call; larger maps cost memory and time to build."""


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
        """Arguments, results and the call that fills them; the function must outlive its buffer, so both are kept."""
        if not hasattr(self._own, "widths"):
            self._own.widths = {}
        widths: dict[int, tuple[Any, ...]] = self._own.widths
        if width not in widths:
            mapped = self.function.map(width) if width > 1 else self.function
            buffer: Any  # CasADi's stubs do not know that it takes a memoryview
            buffer, evaluate = mapped.buffer()
            # one row of these arrays is one column of the mapped function
            arguments = [np.zeros((width, self.function.numel_in(i))) for i in range(self.function.n_in())]
            results = [np.zeros((width, self.function.numel_out(i))) for i in range(self.function.n_out())]
            for i, array in enumerate(arguments):
                if array.size:
                    buffer.set_arg(i, memoryview(array.reshape(-1).data))
            for i, array in enumerate(results):
                if array.size:
                    buffer.set_res(i, memoryview(array.reshape(-1).data))
            widths[width] = (arguments, results, evaluate, buffer, mapped)
        return widths[width]


FEW = 4096
"""Rows below which a plain map is sooner done than the columns are built."""


class Columnwise:
    """A function (z, c, d) -> values, at one z and c for rows of d."""

    def __init__(self, function: ca.Function) -> None:
        self._batch, self._width = Batch(function), WIDTHS[-1]
        self._built: Buffered | None = None

    @cached_property
    def _program(self) -> Program:
        """Read when many rows come for the first time, which takes longer than few rows do."""
        return read_program(self._batch.function, ("once", "once", "lane"), ahead=False)

    def __call__(self, z: Array, c: Array, data: Array) -> Array:
        """Values (N, outputs) at z and c for data (N, columns)."""
        if len(data) < FEW:
            (values,) = self._batch(z, c, data)
            return values
        program, width = self._program, self._width
        if self._built is None:
            p, d = ca.MX.sym("p", z.size + c.size), ca.MX.sym("d", width, len(program.lanes))
            columns = replayed(program, program.outputs[0], p, d)
            self._built = Buffered(ca.Function("columns", [p, d], [ca.horzcat(*columns)]))
        read = [program.operations[value].element[1] for value in program.lanes]
        values = np.empty((len(data), len(program.outputs[0])))
        once, some, out = np.concatenate([z, c]), np.empty((len(read), width)), np.empty((values.shape[1], width))
        evaluate = self._built.bound((once, some), (out,))
        for first in range(0, len(data), width):
            rows = data[first : first + width, read]
            some[:, : len(rows)], some[:, len(rows) :] = rows.T, rows[-1:].T
            evaluate()
            values[first : first + width] = out[:, : len(rows)].T
        return values

"""A CasADi function mapped over rows, on memory that is filled once and kept."""

from __future__ import annotations

import threading
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array

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

"""A function of parameters and data for many rows at once, as columns on CasADi's machine."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.kernels.batch import Batch
from casacal.kernels.lanes import WIDTHS
from casacal.kernels.program import Program
from casacal.kernels.reading import read_program
from casacal.kernels.replay import Buffered, replayed

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

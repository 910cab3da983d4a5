"""The cubature filter's pass over rows on CasADi's virtual machine: states innermost, an exact downdate for a QR."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.kernels.program import Program
from casacal.kernels.reading import read_program
from casacal.kernels.replay import Buffered, replayed
from casacal.linalg import LEAST_LEFT

Array: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.integer[Any]]


class BlockFilter:
    """The filter's pass for a residual function of (z, c, d); called as `NativeFilter` is."""

    def __init__(self, residual: ca.Function) -> None:
        self.unknowns, self.components = residual.numel_in(0), residual.numel_out(0)
        self._program = read_program(residual, ("lane", "once", "once"), ahead=False)
        self._once = residual.numel_in(1) + residual.numel_in(2)
        self._steps: dict[tuple[int, int], ca.Function] = {}

    def __call__(
        self,
        first: int,
        pattern: Integers,
        columns: Integers,
        x0: Array,
        scale: Array,
        once: Array,
        weight: Array,
        mean: Array,
        root: Array,
    ) -> tuple[int, Array, Array, Array]:
        """Take in residuals from `first` on, changing mean and root in place; see `NativeFilter`."""
        n, rows = x0.size, weight.size
        means, innovations, stds = np.empty((rows, n)), np.empty(rows), np.empty(rows)
        # what a step reads and writes stays in place, so that CasADi is told where only once; S column by column
        z, spread, data, w = np.empty(self.unknowns), np.empty((n, self.unknowns)), np.empty(once.shape[1]), np.empty(1)
        center, turned = mean.copy(), root.T.copy()
        new_center, new_turned, figures = np.empty(n), np.empty((n, n)), np.empty(3)
        kept = [Buffered(self._step(n, component)) for component in range(self.components)]
        inputs, outputs = (z, spread, data, w, center, turned), (new_center, new_turned, figures)
        steps = [step.bound(inputs, outputs) for step in kept]
        stop = rows
        for r in range(first, rows):
            sample, component = divmod(r, self.components)
            seen = columns[pattern[sample]]
            z[:] = x0[seen] + scale[seen] * center[seen]
            np.multiply(turned[:, seen], scale[seen], out=spread)
            data[:], w[:] = once[sample], weight[sample, component]
            steps[component]()
            if not figures[2] > LEAST_LEFT:
                stop = r
                break
            center[:], turned[:] = new_center, new_turned
            means[r] = center
            innovations[r], stds[r], _ = figures
        mean[:], root[:] = center, turned.T
        return stop, means, innovations, stds

    def _step(self, n: int, component: int) -> ca.Function:
        """One row, in coordinates (x - x0) / scale: eqs (15)-(24) of arXiv:2208.02652 as mended.

        (z at the mean, scaled root's rows that z sees, constants and data, weight, mean, S) to the mean and S after it,
        and innovation, its standard deviation, and the part of a variance that is left.
        """
        if (n, component) not in self._steps:
            z, once, w = ca.MX.sym("z", self.unknowns), ca.MX.sym("p", self._once), ca.MX.sym("w")
            spread, mean, root = ca.MX.sym("spread", self.unknowns, n), ca.MX.sym("mean", n), ca.MX.sym("root", n, n)
            e = w * self._at_points(self._program, component, z, spread, once)
            average = ca.sum1(e) / (2 * n)
            std = ca.sqrt(1 + ca.sumsqr(e - average) / (2 * n))
            u = (e[:n] - e[n:]) / (2 * math.sqrt(n) * std)
            left, columns, beyond = ca.MX(1.0), ca.horzsplit(root), ca.MX.zeros(n, 1)
            ups, downs = [], []
            for part in ca.vertsplit(u):
                before, left = left, left - part**2
                ups.append(ca.sqrt(left / before))
                downs.append(part / ca.sqrt(left * before))
            turned = []
            for column, part, up, down in zip(*map(reversed, (columns, ca.vertsplit(u), ups, downs)), strict=True):
                turned.append(column * up - beyond * down)
                beyond = beyond + column * part
            outputs = [mean - beyond * (average / std), ca.horzcat(*reversed(turned)), ca.vertcat(-average, std, left)]
            self._steps[n, component] = ca.Function("step", [z, spread, once, w, mean, root], outputs)
        return self._steps[n, component]

    @staticmethod
    def _at_points(program: Program, component: int, z: ca.MX, spread: ca.MX, once: ca.MX) -> ca.MX:
        """One residual (2 n,) at the cubature points: n on one side of the mean, n on the other."""
        reach = math.sqrt(spread.shape[1])
        lanes = []
        for value in program.lanes:
            _, k = program.operations[value].element
            offset = reach * spread[k, :].T
            lanes.append(ca.vertcat(z[k] + offset, z[k] - offset))
        return replayed(program, [program.outputs[0][component]], once, ca.horzcat(*lanes))

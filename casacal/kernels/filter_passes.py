"""The cubature filter's pass over rows: as compiled C, or on CasADi's virtual machine."""

from __future__ import annotations

import contextlib
import ctypes
import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.kernels.block_rows import Buffered, mapped, replayed
from casacal.kernels.libraries import CompilerError, load_library
from casacal.kernels.native_rows import PAD, filter_source
from casacal.kernels.program import Role, calls, read_program
from casacal.linalg import LEAST_LEFT
from casacal.values import Array


@dataclass(frozen=True)
class FilterRows:
    """Rows that a filter takes in, and the coordinates (x - x0) / scale (n,) of its belief."""

    pattern: NDArray[np.integer[Any]]  # pattern of each sample (N,)
    columns: NDArray[np.integer[Any]]  # positions of z in x, by pattern (patterns, nz)
    x0: Array
    scale: Array
    once: Array  # constants and data of each sample (N, c + d)
    weight: Array  # 1 / noise of each residual (N, m)


class Cubature:
    """The pass for a residual function of (z, c, d), on the back end of that name; where C has no form of it, in MX.

    C has the states innermost; both have an exact downdate in place of a QR.
    """

    def __init__(self, residual: ca.Function, backend: str) -> None:
        # points take turns as the last argument; where the residual calls others, there are no operations to replay
        z, c, d = (ca.SX.sym(name, residual.numel_in(i)) for i, name in enumerate("zcd"))
        self._turned = ca.Function("turned", [c, d, z], residual.call([z, c, d]))
        roles: list[Role] = ["lane", "once", "once"]
        self._program = None if calls(residual) else read_program(residual, roles, ahead=False)
        self._unknowns, self._components = residual.numel_in(0), residual.numel_out(0)
        self._once = residual.numel_in(1) + residual.numel_in(2)
        self._steps: dict[tuple[int, int], ca.Function] = {}
        self._compiled: Any = None
        if backend == "c" and self._program is not None:
            with contextlib.suppress(CompilerError):
                source = filter_source(self._program, self._unknowns, self._once)
                self._compiled = load_library(source, ("cubature_pass",)).cubature_pass
                long, pointer = ctypes.c_long, ctypes.c_void_p
                self._compiled.argtypes = [long, long, long, *[pointer] * 6, ctypes.c_double, *[pointer] * 6]
                self._compiled.restype = long

    def __call__(self, first: int, rows: FilterRows, mean: Array, root: Array) -> tuple[int, Array, Array, Array]:
        """Take in residuals from `first` on, changing the belief in place: mean (n,), lower triangular root (n, n).

        Returns the first residual not taken in, or their number; of each mean (N m, n), innovation, std (N m,).
        """
        return (self._by_blocks if self._compiled is None else self._by_c)(first, rows, mean, root)

    def _by_c(self, first: int, rows: FilterRows, mean: Array, root: Array) -> tuple[int, Array, Array, Array]:
        n, count = rows.x0.size, rows.weight.size
        means, innovations, stds = np.empty((count, n)), np.empty(count), np.empty(count)
        lanes = -(-2 * n // PAD) * PAD
        work = np.empty(lanes * (self._unknowns + self._components) + 4 * n)
        indices = (rows.pattern, rows.columns)
        arrays: list[NDArray[Any]] = [np.ascontiguousarray(each, dtype=ctypes.c_long) for each in indices]
        arrays += [np.ascontiguousarray(each) for each in (rows.x0, rows.scale, rows.once, rows.weight)]
        at = [each.ctypes.data for each in (*arrays, mean, root, means, innovations, stds, work)]
        stopped = self._compiled(first, count, n, *at[:6], LEAST_LEFT, *at[6:])
        return int(stopped), means, innovations, stds

    def _by_blocks(self, first: int, rows: FilterRows, mean: Array, root: Array) -> tuple[int, Array, Array, Array]:
        n, count, once = rows.x0.size, rows.weight.size, rows.once
        means, trace = np.empty((count, n)), np.empty((count, 3))
        # buffers of a step stay in place, so that CasADi is given their addresses only once; S column by column
        points, data, w = np.empty((self._unknowns, 2 * n)), np.empty(once.shape[1]), np.empty(1)
        up, down = points[:, :n], points[:, n:]
        center, turned, figures = mean.copy(), root.T.copy(), np.empty(3)
        new_center, new_turned = np.empty(n), np.empty((n, n))
        kept = [Buffered(self.step(n, component)) for component in range(self._components)]
        inputs, outputs = (points, data, w, center, turned), (new_center, new_turned, figures)
        steps = [step.bound(inputs, outputs) for step in kept]
        x0, scale, reach = rows.x0, rows.scale, math.sqrt(n)
        sights = [(columns, x0[columns], scale[columns], reach * scale[columns, None]) for columns in rows.columns]
        weights, stop = rows.weight.ravel(), count
        for r in range(first, count):
            sample, component = divmod(r, self._components)
            columns, base, unit, reached = sights[rows.pattern[sample]]
            z, spread = (base + unit * center[columns])[:, None], turned.T[columns] * reached
            np.add(z, spread, out=up)
            np.subtract(z, spread, out=down)
            data[:], w[0] = once[sample], weights[r]
            steps[component]()
            if not figures[2] > LEAST_LEFT:
                stop = r
                break
            center[:], turned[:], trace[r] = new_center, new_turned, figures
            means[r] = center
        mean[:], root[:] = center, turned.T
        return stop, means, trace[:, 0], trace[:, 1]

    def step(self, n: int, component: int) -> ca.Function:
        """One row, in coordinates (x - x0) / scale: eqs (15)-(24) of arXiv:2208.02652 as corrected.

        (cubature points of z, constants and data, weight, mean, S) to mean and S after it, and three figures: the
        innovation, its standard deviation, and the part of a variance that is left.
        """
        if (n, component) not in self._steps:
            points, once, w = ca.MX.sym("z", 2 * n, self._unknowns), ca.MX.sym("p", self._once), ca.MX.sym("w")
            mean, root = ca.MX.sym("mean", n), ca.MX.sym("root", n, n)
            e = w * self._residual(component, points, once)
            average = ca.sum1(e) / (2 * n)
            std = ca.sqrt(1 + ca.sumsqr(e - average) / (2 * n))
            u = (e[:n] - e[n:]) / (2 * math.sqrt(n) * std)
            left = 1 - ca.mtimes(ca.DM(np.tril(np.ones((n, n)))), u**2)
            before = ca.vertcat(1, left)[:n]
            split = (ca.vertsplit(each) for each in (u, ca.sqrt(left / before), u / ca.sqrt(left * before)))
            turned, beyond = [], ca.MX.zeros(n, 1)
            for column, part, up, down in zip(*map(reversed, (ca.horzsplit(root), *split)), strict=True):
                turned.append(column * up - beyond * down)
                beyond = beyond + column * part
            figures = ca.vertcat(-average, std, left[-1])
            outputs = [mean - beyond * (average / std), ca.horzcat(*reversed(turned)), figures]
            self._steps[n, component] = ca.Function("step", [points, once, w, mean, root], outputs)
        return self._steps[n, component]

    def _residual(self, component: int, points: ca.MX, once: ca.MX) -> ca.MX:
        """One component of the residual, a column over points of z."""
        if self._program is None:
            return mapped(self._turned, once, points)[component]
        columns = ca.horzsplit(points)
        lanes = ca.horzcat(*(columns[self._program.operations[value].element[1]] for value in self._program.lanes))
        (e,) = replayed(self._program, [self._program.outputs[0][component]], once, lanes)
        return e

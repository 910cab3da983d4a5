"""The filters' passes over rows: as compiled C, or on CasADi's virtual machine."""

from __future__ import annotations

import ctypes
import math
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.kernels.block_rows import Buffered, replayed
from casacal.kernels.c_source import filter_source
from casacal.kernels.lanes import PAD
from casacal.kernels.libraries import load_library
from casacal.kernels.native_rows import PackedPieces
from casacal.kernels.reading import read_program
from casacal.least_squares.linalg import LEAST_LEFT

Integers: TypeAlias = NDArray[np.integer[Any]]


class NativeCubature:
    """`cubature_pass` of a residual function of (z, c, d), in C: states innermost, an exact downdate in place of a QR.

    Raises CompilerError when it cannot be printed or compiled.
    """

    def __init__(self, residual: ca.Function) -> None:
        program = read_program(residual, ("lane", "once", "once"), ahead=False)
        self.unknowns, self.components = residual.numel_in(0), residual.numel_out(0)
        once = residual.numel_in(1) + residual.numel_in(2)
        self._pass = load_library(filter_source(program, self.unknowns, once), ("cubature_pass",)).cubature_pass
        long, pointer = ctypes.c_long, ctypes.c_void_p
        self._pass.argtypes = [long, long, long, *[pointer] * 6, ctypes.c_double, *[pointer] * 6]
        self._pass.restype = long

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
        """Take in residuals from `first` on, changing mean and root in place.

        Args:
            first: scalar residual to begin with.
            pattern: of each sample (N,).
            columns: positions in x of z, by pattern (patterns, z).
            x0, scale: (n,), of the coordinates.
            once: constants and data of each sample (N, c + d).
            weight: 1 / noise of each residual (N, m).
            mean, root: belief (n,), (n, n) lower triangular.

        Returns the first residual that was not taken in, or their number; and, by residual, means (N m, n),
        innovations and their standard deviations (N m,).

        """
        n, rows = x0.size, weight.size
        means, innovations, stds = np.empty((rows, n)), np.empty(rows), np.empty(rows)
        lanes = -(-2 * n // PAD) * PAD
        work = np.empty(lanes * (self.unknowns + self.components) + 4 * n)
        arrays: list[NDArray[Any]] = [np.ascontiguousarray(each, dtype=ctypes.c_long) for each in (pattern, columns)]
        arrays += [np.ascontiguousarray(each) for each in (x0, scale, once, weight)]
        belief = (mean, root, means, innovations, stds, work)
        at = [each.ctypes.data for each in (*arrays, *belief)]
        stopped = self._pass(first, rows, n, *at[:6], LEAST_LEFT, *at[6:])
        return int(stopped), means, innovations, stds


def extended_pass(
    packed: PackedPieces, place: NDArray[np.intp], x0: Array, scale: Array, mean: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """The extended filter: take in all rows, changing mean and covariance in place.

    A row is evaluated with as many lanes as C pads to.

    Args:
        packed: pieces that together hold the rows.
        place: piece, lane in it and component of each row (rows, 3).
        x0, scale: (n,), of the coordinates (x - x0) / scale.
        mean, covariance: belief (n,), (n, n).

    Returns means (rows, n) after each row, innovations and their standard deviations (rows,).

    """
    n, rows = x0.size, len(place)
    run, long, pointer = packed.compiled.extended_pass, ctypes.c_long, ctypes.c_void_p
    run.argtypes, run.restype = [long, long, *[pointer] * 10], None
    means, innovations, stds = np.empty((rows, n)), np.empty(rows), np.empty(rows)
    needed = (
        piece.parameters + PAD * (len(piece.lanes.d) + piece.kernels.components * (piece.kernels.unknowns + 1))
        for piece in packed.pieces
    )
    given = (np.ascontiguousarray(place, dtype=ctypes.c_long), np.ascontiguousarray(x0), np.ascontiguousarray(scale))
    made = (mean, covariance, means, innovations, stds, np.empty(max(needed) + 4 * n))
    run(rows, n, packed.address(0), *(each.ctypes.data for each in (*given, *made)))
    return means, innovations, stds


class BlockCubature:
    """The filter's pass for a residual function of (z, c, d); called as `NativeCubature` is."""

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
        """Take in residuals from `first` on, changing mean and root in place; see `NativeCubature`."""
        n, rows = x0.size, weight.size
        means, trace = np.empty((rows, n)), np.empty((rows, 3))
        # what a step reads and writes stays in place, so that CasADi is told where only once; S column by column
        points, data, w = np.empty((self.unknowns, 2 * n)), np.empty(once.shape[1]), np.empty(1)
        up, down = points[:, :n], points[:, n:]
        center, turned, figures = mean.copy(), root.T.copy(), np.empty(3)
        new_center, new_turned = np.empty(n), np.empty((n, n))
        kept = [Buffered(self.step(n, component)) for component in range(self.components)]
        inputs, outputs = (points, data, w, center, turned), (new_center, new_turned, figures)
        steps = [step.bound(inputs, outputs) for step in kept]
        sights = [(seen, x0[seen], scale[seen], math.sqrt(n) * scale[seen, None]) for seen in columns]
        weights, stop = weight.ravel(), rows
        for r in range(first, rows):
            sample, component = divmod(r, self.components)
            seen, base, unit, reach = sights[pattern[sample]]
            z, spread = (base + unit * center[seen])[:, None], turned.T[seen] * reach
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

        (cubature points of z, constants and data, weight, mean, S) to the mean and S after it, and innovation, its
        standard deviation, and the part of a variance that is left.
        """
        if (n, component) not in self._steps:
            points, once, w = ca.MX.sym("z", 2 * n, self.unknowns), ca.MX.sym("p", self._once), ca.MX.sym("w")
            mean, root = ca.MX.sym("mean", n), ca.MX.sym("root", n, n)
            read = [self._program.operations[value].element[1] for value in self._program.lanes]
            columns = ca.horzsplit(points)
            lanes = ca.horzcat(*(columns[k] for k in read))
            (e,) = replayed(self._program, [self._program.outputs[0][component]], once, lanes)
            e = w * e
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

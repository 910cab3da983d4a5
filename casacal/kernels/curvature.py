"""Half a weighted sum of squares with exact gradient and Hessian, summed over rows in blocks by CasADi's machine."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.kernels.block_rows import Buffered, product, replayed
from casacal.kernels.lanes import BlockLanes, lane_data
from casacal.kernels.reading import read_program
from casacal.threads import shared_out

TOGETHER = 16
"""Blocks that one thread sums up at a time."""


class CurvatureKernel:
    """|We|^2 / 2, its gradient and its Hessian by v, for a residual (v, c, d) -> e (m) and rows of d and weights W.

    The Hessian is J'WWJ, one matrix product a block, and sum w^2 e d2e/dv2, of which only the upper triangle's entries
    that are not zero are evaluated. Of the last `linear` of v, small effects about zero, second derivatives are left
    out, and the others' are taken where these are zero: steps need no more.
    """

    def __init__(self, residual: ca.Function, *, linear: int = 0) -> None:
        v, c, d = (ca.SX.sym(name, residual.numel_in(i)) for i, name in enumerate("vcd"))
        e = residual(v, c, d)
        slopes = ca.jacobian(e, v)
        curving = v.numel() - linear
        curved = residual(ca.vertcat(v[:curving], ca.SX.zeros(linear)), c, d)
        bends = [ca.triu(ca.hessian(curved[m], v[:curving])[0]) * e[m] for m in range(e.numel())]
        pattern = ca.Sparsity(curving, curving)
        for bend in bends:
            pattern = pattern + bend.sparsity()
        self.unknowns, self.components, self._constants = v.numel(), e.numel(), c.numel()
        self._rows, self._columns = (np.array(index, dtype=np.intp) for index in pattern.get_triplet())
        bent = [ca.project(bend, pattern).nz[:] for bend in bends]
        outputs = [ca.densify(each) for each in ca.cse([e, slopes.T, ca.vertcat(*bent, ca.SX(0, 1))])]
        self._program = read_program(ca.Function("curved", [v, c, d], outputs), ("once", "once", "lane"))
        self._built: dict[int, Buffered] = {}

    def lanes(self, data: Array, noise: Array) -> BlockLanes:
        """Rows of data (n, columns) with standard deviations (n, m) of their residuals, packed once for all calls."""
        empty = np.zeros(0)
        return BlockLanes.of(lane_data(self._program, [empty, empty, data.T], len(data)), 1.0 / noise.T)

    def __call__(
        self, v: Array, constants: Array, lanes: BlockLanes, *, threads: int = 1
    ) -> tuple[float, Array, Array]:
        """Cost, gradient (z,) and Hessian (z, z) at v (z,), with the rows' common constants c.

        Threads change no digit: blocks are summed up in groups, and the groups in order.
        """
        z, p = self.unknowns, np.concatenate([v, constants])
        groups = [slice(k, k + TOGETHER) for k in range(0, len(lanes.d), TOGETHER)]
        parts = shared_out(lambda some: self._sums(p, lanes.d[some], lanes.w[some]), groups, threads)
        s, bent = (np.sum(each, axis=0) for each in zip(*parts, strict=True))
        bend = np.zeros((z, z))
        bend[self._rows, self._columns] = bent
        return float(s[-1, -1]) / 2, s[:-1, -1], s[:-1, :-1] + bend + np.triu(bend, 1).T

    def _sums(self, p: Array, d: Array, w: Array) -> tuple[Array, Array]:
        """Normal matrix of slopes and residual, and entries of the bend, of some blocks."""
        width = d.shape[2]
        if width not in self._built:  # threads that come at once may build it twice, alike
            self._built[width] = Buffered(self._block(width))
        evaluate = self._built[width]
        s, bent = np.zeros((self.unknowns + 1, self.unknowns + 1)), np.zeros(self._rows.size)
        weighted, others = np.empty((self.components, self.unknowns + 1, width)), np.empty_like(bent)
        for one, weights in zip(d, w, strict=True):
            evaluate((p, one, weights), (weighted, others))
            for each in weighted:  # NumPy's product is many times faster than CasADi's
                s += each @ each.T
            bent += others
        return s, bent

    def _block(self, width: int) -> ca.Function:
        """(p, d, w) -> weighted slopes and residual by component, entries of the bend; of one block."""
        z, count = self.unknowns, self._rows.size
        p = ca.MX.sym("p", z + self._constants)
        d, w = ca.MX.sym("d", width, len(self._program.lanes)), ca.MX.sym("w", width, self.components)
        values = [value for output in self._program.outputs for value in output]
        columns = ca.horzcat(*replayed(self._program, values, p, d))
        e, j, bent = ca.horzsplit(columns, [0, self.components, self.components * (z + 1), columns.shape[1]])
        weighted, bend = [], ca.MX.zeros(count, 1)
        for m in range(self.components):
            weighted.append(ca.horzcat(j[:, m * z : (m + 1) * z], e[:, m]) * w[:, m])
            bend += product(bent[:, m * count : (m + 1) * count].T, w[:, m] ** 2)
        return ca.Function("block", [p, d, w], [ca.horzcat(*weighted), bend])

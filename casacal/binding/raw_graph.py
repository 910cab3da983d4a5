"""The objective in raw coordinates (free normals, quaternions) with constraints, as the IPOPT reference solves it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.slots import Block, Slot
from casacal.kernels.curvature import CurvatureKernel
from casacal.kernels.lanes import BlockLanes
from casacal.kernels.replay import Buffered
from casacal.unknowns import Unknown


@dataclass(frozen=True)
class RawBlock:
    """Rows that see the same raw coordinates."""

    kernel: CurvatureKernel
    """Cost, gradient and Hessian of the rows' raw residual."""
    columns: NDArray[np.intp]
    """Positions of the kernel's v in the whole raw vector."""
    constants: Array
    """What else the rows share (nc,)."""
    data: Array
    """d by row (N, nd)."""
    noise: Array
    """Standard deviation of each residual (N, m)."""
    threads: int = 1
    """How many share the rows."""

    @cached_property
    def lanes(self) -> BlockLanes:
        """The rows as the kernel reads them."""
        return self.kernel.lanes(self.data, self.noise)

    def __call__(self, v: Array) -> tuple[float, Array, Array]:
        """Cost of the rows, its gradient (z,) and Hessian (z, z) by what they see of v (n,)."""
        return self.kernel(v[self.columns], self.constants, self.lanes, threads=self.threads)


@dataclass(frozen=True)
class RawGraph:
    """All rows in raw coordinates, with what makes raw coordinates valid."""

    blocks: tuple[RawBlock, ...]
    start: Array
    """Raw coordinates of the nominal."""
    constraints: ca.Function
    """v -> g, zero where v is valid."""
    local: ca.Function
    """v -> x, the local coordinates that other estimators use."""

    @cached_property
    def prior(self) -> Buffered:
        """(v, information (n,), x0 (n,)) -> half the prior's weighted square, its gradient and Hessian by v."""
        v, x0 = ca.SX.sym("v", self.start.size), ca.SX.sym("x0", self.local.numel_out(0))
        information = ca.SX.sym("information", x0.numel())
        hessian, gradient = ca.hessian(cost := ca.dot(information, (self.local(v) - x0) ** 2) / 2, v)
        terms = [ca.densify(term) for term in ca.cse([cost, gradient, hessian])]
        return Buffered(ca.Function("prior", [v, information, x0], terms))

    @cached_property
    def bend(self) -> Buffered:
        """(v, multipliers) -> Hessian by v of the constraints times their multipliers."""
        v, multipliers = ca.SX.sym("v", self.start.size), ca.SX.sym("lam", self.constraints.numel_out(0))
        hessian, _ = ca.hessian(ca.dot(multipliers, self.constraints(v)), v)
        return Buffered(ca.Function("bend", [v, multipliers], [ca.densify(hessian)]))

    @staticmethod
    def of(slots: Sequence[Slot], blocks: Sequence[Block], threads: int) -> RawGraph:
        """Graph of bound rows: those that see the same unknowns stand together."""
        starts = np.cumsum([0] + [slot.unknown.raw_size for slot in slots])
        first = {slot.name: int(start) for slot, start in zip(slots, starts, strict=False)}
        found = []
        for block in blocks:
            for i, seen in enumerate(block.slots):
                rows = np.flatnonzero(block.pattern == i)
                columns = [first[s.name] + j for s in seen for j in range(s.unknown.raw_size)]
                position = np.array(columns, dtype=np.intp)
                kernel, constants = block.model.curvature, block.constants[i]
                found.append(RawBlock(kernel, position, constants, block.rows(rows), block.noise[rows], threads))
        return RawGraph.build([(slot.unknown, slot.nominal) for slot in slots], found)

    @staticmethod
    def build(unknowns: Sequence[tuple[Unknown, Array]], blocks: Sequence[RawBlock]) -> RawGraph:
        """Graph of unknowns, each with its nominal, in the order in which they stand in x."""
        symbols = [ca.SX.sym(f"v{i}", unknown.raw_size) for i, (unknown, _) in enumerate(unknowns)]
        pairs = [(u, n, s) for (u, n), s in zip(unknowns, symbols, strict=True)]
        v = ca.vertcat(*symbols)
        constraints = [g for u, _, s in pairs for g in u.raw_constraints(s)]
        local = [u.raw_local(n, s) for u, n, s in pairs if u.size]
        return RawGraph(
            blocks=tuple(blocks),
            start=np.concatenate([u.raw_start(n) for u, n, _ in pairs]),
            constraints=ca.Function("constraints", [v], [ca.densify(ca.vertcat(*constraints, ca.SX(0, 1)))]),
            local=ca.Function("local", [v], [ca.densify(ca.vertcat(*local, ca.SX(0, 1)))]),
        )

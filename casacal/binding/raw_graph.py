"""The objective in raw coordinates (free normals, quaternions) with constraints, as the IPOPT reference solves it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.blocks import Block
from casacal.binding.slots import Slot
from casacal.kernels.block_rows import Buffered
from casacal.kernels.curvature import CurvatureKernel
from casacal.kernels.lanes import BlockLanes
from casacal.tables.columns import rows_by_code
from casacal.unknowns import Parameter, Unknown

Places: TypeAlias = tuple[NDArray[np.intp], NDArray[np.intp]]


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
    unknowns: tuple[tuple[Unknown, Array], ...]
    """Each with its nominal, in the order in which they stand in x."""

    @cached_property
    def prior(self) -> Buffered:
        """(v, information (n,), x0 (n,)) -> half the prior's weighted square, its gradient, its Hessian's entries."""
        return Buffered(self._prior)

    @cached_property
    def prior_places(self) -> Places:
        """Rows and columns of those entries, of the upper triangle."""
        return _places(self._prior.sparsity_out(2))

    @cached_property
    def _prior(self) -> ca.Function:
        terms = []
        for numbers, some in itertools.groupby(self.unknowns, lambda pair: isinstance(pair[0], Parameter)):
            together = list(some)
            terms += [_prior_of_numbers(together)] if numbers else [_prior_of(*pair) for pair in together]
        v, information, x0, cost, gradient, hessian = zip(*terms, strict=True)
        given = [ca.vertcat(*each) for each in (v, information, x0)]
        total = ca.densify(ca.sum1(ca.vertcat(*cost)))
        return ca.Function("prior", given, [total, ca.densify(ca.vertcat(*gradient)), ca.diagcat(*hessian)])

    @cached_property
    def bend(self) -> Buffered:
        """(v, multipliers) -> entries of the Hessian by v of the constraints times their multipliers."""
        return Buffered(self._bend)

    @cached_property
    def bend_places(self) -> Places:
        """Rows and columns of those entries, of the upper triangle."""
        return _places(self._bend.sparsity_out(0))

    @cached_property
    def _bend(self) -> ca.Function:
        v, multipliers = ca.SX.sym("v", self.start.size), ca.SX.sym("lam", self.constraints.numel_out(0))
        hessian, _ = ca.hessian(ca.dot(multipliers, self.constraints(v)), v)
        return ca.Function("bend", [v, multipliers], [ca.triu(hessian)])

    @staticmethod
    def of(slots: Sequence[Slot], blocks: Sequence[Block], threads: int) -> RawGraph:
        """Graph of bound rows: those that see the same unknowns stand together."""
        starts = np.cumsum([0] + [slot.unknown.raw_size for slot in slots])
        first = {slot.name: int(start) for slot, start in zip(slots, starts, strict=False)}
        found = []
        for block in blocks:
            of_each = rows_by_code(block.pattern, len(block.slots))
            for i, (seen, rows) in enumerate(zip(block.slots, of_each, strict=True)):
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
            unknowns=tuple(unknowns),
        )


def _prior_of(unknown: Unknown, nominal: Array) -> tuple[ca.SX, ...]:
    """Symbols v, information and x0 of one unknown; its part of the prior's cost, gradient and upper Hessian."""
    v = ca.SX.sym("v", unknown.raw_size)
    if np.isinf(unknown.prior_stds).all():  # as faces mostly are
        told = ca.SX.sym("information", unknown.size), ca.SX.sym("x0", unknown.size)
        return v, *told, ca.SX(1, 1), ca.SX.zeros(unknown.raw_size), ca.SX(unknown.raw_size, unknown.raw_size)
    information, x0 = ca.SX.sym("information", unknown.size), ca.SX.sym("x0", unknown.size)
    cost = ca.dot(information, (unknown.raw_local(nominal, v) - x0) ** 2) / 2 if unknown.size else ca.SX(0)
    hessian, gradient = ca.hessian(cost, v)
    return v, information, x0, *ca.cse([cost, gradient, ca.triu(hessian)])


def _prior_of_numbers(some: Sequence[tuple[Unknown, Array]]) -> tuple[ca.SX, ...]:
    """The same of parameters together, whose v less their nominal is linear: no derivative is asked for."""
    nominal = np.concatenate([unknown.raw_start(its) for unknown, its in some])
    v, information, x0 = (ca.SX.sym(name, nominal.size) for name in ("v", "information", "x0"))
    away = v - nominal - x0
    return v, information, x0, ca.dot(information, away**2) / 2, information * away, ca.diag(information)


def _places(pattern: ca.Sparsity) -> Places:
    rows, columns = pattern.get_triplet()
    return np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp)

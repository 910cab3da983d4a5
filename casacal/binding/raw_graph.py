"""The objective in raw coordinates (free normals, quaternions) with constraints, as the IPOPT reference solves it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from casacal.array_types import Array, Index
from casacal.binding.blocks import Block
from casacal.binding.slots import Slot
from casacal.kernels.block_rows import Buffered, CurvatureKernel
from casacal.kernels.rows import Lanes
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares
from casacal.unknowns import Parameter

Places: TypeAlias = tuple[Index, Index]


@dataclass(frozen=True)
class RawBlock:
    """Rows that see the same raw coordinates."""

    kernel: CurvatureKernel
    """Cost, gradient and Hessian of the rows' raw residual."""
    columns: Index
    """Positions of the kernel's v in the whole raw vector."""
    constants: Array
    """What else the rows share (nc,)."""
    lanes: Lanes
    """The rows as the kernel reads them."""
    threads: int
    """How many share the rows."""

    def __call__(self, v: Array, loss: Loss | None = None) -> tuple[float, Array, Array]:
        """Cost of the rows, its gradient (z,) and Hessian (z, z) by what they see of v (n,)."""
        return self.kernel(v[self.columns], self.constants, self.lanes, loss=loss, threads=self.threads)


class RawGraph:
    """All rows in raw coordinates, with what makes these valid: attributes as of `casacal.estimators.ipopt.RawForm`."""

    def __init__(self, slots: Sequence[Slot], blocks: Sequence[Block], threads: int, problem: LeastSquares) -> None:
        starts = np.cumsum([0] + [slot.unknown.raw_size for slot in slots])
        first = {slot.name: int(start) for slot, start in zip(slots, starts, strict=False)}
        found = []
        for block in blocks:
            for seen, constants, rows in zip(block.slots, block.constants, block.by_pattern, strict=True):
                columns = [first[s.name] + j for s in seen for j in range(s.unknown.raw_size)]
                kernel, there = block.model.curvature, np.array(columns, dtype=np.intp)
                lanes = kernel.lanes(block.rows(rows), block.noise[rows])
                found.append(RawBlock(kernel, there, constants, lanes, threads))
        free = [slot for slot in slots if slot.unknown.size]
        self.blocks, self.start = tuple(found), np.concatenate([s.unknown.raw_start(s.nominal) for s in free])
        symbols = [ca.SX.sym(slot.name, slot.unknown.raw_size) for slot in slots]
        pairs, v, none = list(zip(slots, symbols, strict=True)), ca.vertcat(*symbols), ca.SX(0, 1)
        valid = ca.densify(ca.vertcat(*(g for s, symbol in pairs for g in s.unknown.raw_constraints(symbol)), none))
        local = (s.unknown.raw_local(s.nominal, symbol) for s, symbol in pairs if s.unknown.size)
        self.constraints = ca.Function("constraints", [v], [valid])
        self.local = ca.Function("local", [v], [ca.densify(ca.vertcat(*local, none))])
        self.prior, self.prior_places = _by_entries(_prior(slots, problem), 2)
        multipliers = ca.SX.sym("lam", valid.numel())
        hessian, _ = ca.hessian(ca.dot(multipliers, valid), v)
        self.bend, self.bend_places = _by_entries(ca.Function("bend", [v, multipliers], [ca.triu(hessian)]), 0)


def _by_entries(function: ca.Function, i: int) -> tuple[Buffered, Places]:
    """A function, and the rows and columns of the entries of its output i."""
    rows, columns = (np.array(index, dtype=np.intp) for index in function.sparsity_out(i).get_triplet())
    return Buffered(function), (rows, columns)


def _prior(slots: Sequence[Slot], problem: LeastSquares) -> ca.Function:
    """v -> the prior's cost, gradient and upper Hessian: unknowns that are known together are one piece of it."""
    pieces, whole, x0 = list[tuple[ca.SX, ...]](), problem.prior_information, problem.x0
    alone = problem.known is None
    for numbers, some in itertools.groupby(slots, lambda slot: alone and isinstance(slot.unknown, Parameter)):
        for together in [list(some)] if numbers or not alone else [[slot] for slot in some]:
            first = together[0].first
            here = slice(first, first + sum(slot.unknown.size for slot in together))
            pieces.append(_prior_of(together, whole[here, here], x0[here]))
    v, cost, gradient, hessian = zip(*pieces, strict=True)
    total = ca.densify(ca.sum1(ca.vertcat(*cost)))
    return ca.Function("prior", [ca.vertcat(*v)], [total, ca.densify(ca.vertcat(*gradient)), ca.diagcat(*hessian)])


def _prior_of(some: Sequence[Slot], information: Array, x0: Array) -> tuple[ca.SX, ...]:
    """Symbols v of some unknowns; their part of the prior's cost, gradient and upper Hessian."""
    v = ca.SX.sym("v", sum(slot.unknown.raw_size for slot in some))
    if not information.any():  # as faces mostly are
        return v, ca.SX(1, 1), ca.SX.zeros(v.numel()), ca.SX(v.numel(), v.numel())
    starts = np.cumsum([0, *(slot.unknown.raw_size for slot in some)])
    parts = [(slot, v[a:b]) for slot, a, b in zip(some, starts, starts[1:], strict=False) if slot.unknown.size]
    away = ca.vertcat(*(slot.unknown.raw_local(slot.nominal, part) for slot, part in parts)) - ca.DM(x0)
    pull = ca.mtimes(ca.sparsify(ca.DM(information)), away)
    cost = ca.dot(away, pull) / 2
    hessian, gradient = ca.hessian(cost, v)
    return v, *ca.cse([cost, gradient, ca.triu(hessian)])

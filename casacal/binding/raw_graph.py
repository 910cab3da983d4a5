"""The objective in raw coordinates (free normals, quaternions) with constraints, as the IPOPT reference solves it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np

from casacal.array_types import Array, Index
from casacal.binding.blocks import Block
from casacal.binding.slots import Slot
from casacal.kernels.block_rows import Buffered, CurvatureKernel
from casacal.kernels.rows import Lanes
from casacal.least_squares.losses import Loss
from casacal.unknowns import Parameter, Unknown

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
    data: Array
    """d by row (N, nd)."""
    noise: Array
    """Standard deviation of each residual (N, m)."""
    threads: int
    """How many share the rows."""

    @cached_property
    def lanes(self) -> Lanes:
        """The rows as the kernel reads them."""
        return self.kernel.lanes(self.data, self.noise)

    def __call__(self, v: Array, loss: Loss | None = None) -> tuple[float, Array, Array]:
        """Cost of the rows, its gradient (z,) and Hessian (z, z) by what they see of v (n,)."""
        return self.kernel(v[self.columns], self.constants, self.lanes, loss=loss, threads=self.threads)


class RawGraph:
    """All rows in raw coordinates, with what makes raw coordinates valid.

    start: raw coordinates of the nominal. constraints: v -> g, zero where v is valid. local: v -> x, the local
    coordinates that other estimators use. prior: (v, information (n,), x0 (n,)) -> half the prior's weighted square,
    its gradient, its Hessian's entries, at the rows and columns `prior_places` of the upper triangle. bend: (v,
    multipliers) -> entries of the Hessian by v of the constraints times their multipliers, at `bend_places`.
    """

    def __init__(self, slots: Sequence[Slot], blocks: Sequence[Block], threads: int) -> None:
        starts = np.cumsum([0] + [slot.unknown.raw_size for slot in slots])
        first = {slot.name: int(start) for slot, start in zip(slots, starts, strict=False)}
        found = []
        for block in blocks:
            for seen, constants, rows in zip(block.slots, block.constants, block.by_pattern, strict=True):
                columns = [first[s.name] + j for s in seen for j in range(s.unknown.raw_size)]
                there, noise = np.array(columns, dtype=np.intp), block.noise[rows]
                found.append(RawBlock(block.model.curvature, there, constants, block.rows(rows), noise, threads))
        self.blocks, self.start = tuple(found), np.concatenate([s.unknown.raw_start(s.nominal) for s in slots])
        symbols = [ca.SX.sym(slot.name, slot.unknown.raw_size) for slot in slots]
        pairs, v, none = list(zip(slots, symbols, strict=True)), ca.vertcat(*symbols), ca.SX(0, 1)
        valid = ca.densify(ca.vertcat(*(g for s, symbol in pairs for g in s.unknown.raw_constraints(symbol)), none))
        local = (s.unknown.raw_local(s.nominal, symbol) for s, symbol in pairs if s.unknown.size)
        self.constraints = ca.Function("constraints", [v], [valid])
        self.local = ca.Function("local", [v], [ca.densify(ca.vertcat(*local, none))])
        self.prior, self.prior_places = _by_entries(_prior(slots), 2)
        multipliers = ca.SX.sym("lam", valid.numel())
        hessian, _ = ca.hessian(ca.dot(multipliers, valid), v)
        self.bend, self.bend_places = _by_entries(ca.Function("bend", [v, multipliers], [ca.triu(hessian)]), 0)


def _by_entries(function: ca.Function, i: int) -> tuple[Buffered, Places]:
    """A function, and the rows and columns of the entries of its output i."""
    rows, columns = (np.array(index, dtype=np.intp) for index in function.sparsity_out(i).get_triplet())
    return Buffered(function), (rows, columns)


def _prior(slots: Sequence[Slot]) -> ca.Function:
    terms = []
    for numbers, some in itertools.groupby(slots, lambda slot: isinstance(slot.unknown, Parameter)):
        together = list(some)
        terms += (
            [_prior_of_numbers(together)] if numbers else [_prior_of(slot.unknown, slot.nominal) for slot in together]
        )
    v, information, x0, cost, gradient, hessian = zip(*terms, strict=True)
    given = [ca.vertcat(*each) for each in (v, information, x0)]
    total = ca.densify(ca.sum1(ca.vertcat(*cost)))
    return ca.Function("prior", given, [total, ca.densify(ca.vertcat(*gradient)), ca.diagcat(*hessian)])


def _prior_of(unknown: Unknown, nominal: Array) -> tuple[ca.SX, ...]:
    """Symbols v, information and x0 of one unknown; its part of the prior's cost, gradient and upper Hessian."""
    v, size = ca.SX.sym("v", unknown.raw_size), unknown.raw_size
    information, x0 = ca.SX.sym("information", unknown.size), ca.SX.sym("x0", unknown.size)
    if np.isinf(unknown.prior_stds).all():  # as faces mostly are
        return v, information, x0, ca.SX(1, 1), ca.SX.zeros(size), ca.SX(size, size)
    cost = ca.dot(information, (unknown.raw_local(nominal, v) - x0) ** 2) / 2 if unknown.size else ca.SX(0)
    hessian, gradient = ca.hessian(cost, v)
    return v, information, x0, *ca.cse([cost, gradient, ca.triu(hessian)])


def _prior_of_numbers(some: Sequence[Slot]) -> tuple[ca.SX, ...]:
    """The same of parameters together, whose v less their nominal is linear: no derivative is asked for."""
    nominal = np.concatenate([slot.unknown.raw_start(slot.nominal) for slot in some])
    v, information, x0 = (ca.SX.sym(name, nominal.size) for name in ("v", "information", "x0"))
    away = v - nominal - x0
    return v, information, x0, ca.dot(information, away**2) / 2, information * away, ca.diag(information)

"""The objective in raw coordinates (free normals, quaternions) with constraints, as the IPOPT reference solves it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.kernels.curvature import CurvatureKernel, Lanes
from casacal.unknowns import Unknown

Array: TypeAlias = NDArray[np.float64]


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

    @cached_property
    def lanes(self) -> Lanes:
        """The rows as the kernel reads them."""
        return self.kernel.lanes(self.data, self.noise)


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

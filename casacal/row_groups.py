"""The rows of one instrument on their kernels: rows that see the same unknowns are evaluated together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.binding import Block
from casacal.losses import Loss

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Group:
    """Rows of one pattern: where they stand, which of x they see, their constants, their data as kernels read it."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    constants: Array
    lanes: Any
    square: tuple[NDArray[np.intp], ...]
    """Where the group's part of an n x n matrix stands."""

    def parameters(self, x: Array) -> Array:
        """What the kernels call p, at x (n,) or at many (m, n)."""
        if x.ndim == 1:
            return np.concatenate([x[self.columns], self.constants])
        constants = np.broadcast_to(self.constants, (len(x), self.constants.size))
        return np.concatenate([x[:, self.columns], constants], axis=1)


class RowGroups:
    """Residuals, slopes and their sums over all rows of a block."""

    def __init__(self, block: Block, backend: str | None) -> None:
        self.block, self._rows = block, block.model.rows(backend)

    @property
    def backend(self) -> str:
        """Name of the back end in use."""
        return self._rows.kernels.name

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Rows by pattern, packed for the kernels when first used."""
        block, found = self.block, []
        for i, (columns, constants) in enumerate(zip(block.columns, block.constants, strict=True)):
            rows = np.flatnonzero(block.pattern == i)
            if rows.size:
                lanes = self._rows.lanes([block.data[rows]], block.noise[rows])
                found.append(Group(rows, columns, constants, lanes, np.ix_(columns, columns)))
        return tuple(found)

    def residual(self, x: Array) -> Array:
        """Plain residuals (N, m)."""
        e = np.empty(self.block.noise.shape)
        for group in self.groups:
            e[group.rows] = self._rows.kernels.residual(group.parameters(x), group.lanes).T
        return e

    def slopes(self, x: Array) -> Iterator[tuple[Group, Array, Array]]:
        """Group by group, plain residuals (n, m) and slopes (n, m, z)."""
        for group in self.groups:
            e, j = self._rows.kernels.slopes(group.parameters(x), group.lanes)
            yield group, e.T, j.transpose(2, 0, 1)

    def costs(self, states: Array) -> Array:
        """Half the whitened sum of squares at many x (m, n): (m,)."""
        total = np.zeros(len(states))
        for group in self.groups:
            total += self._rows.kernels.costs(group.parameters(states), group.lanes)
        return total

    def normal(self, x: Array, loss: Loss | None = None) -> tuple[float, Array, Array]:
        """Half the whitened sum of squares, its gradient (n,), and J'J (n, n); with a loss, rows by their weights."""
        kernels = self._rows.kernels
        cost, gradient, information = 0.0, np.zeros(x.size), np.zeros((x.size, x.size))
        for group in self.groups:
            p, lanes = group.parameters(x), group.lanes
            if loss is not None:  # a weight on r^2 is its root on r
                noise = self.block.noise[group.rows].T
                r = kernels.residual(p, lanes) / noise
                lanes = kernels.reweighted(lanes, np.sqrt(loss.weight(r)) / noise)
                cost += float(loss.cost(r).sum())
            s = kernels.normal(p, lanes)
            cost += float(s[-1, -1]) / 2 if loss is None else 0.0
            gradient[group.columns] += s[:-1, -1]
            information[group.square] += s[:-1, :-1]
        return cost, gradient, information

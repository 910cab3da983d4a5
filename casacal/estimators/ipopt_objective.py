"""The reference's objective over raw coordinates, with exact gradient and Hessian, for IPOPT to ask about."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from casacal.array_types import Array, Index
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import LeastSquares


class RawRows(Protocol):
    """Rows that see the same raw coordinates."""

    columns: Index
    """Which of v they see (z,)."""

    def __call__(self, v: Array, loss: Loss | None = None) -> tuple[float, Array, Array]:
        """Cost of the rows at v (n,), its gradient (z,) and Hessian (z, z)."""


class RawForm(Protocol):
    """The symbolic form of a problem: its objective over raw coordinates v, and what makes them valid."""

    blocks: Sequence[RawRows]
    start: Array
    """v of the nominal."""
    constraints: Any
    """v -> g, zero where v is valid."""
    local: Any
    """v -> x, the local coordinates of the other estimators."""
    prior: Callable[..., Any]
    """(v, information, x0) -> cost of the prior, gradient, entries of the Hessian's upper triangle."""
    prior_places: tuple[Index, Index]
    """Rows and columns of those entries."""
    bend: Callable[..., Any]
    """(v, multipliers) -> entries of the Hessian of the constraints times their multipliers, upper triangle."""
    bend_places: tuple[Index, Index]
    """Rows and columns of those entries."""


class Objective:
    """The objective in scaled raw coordinates y, v = start + scales * y, with exact gradient and Hessian.

    Each coordinate is in units of its own conditional standard deviation at the start: gradients then vanish to
    rounding. All three are found together, once for each y that IPOPT asks about. Of the Hessian only what is not zero
    is held: unknowns of different faces never meet.
    """

    def __init__(
        self, graph: RawForm, problem: LeastSquares, loss: Loss | None = None, start: Array | None = None
    ) -> None:
        n = graph.start.size
        self._graph, self._problem, self._loss = graph, problem, loss
        self.start = graph.start if start is None else start
        # entries of the upper triangle, column by column, are known by column * n + row
        corners = [np.triu_indices(block.columns.size) for block in graph.blocks]
        meets = [np.sort(b.columns[np.array(ij)], axis=0) for b, ij in zip(graph.blocks, corners, strict=True)]
        others = [np.array([np.arange(n)] * 2), np.array(graph.prior_places), np.array(graph.bend_places)]
        keys = [columns * n + rows for rows, columns in [*meets, *others]]
        known = np.unique(np.concatenate(keys))
        self.columns, self.rows = np.divmod(known, n)
        *of_blocks, diagonal, self._prior, self._bend = (np.searchsorted(known, each) for each in keys)
        self._blocks = list(zip(graph.blocks, corners, of_blocks, strict=True))
        self.evaluations = 0
        cost, gradient, entries = self._evaluate(self.start)
        size = np.abs(entries[diagonal])
        self.scales = 1.0 / np.sqrt(np.where(size > 0, size, 1.0))
        self._at, self._found = np.zeros(n), (cost, self.scales * gradient, self._scaled(entries))

    def raw(self, y: Array) -> Array:
        """Raw coordinates v (n,)."""
        return np.asarray(self.start + self.scales * y)

    def __call__(self, y: Array) -> tuple[float, Array, Array]:
        """Value, gradient (n,) and the entries (pattern's) of the Hessian by y."""
        if not np.array_equal(y, self._at):
            cost, gradient, entries = self._evaluate(self.raw(y))
            self._at = y.copy()
            self._found = cost, self.scales * gradient, self._scaled(entries)
        return self._found

    def lagrangian(self, y: Array, factor: float, multipliers: Array) -> Array:
        """Entries of the Hessian by y of the objective times a factor and the constraints times their multipliers."""
        bent, entries = np.empty(self._bend.size), np.zeros(self.rows.size)
        self._graph.bend((self.raw(y), multipliers), (bent,))
        entries[self._bend] = bent
        return factor * self(y)[2] + self._scaled(entries)

    def _scaled(self, entries: Array) -> Array:
        return self.scales[self.rows] * entries * self.scales[self.columns]

    def _evaluate(self, v: Array) -> tuple[float, Array, Array]:
        self.evaluations += 1
        value, gradient, found = np.empty(1), np.empty(v.size), np.empty(self._prior.size)
        self._graph.prior((v,), (value, gradient, found))
        cost, entries = float(value[0]), np.zeros(self.rows.size)
        entries[self._prior] = found
        for block, corner, places in self._blocks:
            some, slope, bend = block(v, self._loss)
            cost += some
            gradient[block.columns] += slope  # no coordinate stands twice among those of a block
            entries[places] += bend[corner]
        return cost, gradient, entries

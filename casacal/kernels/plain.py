"""Kernels as CasADi maps a function over rows: the slowest form, for graphs that the others do not know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.kernels.batch import Batch

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Lanes:
    """Data of n rows (n, columns) and weights (m, n)."""

    n: int
    d: Array
    w: Array


class PlainKernels:
    """The four kernels of a row model by CasADi's own map."""

    name, shareable = "map", False

    def __init__(self, slopes: ca.Function, once: Sequence[int], roles: Sequence[str]) -> None:
        self.components = slopes.numel_out(0)
        self._batch, self._once, self._roles = Batch(slopes), np.cumsum(once)[:-1], roles
        self._lane = np.cumsum([slopes.numel_in(i) for i, role in enumerate(roles) if role == "lane"])[:-1]

    def lanes(self, d: Array, w: Array) -> Lanes:
        """Data (columns, n) and weights (m, n) as the kernels read them."""
        return Lanes(d.shape[1], np.ascontiguousarray(d.T), w)

    def reweighted(self, lanes: Lanes, w: Array) -> Lanes:
        """The same rows with other weights (m, n)."""
        return replace(lanes, w=w)

    def residual(self, p: Array, lanes: Lanes) -> Array:
        """Plain residuals (m, n)."""
        return self.slopes(p, lanes)[0]

    def slopes(self, p: Array, lanes: Lanes) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""
        once, lane = iter(np.split(p, self._once)), iter(np.split(lanes.d, self._lane, axis=1))
        e, j = self._batch(*(next(lane) if role == "lane" else next(once) for role in self._roles))
        return e.T, j.reshape(lanes.n, self.components, -1).transpose(1, 2, 0)

    def costs(self, states: Array, lanes: Lanes) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""
        return np.array([float(((lanes.w * self.residual(p, lanes)) ** 2).sum()) / 2 for p in states])

    def normal(self, p: Array, lanes: Lanes) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""
        e, j = self.slopes(p, lanes)
        weighted = np.concatenate([j, e[:, None]], axis=1) * lanes.w[:, None]
        return np.asarray(np.einsum("min,mjn->ij", weighted, weighted, optimize=True))

"""Constraints as estimators see them: values and slopes at any x, the way back onto them, and what they leave free.

NumPy alone. Equalities hold exactly; a bound counts as one where x lies on it. Nothing here knows of rows or priors.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from casacal.linalg import constrained_solution, null_basis
from casacal.values import Array, Index, Rows, Value

NEWTON = 50  # steps back onto the constraints within which one is there, or nowhere near
MET = 1e-8  # prior standard deviations off at which one more step of Newton's leaves nothing but rounding
ON_BOUND = 1e-6  # prior standard deviations from a bound within which x lies on it


@dataclass(frozen=True, eq=False)
class ConstraintSet(Value):
    """Quantities c(x) (m,) that lie between `low` and `high` (m,), both alike for an equality.

    evaluate: x (n,) -> c (m,) and its slopes (m, n). depends: mask (m, n), which unknowns
    each sees. scale: of x (n,), in which steps are short: its prior standard deviations, or where filters start.
    """

    names: tuple[str, ...]
    low: Array
    high: Array
    evaluate: Callable[[Array], tuple[Array, Array]]
    depends: Rows
    scale: Array

    @property
    def equalities(self) -> Rows:
        """Which are equalities (m,)."""
        return np.asarray(self.low == self.high, dtype=bool)

    def part(
        self, kept: Rows, free: Index | slice = slice(None), expand: Callable[[Array], Array] = np.asarray
    ) -> ConstraintSet:
        """Some of them (m,), in some unknowns, by position, with the others where `expand` puts them."""

        def evaluate(x: Array) -> tuple[Array, Array]:
            values, slopes = self.evaluate(expand(x))
            return values[kept], slopes[kept][:, free]

        names, depends = tuple(np.array(self.names)[kept].tolist()), self.depends[kept][:, free]
        return ConstraintSet(names, self.low[kept], self.high[kept], evaluate, depends, self.scale[free])

    def linearised(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """E, gap, B, least about x: to first order x + scale * s meets all where E s = gap and B s >= least."""
        values, slopes = self.evaluate(x)
        slopes, equal = slopes * self.scale, self.equalities
        below, above = ~equal & np.isfinite(self.low), ~equal & np.isfinite(self.high)
        least = np.concatenate([(self.low - values)[below], (values - self.high)[above]])
        return slopes[equal], (self.low - values)[equal], np.vstack([slopes[below], -slopes[above]]), least

    def stepped(self, x: Array, rows: Array, gradient: Array, damping: float) -> tuple[Array, Array] | None:
        """Where the step s of `constrained_solution` leads, back on the constraints, and s in units of `scale`."""
        if not (np.isfinite(rows).all() and np.isfinite(gradient).all()):
            return None
        step = constrained_solution(rows, gradient, damping, *self.linearised(x))
        there = None if step is None else self.restored(x + self.scale * step)
        return None if step is None or there is None else (there, step)

    def slack(self, x: Array) -> Array:
        """How far each is inside its lower and its upper end at x (2, m), in prior standard deviations."""
        values, slopes = self.evaluate(x)
        sizes = np.linalg.norm(slopes * self.scale, axis=1)
        return np.array([values - self.low, self.high - values]) / np.where(sizes > 0, sizes, 1.0)

    def restored(self, x: Array) -> Array | None:
        """An x (n,) near another that meets them all, by steps of Newton's, each the shortest; None where none does."""
        identity, none, arrived = np.eye(x.size), np.zeros(x.size), False
        for _ in range(NEWTON):
            off = -self.slack(x).min(initial=0.0)
            if arrived or not off > 0:
                return x if off <= MET else None
            arrived = bool(off <= MET)
            step = constrained_solution(identity, none, 0.0, *self.linearised(x)) if np.isfinite(off) else None
            if step is None:
                return None
            x = x + self.scale * step
        return None

    def on_ends(self, x: Array) -> Rows:
        """Which hold at x with no way out (m,): equalities, and bounds on which x lies."""
        return np.asarray(self.equalities | (np.abs(self.slack(x)).min(axis=0) <= ON_BOUND))

    def tangent(self, x: Array, active: Collection[str] | None = None) -> Array:
        """Columns (n, k) along which x may move: none leaves an equality, nor a bound that is `active`, by name.

        Without names bounds are active on which x lies.
        """
        held = self.on_ends(x) if active is None else self.equalities | np.isin(self.names, list(active))
        return null_basis(self.evaluate(x)[1][held], self.scale)[0]

    def multipliers(self, x: Array, gradient: Array) -> Array:
        """Multipliers l (m,) with gradient + A'l = 0 as nearly as can be, zero for bounds on which x does not lie."""
        held, found = self.on_ends(x), np.zeros(len(self.names))
        slopes = self.evaluate(x)[1][held] * self.scale
        found[held] = np.linalg.lstsq(slopes.T, -self.scale * gradient, rcond=None)[0]
        return found

    def redundant(self, x: Array) -> list[str]:
        """Names of the equalities that say at x what the others say; none where each says something of its own."""
        moved = self.equalities & np.asarray(self.depends.any(axis=1))
        names, slopes = np.array(self.names)[moved], self.evaluate(x)[1][moved]
        rank = null_basis(slopes, self.scale)[1]
        others = [null_basis(np.delete(slopes, k, axis=0), self.scale)[1] for k in range(len(names))]
        return [str(name) for name, left in zip(names, others, strict=True) if left == rank]

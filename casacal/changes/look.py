"""Fresh rows looked at once: what each cause would take off their chi-square, and whether that is chance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.changes.causes import Cause, causes_of, slopes_of
from casacal.changes.null import AllTests, row_bases
from casacal.changes.shifts import with_shifts
from casacal.changes.whitened import Whitened, seen_basis
from casacal.verification.fresh import Fresh

POWER = 0.9
"""Chance with which a change must be found to count as one that these rows would have shown."""

NEVER = {"rad": 0.05, "mm": 50.0}
"""A shift that nobody overlooks: what shows only beyond it does not show."""


@dataclass(frozen=True, eq=False)
class Look:
    """Rows, what may have changed, and the tests of it.

    chances: smallest over all, of each cause (c,), of single rows (N,), of everything. level: below which the smallest
    one is an alarm.
    """

    fresh: Fresh
    shifted: BoundProblem
    x: Array
    causes: tuple[Cause, ...]
    slopes: tuple[Array, ...]
    tests: AllTests
    level: float
    by_cause: Array
    by_row: Array
    overall: float

    @staticmethod
    def at(fresh: Fresh, noise_freedom: float, alarm: float, seed: int, shifted: BoundProblem | None = None) -> Look:
        """Of some rows; `shifted` where they are bound with shifts already."""
        shifted = with_shifts(fresh.bound) if shifted is None else shifted
        x = np.concatenate([fresh.x, np.zeros(shifted.unknowns - fresh.bound.unknowns)])
        parts = fresh.likelihood()
        whitened, causes = Whitened.of(*parts), causes_of(fresh, shifted)
        slopes = [whitened.of_columns(each) for each in slopes_of(shifted, x, causes, len(parts[0]))]
        bases = [seen_basis(each, cause.sizes) for each, cause in zip(slopes, causes, strict=True)]
        samples = len(fresh.bound.block.samples)
        rows = row_bases(whitened, samples, fresh.bound.rows // samples)
        tests = AllTests(whitened, bases, rows, noise_freedom)
        by_cause, by_row, overall = tests.chances(tests.falls(whitened.residual[None]))
        level = tests.level(alarm, seed)
        return Look(fresh, shifted, x, causes, tuple(slopes), tests, level, by_cause[0], by_row[0], float(overall[0]))

    def without(self, rows: NDArray[np.intp], alarm: float, seed: int) -> Look:
        """The same without some rows."""
        kept = np.delete(np.arange(len(self.fresh.bound.block.samples)), rows)
        fewer = replace(self.fresh, bound=self.fresh.bound.take(kept.tolist()))
        shifted = self.shifted.on(fewer.bound.block.samples)
        return Look.at(fewer, self.tests.noise, alarm, seed, shifted)

    @property
    def smallest(self) -> float:
        """The smallest of all chances."""
        return min(self.overall, float(self.by_cause.min(initial=1.0)), float(self.by_row.min(initial=1.0)))

    @property
    def alarm(self) -> bool:
        """Whether rows of an arm that has not changed are hardly like this."""
        return self.smallest < self.level

    def seen(self, k: int) -> bool:
        """Whether a cause shows in these rows at all."""
        return bool(self.tests.freedoms[k] > 0)

    def found_from(self, k: int) -> float:
        """Shift of a joint (rad, mm) that raises the alarm with a chance of 90 %; infinite where none does."""
        from scipy.special import fdtri, ndtri

        length = float(np.linalg.norm(self.slopes[k]))
        if not self.seen(k) or not length:
            return math.inf
        level, noise = max(self.level, 1e-12), self.tests.noise
        if math.isfinite(noise):
            least = math.sqrt(float(fdtri(1.0, noise, 1.0 - level)))
            spread = math.sqrt(1.0 + least**2 / (2 * noise))
        else:
            least, spread = -float(ndtri(level / 2)), 1.0
        size = (least + float(ndtri(POWER)) * spread) / length
        return size if size <= NEVER[self.causes[k].units[0]] else math.inf

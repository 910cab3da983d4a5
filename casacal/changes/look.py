"""What may have changed since a calibration, and what each cause would take off the chi-square of fresh rows.

A cause is a set of directions in which the rows would move. Rows are whitened to unit covariance, so that the fall of
their chi-square by a cause is chance or is not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri, ndtri

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.calibration.fresh import Fresh
from casacal.calibration.shifts import BASE, BASE_TURN, JOINTS, TOOL, TURN, shift_columns, with_shifts
from casacal.least_squares.linalg import svd
from casacal.uncertainty.fresh_rows import FreshRows, chances, seen_basis

USUAL = {"rad": 3e-3, "mm": 3.0}
"""A change that would surprise nobody: what tells a cause of one number from one of six that explains as much."""


@dataclass(frozen=True, eq=False)
class Cause:
    """One thing that may have changed.

    name: as people are told of it. kind: "joint", "tool", "base" or "place". columns: its unknowns (k,) in x of the
    shifted rows. units, labels: of each. place: number of the joint (0, ...), or -1.
    """

    name: str
    kind: str
    columns: NDArray[np.intp]
    units: tuple[str, ...]
    labels: tuple[str, ...]
    place: int = -1

    @property
    def sizes(self) -> Array:
        """Changes (k,) that would surprise nobody."""
        return np.array([USUAL.get(unit, 1.0) for unit in self.units])


def causes_of(fresh: Fresh, shifted: BoundProblem) -> tuple[Cause, ...]:
    """Every joint, the tool, the base, and each thing that was said to stand where it was calibrated."""
    found = []
    joints = shift_columns(shifted, JOINTS)
    for i, (axis, column) in enumerate(zip(shifted.problem.robot.axes, joints, strict=True)):
        unit = "rad" if axis.turns else "mm"
        found.append(Cause(f"joint {i + 1}", "joint", np.array([column]), (unit,), ("zero",), i))
    labels = ("x", "y", "z", "about x", "about y", "about z")
    turns_show = any(block.unit == "rad" for block in shifted.problem.instrument.blocks)  # as of a body's pose
    for name, keys in (("tool", (TOOL, TURN) if turns_show else (TOOL,)), ("base", (BASE, BASE_TURN))):
        columns = np.concatenate([shift_columns(shifted, key) for key in keys])
        units = (("mm",) * 3 + ("rad",) * 3)[: columns.size]
        found.append(Cause(name, name, columns, units, labels[: columns.size]))
    for slot in fresh.bound.slots:
        columns = np.array(slot.columns, dtype=np.intp)
        if slot.beside or not slot.datum or not columns.size or not fresh.known[columns].all():
            continue
        names = tuple(name.removeprefix(slot.name).lstrip("._") for name in slot.unknown.names(slot.name))
        found.append(Cause(slot.name, "place", columns, tuple(slot.unknown.units), names))
    return tuple(found)


DRAWS = 20_000  # sets of rows of an arm that has not changed: the rate of false alarms is met to 0.0007 at 1 %
AT_ONCE = 4_000_000  # numbers that are drawn at once
SPARE = 1e-6  # part of a row's residual that must be left to it for it to be judged by the others
POWER = 0.9  # chance with which a change must be found to count as one that these rows would have shown
NEVER = {"rad": 0.05, "mm": 50.0}  # a shift that nobody overlooks: what shows only beyond it does not show


def alone(fresh: FreshRows, k: int, per_row: int) -> Array:
    """Whitened directions (m, per_row) in which row k alone could be off."""
    found = np.zeros((len(fresh.residual), per_row))
    found[k * per_row + np.arange(per_row), np.arange(per_row)] = 1.0
    return fresh.whitened(found)


def row_bases(fresh: FreshRows, count: int, per_row: int) -> Array:
    """Orthonormal bases (rows, m, per_row) of what each row alone could be off by; zero where nobody could tell."""
    found = np.zeros((count, len(fresh.residual), per_row))
    for k in range(count):
        left, values, _ = svd(alone(fresh, k, per_row))
        found[k] = left * (values**2 > SPARE)
    return found


@dataclass(frozen=True, eq=False)
class AllTests:
    """All tests of fresh rows at once: of each cause, of single rows, and of everything.

    bases: of each cause (m, k). rows: of single rows, as `row_bases` has them. noise: degrees of freedom of the noise.
    white: whitened residual (m,) that is tested, if not that of the rows.
    """

    fresh: FreshRows
    bases: Sequence[Array]
    rows: Array
    noise: float
    white: Array | None = None

    @cached_property
    def freedoms(self) -> Array:
        """Directions of each cause that show."""
        return np.array([basis.shape[1] for basis in self.bases], dtype=np.float64)

    @cached_property
    def row_freedoms(self) -> Array:
        """Directions of each row that the others can judge."""
        return np.asarray(np.rint((self.rows**2).sum(axis=(1, 2))))

    @cached_property
    def judged(self) -> int:
        """How many rows the others can judge."""
        return int((self.row_freedoms > 0).sum())

    @cached_property
    def _every(self) -> Array:
        return np.hstack([*self.bases, *self.rows])

    @cached_property
    def found(self) -> tuple[Array, Array, float]:
        """Fall of chi-square by each cause and row, and chi-square itself."""
        by_cause, by_row, whole = self.falls((self.fresh.white if self.white is None else self.white)[None])
        return by_cause[0], by_row[0], float(whole[0])

    @cached_property
    def p(self) -> tuple[Array, Array, float]:
        """Chance of each."""
        by_cause, by_row, whole = self.chances(tuple(np.asarray(each)[None] for each in self.found))
        return by_cause[0], by_row[0], float(whole[0])

    def falls(self, residuals: Array) -> tuple[Array, Array, Array]:
        """Fall of chi-square by each cause (D, causes) and row (D, rows), and chi-square itself (D,).

        residuals: (D, m), whitened.
        """
        squares = (residuals @ self._every) ** 2
        ends = np.cumsum(self.freedoms).astype(np.intp)
        parts = np.split(squares, ends, axis=1)
        by_cause = np.column_stack([part.sum(axis=1) for part in parts[:-1]]) if self.bases else parts[-1][:, :0]
        by_row = parts[-1].reshape(len(residuals), len(self.rows), -1).sum(axis=2)
        inside = residuals - (residuals @ self.fresh.basis) @ self.fresh.basis.T
        return by_cause, by_row, (inside**2).sum(axis=1)

    def chances(self, falls: Sequence[Array]) -> tuple[Array, Array, Array]:
        """Chance of each fall; of single rows times as many as there are (Bonferroni)."""
        by_cause, by_row, everything = falls
        return (
            chances(by_cause, self.freedoms, self.noise),
            np.minimum(self.judged * chances(by_row, self.row_freedoms, self.noise), 1.0),
            chances(everything, float(self.fresh.freedom), self.noise),
        )

    def smallest(self, residuals: Array, noise: Array | float = 1.0) -> Array:
        """The smallest chance (D,) of whitened residuals (D, m) whose noise was found to be so many times the true."""
        squared = np.broadcast_to(np.asarray(noise) ** 2, (len(residuals),))
        by_cause, by_row, everything = self.falls(residuals)
        found = chances(everything / squared, float(self.fresh.freedom), self.noise)
        for falls, freedoms, times in ((by_cause, self.freedoms, 1.0), (by_row, self.row_freedoms, self.judged)):
            for freedom in np.unique(freedoms[freedoms > 0]):  # of one freedom the largest fall is the least likely
                largest = falls[:, freedoms == freedom].max(axis=1)
                found = np.minimum(found, times * chances(largest / squared, freedom, self.noise))
        return found

    def level(self, alarm: float, seed: int, draws: int = DRAWS) -> float:
        """Below which the smallest chance of an arm that has not changed falls in this part of all cases."""
        rng, size = np.random.default_rng(seed), len(self.fresh.residual)
        found, left = [], draws
        while left:
            count = min(left, max(AT_ONCE // size, 1))
            noise = np.ones(count)
            if math.isfinite(self.noise):
                noise = np.sqrt(rng.chisquare(self.noise, count) / self.noise)
            found.append(self.smallest(rng.normal(size=(count, size)), noise))
            left -= count
        return float(np.quantile(np.concatenate(found), alarm))


@dataclass(frozen=True, eq=False)
class Look:
    """Rows, what may have changed, and the tests of it.

    fresh, shifted: the rows without and with shifts. slopes: whitened, by each cause. level: below which the smallest
    chance of all tests is an alarm.
    """

    fresh: Fresh
    shifted: BoundProblem
    causes: tuple[Cause, ...]
    slopes: tuple[Array, ...]
    tests: AllTests
    level: float

    @staticmethod
    def at(fresh: Fresh, noise_freedom: float, alarm: float, seed: int, shifted: BoundProblem | None = None) -> Look:
        """Of some rows; `shifted` where they are bound with shifts already."""
        shifted = with_shifts(fresh.bound) if shifted is None else shifted
        rows, causes, samples = fresh.linear, causes_of(fresh, shifted), len(fresh.bound.block.samples)
        whole = shifted.jacobian(np.append(fresh.x, np.zeros(shifted.unknowns - fresh.bound.unknowns)))
        padded = np.vstack([whole, np.zeros((len(rows.residual) - len(whole), whole.shape[1]))])  # priors do not move
        slopes = tuple(rows.whitened(padded[:, cause.columns]) for cause in causes)
        bases = [seen_basis(each, cause.sizes) for each, cause in zip(slopes, causes, strict=True)]
        tests = AllTests(rows, bases, row_bases(rows, samples, fresh.bound.rows // samples), noise_freedom)
        return Look(fresh, shifted, causes, slopes, tests, tests.level(alarm, seed))

    def without(self, row: int, alarm: float, seed: int) -> Look:
        """The same without a row."""
        kept: NDArray[np.intp] = np.delete(np.arange(len(self.fresh.bound.block.samples)), row)
        fewer = replace(self.fresh, bound=self.fresh.bound.take(kept.tolist()))
        return Look.at(fewer, self.tests.noise, alarm, seed, self.shifted.on(fewer.bound.block.samples))

    @property
    def smallest(self) -> float:
        """The smallest of all chances."""
        by_cause, by_row, overall = self.tests.p
        return min(overall, float(by_cause.min(initial=1.0)), float(by_row.min(initial=1.0)))

    @property
    def alarm(self) -> bool:
        """Whether rows of an arm that has not changed are hardly like this."""
        return self.smallest < self.level

    def seen(self, k: int) -> bool:
        """Whether a cause shows in these rows at all."""
        return bool(self.tests.freedoms[k] > 0)

    def found_from(self, k: int) -> float:
        """Shift of a joint (rad, mm) that raises the alarm with a chance of 90 %; infinite where none does."""
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

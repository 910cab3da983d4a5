"""Which cause explains fresh rows: each is a set of directions in which rows, whitened to unit covariance, would move.

Each cause is fitted with the earlier posterior as the prior; its evidence is the likelihood at its best, less Occam's
factor for changes of a usual size. Which of N rows is off costs log N.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.special import fdtri, ndtri

from casacal.calibration.fresh import BASE, BASE_TURN, JOINTS, TOOL, TURN, Fresh, shift_columns, with_shifts
from casacal.data.samples import Samples
from casacal.errors import CasacalError
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Conditioned, Gaussian
from casacal.fit.lm import lm
from casacal.linalg import svd
from casacal.model.problem import Problem
from casacal.planning.candidates import pool_of
from casacal.planning.clearance import drawn_touch
from casacal.planning.route import shortest_way
from casacal.simulation.cell import Cell, Face
from casacal.uncertainty.fresh_rows import FreshRows, chance, chances, covariance_root, likelihood, occam, visible_basis
from casacal.values import Array, Index

USUAL = {"rad": 3e-3, "mm": 3.0}  # plausible changes, by which one number is preferred to six that explain as much
DRAWS = 20_000  # sets of rows of an arm that has not changed: the rate of false alarms is met to 0.0007 at 1 %
AT_ONCE = 4_000_000  # numbers that are drawn at once
SPARE = 1e-6  # part of a row's residual that must be left to it for it to be judged by the others
POWER = 0.9  # chance with which a change must be found to count as one that these rows would have shown
NEVER = {"rad": 0.05, "mm": 50.0}  # a shift that nobody overlooks: what shows only beyond it does not show
OFF = 100.0  # times its noise by which a row usually is off: a turn of a pointer, 1 mm of 0.01 mm, was not counted
SURE = 0.95  # part of the evidence from which on one cause is the one
ANYWHERE, STAYS = 100.0, 1e-3  # usual changes that what shows may be off by, and what does not show
STEPS = 60  # of the fit of a cause: the right one needs five, and a wrong one may creep along a valley for ever
UNEXPLAINED = 0.01  # chance of what a cause leaves unexplained, below which it is not the whole of it
UNUSUAL = 5.0  # usual changes, of 3 mrad or 3 mm each, beyond which one is not believed where another explains as much
NAMED = 0.02  # part of the evidence below which a cause is none of those that remain
POOL = 400  # touches among which is chosen
WIDER = 1.5  # size of a face over the way between its touches: one can touch again there, and a little beside
LEAST = 20.0  # side of a face, mm, that has hardly been touched


@dataclass(frozen=True, eq=False)
class Cause:
    """One thing that may have changed.

    name: as people are told of it. kind: "joint", "tool", "base" or "place". columns: its unknowns (k,) in x of the
    shifted rows. units, labels: of each. place: number of the joint (0, ...), or -1.
    """

    name: str
    kind: str
    columns: Index
    units: tuple[str, ...]
    labels: tuple[str, ...]
    place: int = -1

    @property
    def sizes(self) -> Array:
        """Scale of a plausible change of each unknown (k,)."""
        return np.array([USUAL.get(unit, 1.0) for unit in self.units])


def causes_of(fresh: Fresh, shifted: BoundProblem) -> tuple[Cause, ...]:
    """Every joint, the tool, the base, and each unknown that was declared as standing."""
    joints = enumerate(zip(shifted.problem.robot.axes, shift_columns(shifted, JOINTS), strict=True))
    found = [
        Cause(f"joint {i + 1}", "joint", np.array([column]), ("rad" if axis.turns else "mm",), ("zero",), i)
        for i, (axis, column) in joints
    ]
    labels = ("x", "y", "z", "about x", "about y", "about z")
    turns_show = any(block.unit == "rad" for block in shifted.problem.instrument.blocks)  # as of a body's pose
    for name, keys in (("tool", (TOOL, TURN) if turns_show else (TOOL,)), ("base", (BASE, BASE_TURN))):
        columns = np.concatenate([shift_columns(shifted, key) for key in keys])
        units = (("mm",) * 3 + ("rad",) * 3)[: columns.size]
        found.append(Cause(name, name, columns, units, labels[: columns.size]))
    for slot in fresh.bound.slots:
        columns = np.array(slot.columns, dtype=np.intp)
        if slot.term or not slot.datum or not columns.size or not fresh.known[columns].all():
            continue
        names = tuple(name.removeprefix(slot.name).lstrip("._") for name in slot.unknown.names(slot.name))
        found.append(Cause(slot.name, "place", columns, tuple(slot.unknown.units), names))
    return tuple(found)


def alone(fresh: FreshRows, k: int, per_row: int) -> Array:
    """Whitened directions (m, per_row) in which row k alone could be off."""
    found = np.zeros((len(fresh.residual), per_row))
    found[k * per_row + np.arange(per_row), np.arange(per_row)] = 1.0
    return fresh.whitened(found)


def row_bases(fresh: FreshRows, count: int, per_row: int) -> Array:
    """Orthonormal bases (rows, m, per_row) of the errors of each row alone; zero where the others cannot judge it."""
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
        """Chance of each of `found`."""
        by_cause, by_row, whole = self.chances(tuple(np.asarray(each)[None] for each in self.found))
        return by_cause[0], by_row[0], float(whole[0])

    def falls(self, residuals: Array) -> tuple[Array, Array, Array]:
        """Fall of chi-square by each cause (D, causes) and row (D, rows), and chi-square itself (D,).

        residuals: (D, m), whitened.
        """
        squares = (residuals @ self._every) ** 2
        parts = np.split(squares, np.cumsum(self.freedoms).astype(np.intp), axis=1)
        by_cause = np.column_stack([part.sum(axis=1) for part in parts[:-1]]) if self.bases else parts[-1][:, :0]
        by_row = parts[-1].reshape(len(residuals), len(self.rows), -1).sum(axis=2)
        inside = residuals - (residuals @ self.fresh.basis) @ self.fresh.basis.T
        return by_cause, by_row, (inside**2).sum(axis=1)

    def chances(self, falls: Sequence[Array]) -> tuple[Array, Array, Array]:
        """Chance of each fall; of single rows times as many as there are (Bonferroni)."""
        by_cause, by_row, everything = falls
        of_rows = np.minimum(self.judged * chances(by_row, self.row_freedoms, self.noise), 1.0)
        whole = chances(everything, float(self.fresh.freedom), self.noise)
        return chances(by_cause, self.freedoms, self.noise), of_rows, whole

    def smallest(self, residuals: Array, noise: Array | float = 1.0) -> Array:
        """Smallest chance (D,) of whitened residuals (D, m); noise: found over true, a scalar or (D,)."""
        squared = np.broadcast_to(np.asarray(noise) ** 2, (len(residuals),))
        by_cause, by_row, everything = self.falls(residuals)
        found = chances(everything / squared, float(self.fresh.freedom), self.noise)
        for falls, freedoms, times in ((by_cause, self.freedoms, 1.0), (by_row, self.row_freedoms, self.judged)):
            for freedom in np.unique(freedoms[freedoms > 0]):  # of one freedom the largest fall is the least likely
                largest = falls[:, freedoms == freedom].max(axis=1)
                found = np.minimum(found, times * chances(largest / squared, freedom, self.noise))
        return found

    def level(self, alarm: float, seed: int, draws: int = DRAWS) -> float:
        """Quantile `alarm` of the smallest chance of an arm that has not changed, from simulated rows."""
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
        """Test every cause on fresh rows; `shifted`: their binding with shifts, where there is one already."""
        shifted = with_shifts(fresh.bound) if shifted is None else shifted
        rows, causes, samples = fresh.linear, causes_of(fresh, shifted), len(fresh.bound.block.samples)
        whole = shifted.jacobian(np.append(fresh.x, np.zeros(shifted.unknowns - fresh.bound.unknowns)))
        padded = np.vstack([whole, np.zeros((len(rows.residual) - len(whole), whole.shape[1]))])  # priors do not move
        slopes = tuple(rows.whitened(padded[:, cause.columns]) for cause in causes)
        bases = [visible_basis(each, cause.sizes) for each, cause in zip(slopes, causes, strict=True)]
        tests = AllTests(rows, bases, row_bases(rows, samples, fresh.bound.rows // samples), noise_freedom)
        return Look(fresh, shifted, causes, slopes, tests, tests.level(alarm, seed))

    def without(self, row: int, alarm: float, seed: int) -> Look:
        """The look with one row left out."""
        kept: Index = np.delete(np.arange(len(self.fresh.bound.block.samples)), row)
        fewer = replace(self.fresh, bound=self.fresh.bound.take(kept.tolist()))
        return Look.at(fewer, self.tests.noise, alarm, seed, self.shifted.on(fewer.bound.block.samples))

    @property
    def smallest(self) -> float:
        """The smallest of all chances."""
        by_cause, by_row, overall = self.tests.p
        return min(overall, float(by_cause.min(initial=1.0)), float(by_row.min(initial=1.0)))

    @property
    def alarm(self) -> bool:
        """Whether the smallest chance is below the level."""
        return self.smallest < self.level

    def found_from(self, k: int) -> float:
        """Shift of a joint (rad, mm) that raises the alarm with a chance of 90 %; infinite where none does."""
        length = float(np.linalg.norm(self.slopes[k]))
        if not self.tests.freedoms[k] or not length:
            return math.inf
        level, noise = max(self.level, 1e-12), self.tests.noise
        if math.isfinite(noise):
            least = math.sqrt(float(fdtri(1.0, noise, 1.0 - level)))
            spread = math.sqrt(1.0 + least**2 / (2 * noise))
        else:
            least, spread = -float(ndtri(level / 2)), 1.0
        size = (least + float(ndtri(POWER)) * spread) / length
        return size if size <= NEVER[self.causes[k].units[0]] else math.inf


@dataclass(frozen=True, eq=False)
class FittedCause:
    """Fit of one cause: the posterior mode of its unknowns (k,), with standard deviations.

    x (n,): all unknowns. root (n, v): of their covariance, along all that is known.
    """

    shift: Array
    std: Array
    x: Array
    root: Array


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause, or a row that is off.

    share: part of the evidence. left: chance of what it leaves unexplained. p: chance of as much explained where
    nothing changed. fitted: of a cause, but to first order.
    """

    cause: Cause | None
    row: int
    p: float
    left: float
    evidence: float
    share: float = 0.0
    fitted: FittedCause | None = None

    @property
    def far(self) -> bool:
        """Whether it would have changed by far more than is plausible."""
        cause, fitted = self.cause, self.fitted
        return cause is not None and fitted is not None and bool((np.abs(fitted.shift) > UNUSUAL * cause.sizes).any())


def explanations(look: Look, *, linear: bool = False) -> list[Explanation]:
    """All causes that show in the rows, and single rows, the likeliest first.

    linear: causes to first order, which says nothing of where they leave the arm.
    """
    tests = look.tests
    by_cause, by_row, nothing = tests.found
    p_cause, p_row, _ = tests.p
    found = []
    for k, cause in enumerate(look.causes):
        if not tests.freedoms[k]:  # it does not show in these rows
            continue
        n, cost = int(tests.freedoms[k]), occam(look.slopes[k], cause.sizes)
        fitted, chi_square, p = None, nothing - float(by_cause[k]), float(p_cause[k])
        if not linear:
            _, _, rows = svd(look.slopes[k] * cause.sizes)
            used = cause.sizes[:, None] * rows[:n].T  # directions in its own unknowns along which it shows
            fitted, chi_square = _fitted(look, cause, used)
            p = chance(max(nothing - chi_square, 0.0), n, tests.noise)
        left, evidence = _judged(look, chi_square, n, cost)
        found.append(Explanation(cause, -1, p, left, evidence, fitted=fitted))
    per_row = tests.rows.shape[2]
    for k in np.flatnonzero(tests.row_freedoms > 0).tolist():
        cost = occam(alone(tests.fresh, k, per_row), np.full(per_row, OFF)) + math.log(tests.judged)
        left, evidence = _judged(look, nothing - float(by_row[k]), int(tests.row_freedoms[k]), cost)
        found.append(Explanation(None, k, float(p_row[k]), left, evidence))
    best = max((each.evidence for each in found), default=0.0)
    weights = [math.exp(each.evidence - best) for each in found]
    shared = [replace(each, share=weight / sum(weights)) for each, weight in zip(found, weights, strict=True)]
    return sorted(shared, key=lambda each: -each.share)


def _fitted(look: Look, cause: Cause, used: Array) -> tuple[FittedCause, float]:
    """A cause at its best, along directions `used` (k, n) that show, with all that is known, and chi-square there."""
    fresh, n = look.fresh, look.fresh.bound.unknowns
    names = tuple(look.shifted.names[j] for j in cause.columns)
    free = ANYWHERE**2 * used @ used.T + STAYS**2 * np.diag(cause.sizes**2)
    known = fresh.gaussian.beside(Gaussian(names, np.zeros(len(names)), free))
    at = np.concatenate([fresh.x, np.zeros(look.shifted.unknowns - n)])
    kept = np.arange(at.size) < n
    kept[cause.columns] = True
    part = Conditioned(look.shifted.with_known(known), kept, at)
    found = lm(part, start=at[kept], max_steps=STEPS)
    x, covariance = part.expand(found.x), np.zeros((at.size, at.size))
    covariance[np.ix_(kept, kept)] = found.covariance
    variances = np.diagonal(covariance)
    bounded = np.flatnonzero(np.isfinite(variances) & (variances > 0))
    root = np.zeros((at.size, bounded.size))
    root[bounded] = covariance_root(covariance[np.ix_(bounded, bounded)])
    std = np.sqrt(np.maximum(variances[cause.columns], 0.0))
    return FittedCause(x[cause.columns], std, x, root), 2 * found.cost


def contenders(found: list[Explanation]) -> list[Explanation]:
    """The likeliest ones that together are sure, and whatever is nearly as likely as the last of them.

    One far beyond a usual size does not stand alone where another of a usual size explains the rows as well: a joint
    whose axis runs through the tip hardly shows, and could take over what a tool that was knocked does.
    """
    chosen, total = list[Explanation](), 0.0
    for each in found:
        if total >= SURE or (chosen and each.share < NAMED):
            break
        chosen.append(each)
        total += each.share
    if chosen and all(each.far for each in chosen):
        chosen += [each for each in found[len(chosen) :] if each.cause and each.left >= UNEXPLAINED and not each.far]
    return chosen


def _judged(look: Look, chi_square: float, freedom: int, cost: float) -> tuple[float, float]:
    """Chance of the remaining chi-square, and the log evidence, after `freedom` directions were fitted at `cost`."""
    whole, noise = look.tests.fresh.freedom, look.tests.noise
    return chance(chi_square, whole - freedom, noise), likelihood(chi_square, whole, noise) - cost


def telling(
    problem: Problem, look: Look, found: list[Explanation], count: int, seed: int
) -> tuple[Samples | None, float]:
    """Touches that would tell causes apart, on a short way, or None; and the log-odds to expect of the worst pair."""
    causes = [each.fitted for each in found if each.fitted is not None]
    if not count or len(causes) < 2:
        return None, 0.0
    try:
        pool = pool_of(problem, _faces_of(problem, look.fresh), POOL, seed)
        there = look.shifted.on(replace(pool, sha256="pool"))
    except CasacalError:  # out of reach, or of faces that these rows do not know
        return None, 0.0
    rivals = []  # of each cause: whitened residuals (N, m), and their slopes (N, m, k) along what it leaves open
    for each in causes:
        slopes = there.jacobian(each.x) @ each.root
        rivals.append((there.residual(each.x).reshape(len(pool), -1), slopes.reshape(len(pool), -1, slopes.shape[1])))
    pairs, chosen, odds = list(combinations(rivals, 2)), list[int](), 0.0
    for _ in range(min(count, len(pool))):
        gains = [
            -np.inf if k in chosen else min(_odds(one, two, [*chosen, k]) for one, two in pairs)
            for k in range(len(pool))
        ]
        chosen.append(int(np.argmax(gains)))
        odds = float(max(gains))
    best = pool.take([chosen[k] for k in shortest_way(problem.robot, pool.joints[chosen])])
    return replace(best, lines=tuple(range(1, len(chosen) + 1)), file="planned touches"), odds


def _odds(one: tuple[Array, Array], two: tuple[Array, Array], rows: list[int]) -> float:
    """Logarithm of the odds to expect of some touches between two causes."""
    apart = (one[0][rows] - two[0][rows]).ravel()
    spread = np.eye(apart.size)
    for _, slopes in (one, two):
        part = slopes[rows].reshape(apart.size, -1)
        spread += part @ part.T / 2
    return float(apart @ np.linalg.solve(spread, apart)) / 2


def _faces_of(problem: Problem, fresh: Fresh) -> Cell | None:
    """The faces where fresh rows found them, as large as they were touched; None where none is touched."""
    probe, bound, samples = problem.instrument.probe, fresh.bound, fresh.bound.block.samples
    if probe is None:
        return None
    _, _, tips, directions = drawn_touch(problem, probe, samples)
    rows_of, faces = samples.faces(problem.instrument.groups).rows(), list[Face]()
    for slot in bound.slots:
        kind, shown = slot.unknown.shown(slot.nominal, fresh.x[slot.columns.start : slot.columns.stop])
        label = slot.label if slot.label is not None else next(iter(rows_of))
        if kind != "planes" or label not in rows_of:
            continue
        rows, normal = rows_of[label], np.asarray(shown["normal"])
        normal = -normal if float((directions[rows] @ normal).mean()) > 0 else normal
        middle = tips[rows].mean(axis=0)
        middle -= normal * float(normal @ (middle - np.asarray(shown["point_mm"])))
        way = 2 * float(np.linalg.norm(tips[rows] - middle, axis=1).max()) / np.sqrt(2)
        side = max(WIDER * way, LEAST)
        faces.append(Face(label, tuple(middle.tolist()), tuple(normal.tolist()), (side, side)))
    # a face below the base plane was touched: the table is no higher
    return Cell(faces=tuple(faces), table=min(0.0, *(face.lowest for face in faces))) if faces else None

"""Touches that the arm can make and keep clear, and the choice among them by exchange (Fedorov 1972), I-optimal.

An arm is a chain of rods between its axes, as thick as is said; see `casacal.robots.links`. Points along the rods are
looked at, so that what is closer than half a spacing may pass unseen: give the links a little more than they measure.

With C the posterior covariance of the unknowns and M the weight of their errors, trace(C M) is the mean squared error
of what is asked for (Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007, chapter 10). A row a (m, n), the m
whitened residuals of one measurement, lowers it by trace((1 + a C a')^-1 a C M C a'); without it, it rises likewise.
Rows are exchanged one by one for the best of all others until none is better. From nothing, one by one, such plans stay
on one face for ever: the first rows on another one tell of that face alone, and earn nothing. So they start at random.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from casacal.array_types import Array, Index, Rows
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.nominal import nominal_tips
from casacal.binding.slots import instances
from casacal.errors import CasacalError, SimulationError, came
from casacal.instruments.description import Probe
from casacal.problem.problem import Problem
from casacal.robots.links import STILL, above_table, nodes_of
from casacal.robots.robot import Robot
from casacal.samples.samples import Samples, joined
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.reach import TouchingArm
from casacal.simulation.simulate import simulate
from casacal.simulation.touches import default_cell, true_unknowns
from casacal.uncertainty.expectation import Box, joints_in_box
from casacal.uncertainty.workspace import up_to_base, workspace_joints
from casacal.values import Value, is_real

ALONG = 12  # points looked at on every rod, its ends among them


@dataclass(frozen=True, eq=False)
class Clearance(Value):
    """What an arm must keep clear of.

    boxes: ranges of x, y, z (mm, base frame) where neither arm nor tool may be. link_radius: how thick its links are,
    mm, or None where only its tip and flange are looked at. The last link and the tool may come near a face.
    """

    boxes: tuple[Box, ...] = ()
    link_radius: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "boxes", tuple(self.boxes))
        for box in self.boxes:
            try:
                low, high = np.array(box, dtype=np.float64).T
                sound = low.shape == (3,) and bool((low < high).all())
            except (TypeError, ValueError):
                sound = False
            if not sound:
                raise CasacalError(f"The box to keep out of is {box!r}", "Give ranges of x, y and z in mm, each rising")
        radius = self.link_radius
        if radius is not None and not (is_real(radius) and 0 < radius < math.inf):
            raise CasacalError(f"The links' radius is {radius!r}", "Give a positive number of mm")

    def clear(self, robot: Robot, cell: Cell | None, joints: Array, tips: Array) -> Rows:
        """Which postures (N, n; rad, mm) keep clear, whose tips (N, 3, mm) touch faces of a cell."""
        good = np.ones(len(joints), dtype=bool)
        if not self.boxes and self.link_radius is None:
            return good
        nodes = nodes_of(robot, joints)
        rods = np.concatenate([nodes, tips[:, None]], axis=1)
        if self.link_radius is None:
            return good & ~_inside(rods[:, -2:], self.boxes, 0.0)
        part = np.linspace(0, 1, ALONG)[:, None]
        points = rods[:, :-1, None] * (1 - part) + rods[:, 1:, None] * part  # on rods: (N, rods, ALONG, 3)
        count, radius = len(joints), self.link_radius
        good &= ~_inside(points.reshape(count, -1, 3), self.boxes, radius)
        if cell is not None:
            arm = points[:, :-2].reshape(count, -1, 3)  # the last link holds the tool, which is what touches
            for face in cell.faces:
                good &= ~near_face(arm, np.asarray(face.centre), face.axes, np.asarray(face.size) / 2, radius)
        return good & ~_near_itself(points, radius)


def _inside(points: Array, boxes: Sequence[Box], radius: float) -> Rows:
    """Whether any point (N, k, 3) is nearer to a box than a radius."""
    found = np.zeros(len(points), dtype=bool)
    for box in boxes:
        low, high = np.array(box, dtype=np.float64).T
        beyond = np.maximum(np.maximum(low - points, points - high), 0.0)
        found |= (np.linalg.norm(beyond, axis=2) <= radius).any(axis=1)
    return found


def near_face(points: Array, centre: Array, axes: Array, half: Array, radius: float) -> Rows:
    """Whether any point (N, k, 3) is nearer to a rectangular face than a radius, or behind it."""
    local = (points - centre) @ axes.T
    aside = np.linalg.norm(np.maximum(np.abs(local[..., 1:]) - half, 0.0), axis=-1)
    near = np.hypot(aside, np.maximum(local[..., 0], 0.0)) <= radius
    behind = (local[..., 0] < 0) & (aside <= radius) & (local[..., 0] > -2 * radius)
    return np.asarray((near & (local[..., 0] >= 0) | behind).any(axis=1))


def _near_itself(points: Array, radius: float) -> Rows:
    """Whether rods that do not follow one another are nearer than two radii; those shorter than that are no rods."""
    count, rods = points.shape[:2]
    found = np.zeros(count, dtype=bool)
    long = [k for k in range(rods) if float(np.linalg.norm(points[0, k, -1] - points[0, k, 0])) > 2 * radius]
    for place, first in enumerate(long):
        for second in long[place + 2 :]:
            apart = np.linalg.norm(points[:, first, :, None] - points[:, second, None], axis=-1)
            found |= (apart < 2 * radius).any(axis=(1, 2))
    return found


SWEEPS = 10  # times that every row of a plan is tried against all others
BETTER = 1e-7  # part of the error by which an exchange must lower it


class Criterion(Enum):
    """What a plan makes small: the mean error of what is asked for, or the volume of what the unknowns may be."""

    TIP = "tip"
    """Trace of C M: I-optimal."""
    PARAMETERS = "parameters"
    """Determinant of C: D-optimal."""


@dataclass(frozen=True)
class Exchanged:
    """Rows of a plan (k,), the error that they leave (root of trace C M), and what was made small."""

    rows: Index
    error: float
    loss: float


def exchange(
    rows: Array,
    known: Array,
    weight: Array,
    start: Index,
    *,
    criterion: Criterion = Criterion.TIP,
    barred: Rows | None = None,
) -> Exchanged:
    """Improve a plan until no single exchange does.

    rows: whitened slopes of every measurement that could be made (N, m, n). known: information (n, n) that there is
    without them, positive definite. weight: M (n, n). start: the plan to begin with (k,), no row twice. barred: which
    measurements (N,) must not be taken.
    """
    plan, free = start.copy(), np.ones(len(rows), dtype=bool)
    free[plan] = False
    if barred is not None:
        free[barred] = False
    for _ in range(SWEEPS):
        changed = False
        for place in range(len(plan)):
            rest = np.delete(plan, place)
            covariance: Array = np.asarray(np.linalg.inv(_information(rows[rest], known)), dtype=np.float64)
            others = gains(rows, covariance, weight, criterion)
            others[~free] = -np.inf
            present = float(gains(rows[plan[place]][None], covariance, weight, criterion)[0])
            best = int(np.argmax(others))
            left = float(np.trace(covariance @ weight)) - present if criterion is Criterion.TIP else 1.0
            if others[best] > present + BETTER * left:
                free[plan[place]], free[best] = barred is None or not barred[plan[place]], False
                plan[place], changed = best, True
        if not changed:
            break
    error = error_of(rows[plan], known, weight)
    loss = error if criterion is Criterion.TIP else -float(np.linalg.slogdet(_information(rows[plan], known))[1])
    return Exchanged(plan, error, loss)


def error_of(rows: Array, known: Array, weight: Array) -> float:
    """Root of trace(C M) that some rows (k, m, n) leave."""
    return float(np.sqrt(np.trace(np.linalg.solve(_information(rows, known), weight))))


def _information(rows: Array, known: Array) -> Array:
    flat = rows.reshape(-1, known.shape[0])
    return np.asarray(known + flat.T @ flat)


def gains(rows: Array, covariance: Array, weight: Array, criterion: Criterion = Criterion.TIP) -> Array:
    """By how much each measurement (N, m, n) lowers trace(C M), or the logarithm of the determinant of C: (N,)."""
    size, unknowns = rows.shape[1:]
    flat = rows.reshape(-1, unknowns)
    seen = flat @ covariance
    moved = seen @ weight  # in one product: a stack of small ones takes many times as long
    if size == 1:
        spread = 1 + np.einsum("kn,kn->k", seen, flat)
        return np.asarray(np.log(spread) if criterion is Criterion.PARAMETERS else (moved * seen).sum(axis=1) / spread)
    seen, moved = seen.reshape(rows.shape), moved.reshape(rows.shape)
    spread = np.einsum("kin,kjn->kij", seen, rows) + np.eye(size)
    if criterion is Criterion.PARAMETERS:
        return np.asarray(np.linalg.slogdet(spread)[1])
    told = np.einsum("kin,kjn->kij", moved, seen)
    return np.asarray(np.trace(np.linalg.solve(spread, told), axis1=1, axis2=2))


ROUNDS = 20  # times that more touches are drawn where some do not keep clear
RARE = 0.05  # part of all that must keep clear, or a plan makes no sense


def refuse_several(problem: Problem, what: str, fix: str, box: Box | None, targets: object) -> None:
    """Raise CasacalError for what is no problem, or one of several instruments, and for two places at once."""
    if not isinstance(problem, Problem):
        raise CasacalError(f"Got {came(problem)} as the problem", "Give a Problem; load_problem(path).problem is one")
    if len(problem.instruments) > 1:
        names = ", ".join(problem.names)
        raise CasacalError(f"{what}, but the problem has {names}", f"{fix} problem.measured_by(name)")
    if box is not None and targets is not None:
        raise CasacalError("Got a box and targets", "Give one of them")


def cell_of(problem: Problem, cell: Disturbances | None) -> Disturbances:
    """The cell without anything that disturbs; where none is given, that of `simulate`."""
    if cell is None and problem.instrument.probe is not None:
        cell = default_cell(problem)
    still = Disturbances()
    if isinstance(cell, Cell):
        still = Cell(faces=cell.faces, tilt=cell.tilt, travel=cell.travel)
    if cell is not None:
        still = replace(still, table=cell.table)
    return replace(still, error_scale=0.0, repeatability=0.0, resolution=0.0)


def drawn_touch(problem: Problem, probe: Probe, samples: Samples) -> tuple[TouchingArm, Array, Array, Array]:
    """The arm as drawn with its plunger, and of rows what it reads (N,), its tips and plungers (N, 3)."""
    local = true_unknowns(problem, probe, 0.0, np.random.default_rng(0))
    arm = TouchingArm.of(problem.robot, problem.instrument, probe, local)
    readings = np.zeros(len(samples)) if probe.column is None else samples.columns[probe.column]
    tips, plungers = arm.place(arm.local, samples.joints, readings[:, None])
    return arm, readings, tips, plungers


def pool_of(
    problem: Problem, cell: Disturbances | None, count: int, seed: int, clearance: Clearance | None = None
) -> Samples:
    """Touches that the arm as drawn could make, without any error, above the cell's table.

    Raises SimulationError where faces are out of reach or below the table, CasacalError where hardly a touch keeps
    clear.
    """
    still = cell_of(problem, cell)
    faces = still if isinstance(still, Cell) else None
    for face in () if faces is None else faces.faces:
        if face.lowest < still.table - STILL:
            what = (
                f"Face '{face.label}' reaches down to z = {face.lowest:.0f} mm, and the table is at {still.table:g} mm"
            )
            raise SimulationError(what, "Say where the table is: --table Z, or Cell(..., table=Z)")
    stands = above_table(problem.robot, still.table, (clearance and clearance.link_radius) or 0.0)
    found: Samples | None = None
    for k in range(ROUNDS):
        drawn, tried = simulate(problem, still, samples=count, seed=seed + 7919 * k).samples, count * (k + 1)
        tips = nominal_tips(problem, 0, drawn)
        clear = stands(drawn.joints, tips)
        if clearance is not None:
            clear &= clearance.clear(problem.robot, faces, drawn.joints, tips)
        good = np.flatnonzero(clear)
        found = drawn.take(good) if found is None else joined(found, drawn.take(good))
        if len(found) >= count:
            return found.take(range(count))
        if len(found) < RARE * tried:
            break
    assert found is not None
    what = f"Only {len(found)} of {tried} reachable touches keep above the table at z = {still.table:g} mm"
    fix = "Say where the table is (--table Z, or Cell(..., table=Z)), or move the faces"
    if clearance is not None:
        what += ", and clear of boxes, faces and the arm itself"
        fix += "; make the boxes or --link-radius smaller"
    raise CasacalError(what, fix)


UNKNOWN = 1e-9  # information, in units of what filters start from, of what nobody knows beforehand
ROUNDING = 1e-12
"""The same as part of all that there is, where rows have told much of some unknowns and nothing of others."""


@dataclass(frozen=True)
class Choice:
    """Measurements among which is chosen, in units of what each unknown may be.

    rows: whitened slopes of each (N, m, n). known: information (n, n) without them. weight: M (n, n).
    """

    rows: Array
    known: Array
    weight: Array

    @staticmethod
    def of(
        bound: BoundProblem,
        joints: Array,
        *,
        count: int | None = None,
        loose: Mapping[str, float] | None = None,
        at: Array | None = None,
    ) -> Choice:
        """Of a pool, for a tip that is wanted at some joint values (M, q).

        count: how many of the rows can be chosen; the others have been made. loose: what may have moved since, by the
        name of the unknown: its standard deviation. at: the arm (n,), by default as drawn.
        """
        x, units = bound.x0 if at is None else at, bound.start_std
        rows, field = row_slopes(bound, x), wanted_field(bound, x, joints)
        known = bound.prior_information * np.outer(units, units) + UNKNOWN * np.eye(units.size)
        if count is not None and count < len(rows):
            made = rows[count:].reshape(-1, bound.unknowns)
            known, rows = known + made.T @ made, rows[:count]
        if loose:
            covariance = np.linalg.inv(known)
            for name, std in loose.items():
                j = bound.names.index(name)
                covariance[j, j] += (std / units[j]) ** 2
            known = np.linalg.inv(covariance)
        return Choice(rows, np.asarray(known), field.T @ field / len(joints))

    @staticmethod
    def on_top(extra: BoundProblem, x: Array, known: Array, field: Array) -> Choice:
        """Of extra rows, bound, where they stand at x (n,), on top of information (n, n), priors not in it.

        field: slopes (3M, s) of a tip that is wanted at M postures, by the first unknowns; the others move none.
        """
        units = extra.start_std
        held = known + extra.prior_information
        held = held * np.outer(units, units)
        held += max(UNKNOWN, ROUNDING * float(np.trace(held))) * np.eye(units.size)
        slopes = field.reshape(-1, field.shape[-1]) * units[: field.shape[-1]]
        weight = np.zeros_like(held)
        weight[: slopes.shape[1], : slopes.shape[1]] = slopes.T @ slopes / (len(slopes) / 3)
        return Choice(row_slopes(extra, x), np.asarray(held), weight)

    def error(self, chosen: Index) -> float:
        """Tip error (mm RMS) that some measurements leave."""
        return error_of(self.rows[chosen], self.known, self.weight)

    def best_of(
        self,
        count: int,
        starts: int,
        rng: np.random.Generator,
        criterion: Criterion = Criterion.TIP,
        barred: Rows | None = None,
    ) -> Index:
        """So many measurements, the best of some exchanges; none of those that are barred (N,)."""
        there = np.arange(len(self.rows)) if barred is None else np.flatnonzero(~barred)
        begins = [rng.choice(there, count, replace=False) for _ in range(starts)]
        found = (exchange(self.rows, self.known, self.weight, k, criterion=criterion, barred=barred) for k in begins)
        return min(found, key=lambda each: each.loss).rows

    def curve(self, best: Index, rng: np.random.Generator, criterion: Criterion = Criterion.TIP) -> dict[int, float]:
        """Error by number of measurements: half and a quarter as many, these, and half as many again."""
        found = {len(best): self.error(best)}
        for count in sorted({max(round(len(best) * part), 3) for part in (0.25, 0.5, 0.75, 1.5)} - {len(best)}):
            if count <= len(self.rows):
                found[count] = self.error(self.best_of(count, 1, rng, criterion))
        return dict(sorted(found.items()))

    def lost(self, best: Index, part: float, draws: int, rng: np.random.Generator) -> float:
        """Error, RMS over some draws, when a part of the measurements is lost at random."""
        left = max(len(best) - max(round(part * len(best)), 1), 1)
        errors = [self.error(rng.choice(best, left, replace=False)) for _ in range(draws)]
        return float(np.sqrt(np.mean(np.square(errors))))


def seldom(problem: Problem, pool: Samples, chosen: Index) -> tuple[Rows, Rows]:
    """Measurements of a pool (N,) of faces that the chosen ones touch too seldom to say where they are.

    Such touches place the face at best, and tell nothing of the arm. Of all such faces, and of the one that is touched
    least but touched.
    """
    taken = np.zeros(len(pool), dtype=bool)
    taken[chosen] = True
    all_of_them, least, fewest = np.zeros(len(pool), dtype=bool), np.zeros(len(pool), dtype=bool), len(pool)
    for key in problem.instrument.datum:
        unknown = problem.instrument.unknowns[key]
        flat = int((~np.isfinite(unknown.prior_stds)).sum())
        for _, rows in instances(problem.instrument, key, unknown, pool):
            count = int(taken[rows].sum())
            if count * problem.models[0].components > flat:
                continue
            all_of_them[rows] = True
            if 0 < count < fewest:
                fewest, least = count, np.zeros(len(pool), dtype=bool)
                least[rows] = True
    return all_of_them, least


def row_slopes(bound: BoundProblem, x: Array) -> Array:
    """Whitened slopes (N, m, n) of each measurement at x (n,), in units of what filters start from."""
    return np.asarray((bound.jacobian(x) * bound.start_std).reshape(len(bound.measured), -1, bound.unknowns))


def wanted_field(bound: BoundProblem, x: Array, joints: Array) -> Array:
    """Moves (3 M, n) of the tip at joint values (M, q), apart from the position of the base, in the same units."""
    frame = workspace_joints(bound.problem.robot)
    sets = [(bound.tip_jacobian(x, q), bound.tips(x, q)) for q in (joints, frame)]
    return np.asarray(up_to_base(*sets[0], *sets[1]) * bound.start_std)


def wanted_joints(bound: BoundProblem, box: Box | None, targets: Array | None) -> Array:
    """Joint values (M, n) at which the tip is wanted."""
    if box is not None:
        return joints_in_box(bound, bound.x0, box)
    if targets is None:
        return workspace_joints(bound.problem.robot)
    joints = np.atleast_2d(np.asarray(targets, dtype=np.float64))
    if joints.shape[1] != len(bound.problem.robot.axes) or not np.isfinite(joints).all():
        fix = f"Give finite joint values (M, {len(bound.problem.robot.axes)}) in rad and mm"
        raise CasacalError(f"Targets have the shape {np.shape(targets)}", fix)
    return joints

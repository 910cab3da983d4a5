"""Touches that the arm can make and keep clear of table, boxes and itself.

An arm is a chain of rods between its axes, as thick as is said; see `casacal.model.links`. Points along the rods are
looked at, so that what is closer than half a spacing may pass unseen: give the links a little more than they measure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.data.samples import Samples, joined
from casacal.errors import CasacalError, SimulationError, came
from casacal.fit.nominal import nominal_tips
from casacal.model.instrument import Probe
from casacal.model.links import STILL, above_table, nodes_of
from casacal.model.problem import Problem
from casacal.model.robot import Robot
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.simulate import simulate
from casacal.simulation.touches import TouchingArm, default_cell, true_unknowns
from casacal.uncertainty.tip_error import Box
from casacal.values import Array, Rows, Value, is_real

ALONG = 12  # points looked at on every rod, its ends among them


@dataclass(frozen=True, eq=False)
class Clearance(Value):
    """Obstacles and link radii that postures keep clear of.

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
        if not self.boxes and self.link_radius is None:
            return np.ones(len(joints), dtype=bool)
        rods = np.concatenate([nodes_of(robot, joints), tips[:, None]], axis=1)
        if self.link_radius is None:
            return ~_inside(rods[:, -2:], self.boxes, 0.0)
        part = np.linspace(0, 1, ALONG)[:, None]
        points = rods[:, :-1, None] * (1 - part) + rods[:, 1:, None] * part  # on rods: (N, rods, ALONG, 3)
        count, radius = len(joints), self.link_radius
        hit = _inside(points.reshape(count, -1, 3), self.boxes, radius) | _near_itself(points, radius)
        arm = points[:, :-2].reshape(count, -1, 3)  # the last link holds the tool, which is what touches
        for face in () if cell is None else cell.faces:
            hit |= near_face(arm, np.asarray(face.centre), face.axes, np.asarray(face.size) / 2, radius)
        return ~hit


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

"""Touches that the arm can make and keep clear of table, faces, boxes and itself.

An arm is a chain of rods between its axes, as thick as is said, or as arms of its reach are: see
`casacal.model.capsules`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from casacal.data.samples import Samples, joined
from casacal.errors import CasacalError, SimulationError, came
from casacal.fit.nominal import nominal_tips
from casacal.model.capsules import STILL, Collision, Skeleton, Solid
from casacal.model.instrument import Probe
from casacal.model.problem import Problem
from casacal.model.robot import Robot, random_joints
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.simulate import simulate, touched_rows
from casacal.simulation.touches import PLATE, Draw, TouchingArm, default_cell, refuse_cell, true_unknowns
from casacal.values import Array, Box, Rows, Value, is_real


@dataclass(frozen=True, eq=False)
class Clearance(Value):
    """Obstacles and link radii that postures keep clear of, beside table, faces and `keep_out` of a cell.

    boxes: ranges of x, y, z (mm, base frame) where neither arm nor tool may be. link_radius: how thick its links are,
    mm; None takes what arms of this reach have, 0 looks at joints, flange and tip alone. The last link and the tool may
    come near a face.
    """

    boxes: tuple[Box, ...] = ()
    link_radius: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "boxes", tuple(self.boxes))
        for box in self.boxes:
            Solid.box("box", box)
        radius = self.link_radius
        if radius is not None and not (is_real(radius) and 0 <= radius < math.inf):
            raise CasacalError(f"The links' radius is {radius!r}", "Give a positive number of mm, or 0 for none")

    def around(self, robot: Robot, cell: Disturbances | None) -> Around:
        """What there is around an arm, with the table and the faces of a cell."""
        boxes = (*self.boxes, *(() if cell is None else cell.keep_out))
        solids = [Solid.box(f"box {number}", box) for number, box in enumerate(boxes, 1)]
        for face in cell.faces if isinstance(cell, Cell) else ():  # as thick as a plate that lies on a table
            low, high = (np.array([end, *(side * np.asarray(face.size) / 2)]) for end, side in ((-PLATE, -1), (0.0, 1)))
            solids.append(Solid(f"face '{face.label}'", low, high, np.asarray(face.centre), face.axes, touched=True))
        skeleton = Skeleton.of(robot)
        radius = skeleton.radius if self.link_radius is None else self.link_radius
        known = skeleton.place is not None
        return Around(skeleton, radius if known else 0.0, -math.inf if cell is None else cell.table, tuple(solids))


@dataclass(frozen=True, eq=False)
class Around:
    """An arm, the radius of its links (mm; 0 where they are not looked at), and what stands around it."""

    skeleton: Skeleton
    radius: float
    table: float
    solids: tuple[Solid, ...]

    def collisions(self, joints: Array, tips: Array) -> Iterator[Collision]:
        """What postures (N, n; rad, mm) with tips (N, 3; mm) bring too near to what."""
        return self.skeleton.collisions(joints, tips, self.radius, table=self.table, solids=self.solids)

    def clear(self, joints: Array, tips: Array) -> Rows:
        """Which postures (N, n; rad, mm), whose tips (N, 3; mm) touch faces, keep clear of everything."""
        clear = np.ones(len(joints), dtype=bool)
        for each in self.collisions(joints, tips):
            clear &= ~each.rows
        return clear

    @property
    def words(self) -> str:
        """A sentence: what was looked at, and what was not."""
        names = [*(["the table"] if self.table > -math.inf else []), *(each.name for each in self.solids)]
        unseen = "Cables, the shapes of links and tool, and what else stands around were not looked at"
        if self.radius:
            off = f"off {', '.join(names)} and " if names else "off "
            return (
                f"Collisions looked at: links, as rods of {self.radius:g} mm radius between drawn axes (the wrist's "
                f"and the tool half as thick), keep {off}one another; the last link and the tool may come near a face. "
                f"{unseen}. Go through the plan slowly"
            )
        alone = "joints, flange and tip are" if self.skeleton.place else "the tip is"
        why = "links" if self.skeleton.place else "links (joints do not carry one another in order)"
        kept = f"only {alone} kept off {', '.join(names)}" if names else "nothing is looked at"
        return (
            f"Collisions not checked: of the arm {kept}; {why}, cables and what stands around were not looked at. Go "
            "through the plan slowly"
        )


ROUNDS = 20  # times that more touches are drawn where some do not keep clear
RARE = 0.05  # part of all that must keep clear, or a plan makes no sense
JUDGED = 100  # touches that must have been tried before so small a part is believed


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
        still = replace(still, table=cell.table, keep_out=cell.keep_out)
    return replace(still, error_scale=0.0, repeatability=0.0, resolution=0.0)


def drawn_touch(problem: Problem, probe: Probe, samples: Samples) -> tuple[TouchingArm, Array, Array, Array]:
    """The arm as drawn with its plunger, and of rows what it reads (N,), its tips and plungers (N, 3)."""
    local = true_unknowns(problem, probe, 0.0, np.random.default_rng(0))
    arm = TouchingArm.of(problem.robot, problem.instrument, probe, local)
    readings = np.zeros(len(samples)) if probe.column is None else samples.columns[probe.column]
    tips, plungers = arm.place(arm.local, samples.joints, readings[:, None])
    return arm, readings, tips, plungers


LIBRARY = 2000  # random postures, of which those that keep clear are where touches are sought from
PLACES_A_FACE = 4  # touches that say where a face is
MOST_OF = 3  # pairs of a part and an obstacle that are named where hardly a touch keeps clear


def pool_of(
    problem: Problem, cell: Disturbances | None, count: int, seed: int, clearance: Clearance | None = None
) -> Samples:
    """Touches that the arm as drawn could make, without any error, and keep clear of table, faces, boxes and itself.

    Raises SimulationError where faces are out of reach or below the table, CasacalError where hardly a touch keeps
    clear.
    """
    still = cell_of(problem, cell)
    for face in still.faces if isinstance(still, Cell) else ():
        if face.lowest < still.table - STILL:
            what = (
                f"Face '{face.label}' reaches down to z = {face.lowest:.0f} mm, and the table is at {still.table:g} mm"
            )
            raise SimulationError(what, "Say where the table is: --table Z, or Cell(..., table=Z)")
    around = (clearance or Clearance()).around(problem.robot, still)
    found, tried, in_way = list[Samples](), 0, dict[str, int]()
    rare: tuple[str, int] | None = None
    probe, starts = problem.instrument.probe, _clear_postures(problem, around)
    if probe is not None and isinstance(still, Cell):
        refuse_cell(problem, probe, still)
    while (missing := count - sum(map(len, found))) > 0:
        share = max((count - missing) / tried, RARE) if tried else 1.0
        number = min(math.ceil(1.1 * missing / share), max(count, JUDGED))
        draw = Draw(seed + 7919 * len(found))
        if probe is not None and isinstance(still, Cell):
            drawn, *_ = touched_rows(problem, probe, still, number, draw, starts)
        else:
            drawn = simulate(problem, still, samples=number, seed=draw.seed).samples
        tried += number
        tips, clear = nominal_tips(problem, 0, drawn), np.ones(number, dtype=bool)
        for part, other, rows in around.collisions(drawn.joints, tips):
            clear &= ~rows
            in_way[f"{part} against {other}"] = in_way.get(f"{part} against {other}", 0) + int(rows.sum())
        found.append(drawn.take(np.flatnonzero(clear)))
        if len(found) == ROUNDS or (tried >= JUDGED and sum(map(len, found)) < RARE * tried):
            break
    else:
        pool = reduce(joined, found).take(range(count))
        rare = _rare_face(pool, still, probe)
        if rare is None:
            return pool
    worst = sorted(in_way.items(), key=lambda each: -each[1])[:MOST_OF]
    named = ", ".join(f"{words} ({hits / tried:.0%})" for words, hits in worst if hits)
    few, of_it = (sum(map(len, found)), "") if rare is None else (rare[1], f" of face '{rare[0]}'")
    what = f"Only {few} of {tried} reachable touches{of_it} keep clear above the table at z = {still.table:g} mm"
    what += f". In the way: {named}"
    raise CasacalError(what, "Move the faces, make --keep-out or --link-radius smaller, or say where --table is")


THIN = 1e-3  # mm; radius of links of which nothing is known: their axes alone must keep clear
ROUNDED = 1.0  # mm by which a posture as a plan's file shows it may be lower than it was planned


def hindered(problem: Problem, samples: Samples, table: float, clearance: Clearance) -> dict[int, str]:
    """What of the drawn arm is below a table (mm), in a box or in the arm itself, by number of the touch, from 1.

    For postures from elsewhere, such as a plan that was edited: faces, which may stand elsewhere by now, are not looked
    at, and links are thin unless the clearance says more.
    """
    thin = replace(clearance, link_radius=THIN) if clearance.link_radius is None else clearance
    around, found = thin.around(problem.robot, Disturbances(table=table - ROUNDED)), dict[int, str]()
    for part, other, rows in around.collisions(samples.joints, nominal_tips(problem, 0, samples)):
        for k in (np.flatnonzero(rows) + 1).tolist():
            found[k] = f"{found[k]}, {part} against {other}" if k in found else f"{part} against {other}"
    return found


def _rare_face(pool: Samples, cell: Disturbances, probe: Probe | None) -> tuple[str, int] | None:
    """A face that hardly a touch is on, and their number; None where each has enough, or the pool is small."""
    if probe is None or probe.label is None or not isinstance(cell, Cell):
        return None
    rows, enough = pool.faces(probe.label).rows(), len(pool) >= 2 * PLACES_A_FACE * len(cell.faces)
    counts = {face.label: len(rows.get(face.label, ())) for face in cell.faces}
    label = min(counts, key=counts.__getitem__)
    return (label, counts[label]) if enough and counts[label] < PLACES_A_FACE else None


def _clear_postures(problem: Problem, around: Around) -> Array | None:
    """Random postures (M, n; rad, mm) that keep clear; None where they are few, or nothing is touched."""
    probe, rng = problem.instrument.probe, np.random.default_rng(0)
    if probe is None:
        return None
    arm = TouchingArm.of(problem.robot, problem.instrument, probe, true_unknowns(problem, probe, 0.0, rng))
    joints = random_joints(problem.robot, LIBRARY, rng)
    tips, _ = arm.place(arm.local, joints, np.zeros((len(joints), 1)))
    clear = around.clear(joints, tips)
    return joints[clear] if clear.sum() >= RARE * LIBRARY else None

"""Touches among which a plan is chosen: those that the arm as drawn can make, and that keep clear."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import reduce

import numpy as np

from casacal.data.samples import Samples, joined
from casacal.errors import CasacalError, SimulationError, came
from casacal.fit.nominal import nominal_tips
from casacal.model.capsules import STILL
from casacal.model.instrument import Probe
from casacal.model.problem import Problem
from casacal.model.robot import random_joints
from casacal.planning.clearance import Around, Clearance
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.places import default_cell, drawn_arm, refuse_cell
from casacal.simulation.simulate import simulate, touched_rows
from casacal.simulation.touches import Draw, TouchingArm
from casacal.values import Array, Box

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


LIBRARY = 2000  # random postures, of which those that keep clear are where touches are sought from
PLACES_A_FACE = 4  # touches that say where a face is
MOST_OF = 3  # pairs of a part and an obstacle that are named where hardly a touch keeps clear


def pool_of(
    problem: Problem,
    cell: Disturbances | None,
    count: int,
    seed: int,
    clearance: Clearance | None = None,
    *,
    trial: int | None = None,
) -> Samples:
    """Touches that the arm as drawn could make, without any error, and keep clear of table, faces, boxes and itself.

    trial: so many are sought before all, which soon says what is out of reach.

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
    rare: tuple[str, int] | None = None
    probe, rng = problem.instrument.probe, np.random.default_rng(0)
    touch = None if probe is None else drawn_arm(problem, probe, rng)
    starts = None if touch is None else _clear_postures(touch, around, rng)
    if probe is not None and isinstance(still, Cell):
        refuse_cell(problem, probe, still)
    for wanted in (count,) if trial is None else (trial, count):
        found, tried, in_way = list[Samples](), 0, dict[str, int]()
        while (missing := wanted - sum(map(len, found))) > 0:
            share = max((wanted - missing) / tried, RARE) if tried else 1.0
            number = min(math.ceil(1.1 * missing / share), max(wanted, JUDGED))
            draw = Draw(seed + 7919 * len(found))
            if probe is not None and isinstance(still, Cell):
                drawn, *_ = touched_rows(problem, probe, still, number, draw, starts, touch)
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
            pool = reduce(joined, found).take(range(wanted))
            rare = _rare_face(pool, still, probe)
            if rare is None and wanted == count:
                return pool
            if rare is None:
                continue
        break
    few, of_it = (sum(map(len, found)), "") if rare is None else (rare[1], f" of face '{rare[0]}'")
    what = f"Only {few} of {tried} reachable touches{of_it} keep clear above the table at z = {still.table:g} mm"
    raise CasacalError(f"{what}. In the way: {_worst(in_way, tried)}", CLEAR_IT)


CLEAR_IT = "Move the faces, make --keep-out or --link-radius smaller, or say where --table is"


def _worst(in_way: Mapping[str, int], tried: int) -> str:
    """The pairs that are most often in the way, each with its part of the touches that were tried."""
    worst = sorted(in_way.items(), key=lambda each: -each[1])[:MOST_OF]
    return ", ".join(f"{words} ({hits / tried:.0%})" for words, hits in worst if hits)


def _rare_face(pool: Samples, cell: Disturbances, probe: Probe | None) -> tuple[str, int] | None:
    """A face that hardly a touch is on, and their number; None where each has enough, or the pool is small."""
    if probe is None or probe.label is None or not isinstance(cell, Cell):
        return None
    rows, enough = pool.faces(probe.label).rows(), len(pool) >= 2 * PLACES_A_FACE * len(cell.faces)
    counts = {face.label: len(rows.get(face.label, ())) for face in cell.faces}
    label = min(counts, key=counts.__getitem__)
    return (label, counts[label]) if enough and counts[label] < PLACES_A_FACE else None


def _clear_postures(arm: TouchingArm, around: Around, rng: np.random.Generator) -> Array | None:
    """Random postures (M, n; rad, mm) that keep clear; None where they are few."""
    joints = random_joints(arm.robot, LIBRARY, rng)
    tips, _ = arm.place(arm.local, joints, np.zeros((len(joints), 1)))
    clear = around.clear(joints, tips)
    return joints[clear] if clear.sum() >= RARE * LIBRARY else None

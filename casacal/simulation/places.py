"""A cell of which nobody said where its faces stand: where this arm touches them most readily."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from casacal.errors import SimulationError
from casacal.model.capsules import above_table
from casacal.model.geometry import Plane
from casacal.model.instrument import Probe
from casacal.model.problem import Problem
from casacal.model.robot import random_joints
from casacal.model.unknown import tangent_basis, unit_vector
from casacal.simulation.cell import OF_DIALS, PLATE, Cell, Face, corner, triple
from casacal.simulation.touches import TouchingArm, true_unknowns, try_touches
from casacal.values import Array, Box

SLOPE = math.radians(15.0)  # inclination of facets against the plunger of an arm that cannot tilt it
GRAZING = math.radians(75.0)  # tilt at which a tip without a dial still touches
LEVEL = 0.1  # square of the sine of a plane's slope below which it lies, and its place is not moved along it
ENOUGH = 0.1  # part of the touches of the worst face that must succeed


def refuse_cell(problem: Problem, probe: Probe, cell: Cell) -> None:
    """Raise SimulationError for a cell that this plunger cannot measure in.

    A step stands on a face of the cell, and is itself one of the faces that somebody named; those of `default_cell` are
    nobody's, and have no steps.
    """
    labels = [face.label for face in cell.faces]
    for step in probe.steps:
        on = problem.instrument.instance("plane", step)
        fix = f"Name one of its faces: {', '.join(labels)}; or add that face to the cell"
        if on not in labels:
            raise SimulationError(f"Step '{step}' is on '{on}', which is no face of the cell", fix)
        of_default = len(labels) == (1 if probe.label is None else 3)
        if step not in labels and not (of_default and cell.faces == default_cell(problem).faces):
            raise SimulationError(f"Step '{step}' is no face of the cell", fix)
    if len(labels) > 1 and probe.label is None:
        fix = 'Declare plane=Plane(per="plane")'
        raise SimulationError(f"The cell has {len(labels)} faces and the problem one plane", fix)
    setting = next((name for name in OF_DIALS if getattr(cell, name) > 0), None)
    if setting and probe.column is None:
        fix = "Leave it out, or declare reading=True"
        raise SimulationError(f"The cell has a {setting}, and the problem touches without a dial", fix)


def drawn_arm(problem: Problem, probe: Probe, rng: np.random.Generator) -> TouchingArm:
    """The plunger on the arm as drawn."""
    return TouchingArm.of(problem.robot, problem.instrument, probe, true_unknowns(problem, probe, 0.0, rng))


def default_cell(problem: Problem, *, table: float = 0.0, keep_out: tuple[Box, ...] = ()) -> Cell:
    """Three faces where this arm touches them most readily; the same for the same problem.

    They stand above a table (height in mm, base frame), in front of the base (along its x axis) where the arm reaches
    there, and where the tip is out of boxes to keep out of. They are at right angles, or, for an arm that cannot point
    its plunger so freely, such as a SCARA, each is inclined against the plunger another way. A problem with one plane
    gets one face, where it declares the plane.
    Raises SimulationError when no such place is found.
    """
    probe, rng = problem.instrument.probe, np.random.default_rng(0)
    if probe is None:
        raise SimulationError(
            f"{type(problem.instrument).__name__} touches no faces, so no place for them is looked for",
            "Simulate it without a cell",
        )
    touch = drawn_arm(problem, probe, rng)
    tips, plungers = touch(random_joints(problem.robot, 400, rng), np.zeros(400))[:2]
    base = np.median(tips, axis=0)
    reach = float(np.quantile(np.linalg.norm(tips - base, axis=1), 0.9))
    size = min(600.0, 0.4 * reach)
    outside = np.hypot(tips[:, 0], tips[:, 1]) > size  # where no face stands in the base
    before = outside & (np.abs(tips[:, 1]) <= tips[:, 0])
    kinds: list[tuple[Iterable[Cell], float]] = []
    for where in (before, outside & ~before):
        some = np.flatnonzero(where)
        chosen = rng.choice(some, min(24, len(some)), replace=False)
        corners = [_lifted(_corner_at(tips[k], base, size), table) for k in chosen]
        facets = (_lifted(_facets_at(tips[k], plungers[k], 0.25 * size), table) for k in chosen)
        if probe.label is None:
            single, what = _single(problem, corners, size, table), "one face"
            grazed = [replace(cell, tilt=GRAZING) for cell in single] if probe.column is None else []
            kinds += [(single, 0.5), (grazed, ENOUGH), (single, ENOUGH)]
        else:
            what = (
                f"three faces, at right angles or each inclined by {math.degrees(SLOPE):g} degrees against the plunger"
            )
            low = [_moved(cell, table + PLATE) for cell in corners if math.isfinite(table)]
            kinds += [(low, ENOUGH), (corners, ENOUGH), (facets, ENOUGH)]
    stands = above_table(problem.robot, table, keep_out)
    for cells, enough in kinds:
        best, share = None, 0.0
        for cell in cells:
            which, count = np.arange(30) % len(cell.faces), len(cell.faces)
            found = try_touches(touch, probe, cell, which, np.zeros(30), [None] * count, np.random.default_rng(1))
            good = found[2] & stands(found[0], touch(*found[:2])[0])
            reached = float(min(good[which == i].mean() for i in range(count)))
            if reached > share:
                best, share = cell, reached
        if best is not None and share >= enough:
            return replace(best, keep_out=keep_out)
    raise SimulationError(
        f"No place was found where '{problem.robot.name}' can touch {what} above a table at z = {table:g} mm",
        "Say where the table is (--table Z), or define `cell = Cell(faces=...)` in the problem file",
    )


def _moved(cell: Cell, height: float, up: Sequence[float] | Array = (0.0, 0.0, 1.0)) -> Cell:
    """Face moved along a direction (3) until its lowest corner is at a height, mm."""
    lift = (height - min(face.lowest for face in cell.faces)) / up[2] * np.asarray(up)
    return replace(cell, faces=tuple(replace(face, centre=triple(face.centre + lift)) for face in cell.faces))


def _lifted(cell: Cell, table: float, up: Sequence[float] | Array = (0.0, 0.0, 1.0)) -> Cell:
    """Face moved along a direction (3) until it is above a table."""
    cell = replace(cell, table=table)
    return _moved(cell, table, up) if min(face.lowest for face in cell.faces) < table else cell


def _single(problem: Problem, corners: list[Cell], size: float, table: float) -> list[Cell]:
    """Cells of one face: where the problem declares its plane, seen from either side, or the floors of corners."""
    plane = problem.instrument.unknowns[problem.instrument.datum[0]]
    if not isinstance(plane, Plane) or plane.normal is None or plane.point is None:
        return [replace(cell, faces=cell.faces[:1]) for cell in corners]
    unit = unit_vector(plane.normal, "The normal")
    sides = (Face("plane", triple(plane.point), triple(side * unit), (size, size)) for side in (1.0, -1.0))
    cells, up = [Cell(faces=(side,)) for side in sides], np.array([0.0, 0.0, 1.0]) - unit[2] * unit
    if up[2] > LEVEL:
        return [_lifted(cell, table, up) for cell in cells]
    return [replace(cell, table=min(table, cell.faces[0].lowest)) for cell in cells]  # the table is where the plane is


def _corner_at(centre: Array, base: Array, size: float) -> Cell:
    """Three faces at right angles around a place (3, mm)."""
    away = (base - centre)[:2]
    towards = away.tolist() if np.linalg.norm(away) > 1e-6 else (-1.0, 0.0)
    return Cell(faces=corner(centre.tolist(), size=size, towards=towards))


def _facets_at(centre: Array, plunger: Array, size: float) -> Cell:
    """Three facets around a place (3, mm), each inclined another way against a plunger's direction (3)."""
    towards = -plunger / np.linalg.norm(plunger)
    u, v = tangent_basis(towards).T
    faces = []
    for k, label in enumerate(("one", "two", "three")):
        aside = math.cos(2 * math.pi * k / 3) * u + math.sin(2 * math.pi * k / 3) * v
        normal, place = math.cos(SLOPE) * towards + math.sin(SLOPE) * aside, centre + 0.75 * size * aside
        faces.append(Face(label, (place[0], place[1], place[2]), (normal[0], normal[1], normal[2]), (size, size)))
    return Cell(faces=tuple(faces), tilt=SLOPE + math.radians(1.0))

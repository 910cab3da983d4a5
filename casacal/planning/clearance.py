"""What stands around an arm, and the postures that keep clear of it: table, faces, boxes, the arm itself.

An arm is a chain of rods between its axes, as thick as is said, or as arms of its reach are: see
`casacal.model.capsules`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.data.samples import Samples
from casacal.errors import CasacalError
from casacal.fit.nominal import nominal_tips
from casacal.model.capsules import Collision, Skeleton, Solid
from casacal.model.instrument import Probe
from casacal.model.problem import Problem
from casacal.model.robot import Robot
from casacal.simulation.cell import PLATE, Cell, Disturbances, Face
from casacal.simulation.touches import TouchingArm, true_unknowns
from casacal.values import Array, Box, Rows, Value, is_real

PARALLEL = math.cos(math.radians(5.0))
SMALL = 0.5  # side of a block over that of the face it stands on; a larger face above is the same plate, raised


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
        boxes = tuple(dict.fromkeys((*self.boxes, *(() if cell is None else cell.keep_out))))
        solids = [Solid.box(f"box {number}", box) for number, box in enumerate(boxes, 1)]
        faces = cell.faces if isinstance(cell, Cell) else ()
        for face in faces:
            ends = ((-_thickness(face, faces), -1), (0.0, 1))
            low, high = (np.array([end, *(side * np.asarray(face.size) / 2)]) for end, side in ends)
            solids.append(Solid(f"face '{face.label}'", low, high, np.asarray(face.centre), face.axes, touched=True))
        skeleton = Skeleton.of(robot)
        radius = skeleton.radius if self.link_radius is None else self.link_radius
        known = skeleton.place is not None
        return Around(skeleton, radius if known else 0.0, -math.inf if cell is None else cell.table, tuple(solids))


def _thickness(face: Face, faces: Sequence[Face]) -> float:
    """How far a face is solid behind, mm: a block down to the larger face it stands on, else as a plate on a table."""
    found = PLATE
    for other in faces:
        height, *aside = (np.asarray(face.centre) - other.centre) @ other.axes.T
        over = (np.abs(aside) <= np.asarray(other.size) / 2).all() and face.axes[0] @ other.axes[0] > PARALLEL
        if over and height > found and max(face.size) <= SMALL * min(other.size):
            found = float(height)
    return found


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


def drawn_touch(problem: Problem, probe: Probe, samples: Samples) -> tuple[TouchingArm, Array, Array, Array]:
    """The arm as drawn with its plunger, and of rows what it reads (N,), its tips and plungers (N, 3)."""
    local = true_unknowns(problem, probe, 0.0, np.random.default_rng(0))
    arm = TouchingArm.of(problem.robot, problem.instrument, probe, local)
    readings = np.zeros(len(samples)) if probe.column is None else samples.columns[probe.column]
    tips, plungers = arm.place(arm.local, samples.joints, readings[:, None])
    return arm, readings, tips, plungers


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

"""Samples of a simulated arm with the truth they came from, as a value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.errors import SimulationError
from casacal.estimators import lm
from casacal.least_squares.restricted import Restricted
from casacal.problem.cell import Cell
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.measurements import Measurements
from casacal.samples.samples import Samples
from casacal.simulation.faults import ArmErrors, DialErrors, waved
from casacal.simulation.reach import Touch
from casacal.simulation.true_arm import frame_coordinates, plane_coordinates
from casacal.values import Value


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Value):
    """Samples, and the truth they came from: local coordinates of the unknowns by name, and what disturbed them."""

    problem: Problem
    measured: Measurements
    """Samples of every instrument."""
    local: Mapping[str, Array]
    cell: Disturbances
    seed: int
    arm_errors: ArmErrors = ArmErrors()
    """What moves the tip beside the geometry, as it was drawn."""
    dial_errors: DialErrors = DialErrors()
    """What the dial gets wrong beside what the problem declares, as it was drawn."""
    frames: Mapping[str, Array] = field(default_factory=dict)
    """True transforms (4, 4; mm) by name of the frames that rows propose."""
    parts: tuple[Simulation, ...] = ()
    """The same arm with each of several instruments."""

    def __repr__(self) -> str:
        return f"<Simulation of {self.problem.robot.name}, seed {self.seed}: {self.measured.plain!r}>"

    @property
    def samples(self) -> Samples:
        """Samples of the only instrument; raises ProblemError where there are several."""
        _ = self.problem.instrument
        return self.measured.sets[0]

    @property
    def moves_beyond_geometry(self) -> bool:
        """Whether more than lengths, twists and offsets moves the true tip: `true_tips` knows, `local` does not."""
        cell = self.cell
        return bool(cell.gear_waves) or any(getattr(cell, name, 0.0) for name in ("compliance", "thermal"))

    def truth(self, bound: BoundProblem) -> Array:
        """The true x (n,) of a problem bound to these samples (or a part of them)."""
        x, placed = np.zeros(bound.unknowns), np.zeros(bound.unknowns, dtype=bool)
        faces = {face.label: face for face in self.cell.faces} if isinstance(self.cell, Cell) else {}
        for slot in bound.slots:
            if slot.name in self.local and slot.unknown.nominal is not None:
                x[slot.columns] = self.local[slot.name]
            elif slot.name in self.frames:
                x[slot.columns] = frame_coordinates(slot.unknown, slot.nominal, self.frames[slot.name])
            elif faces and slot.unknown.nominal_plane(slot.nominal) is not None:
                face = faces[slot.label] if slot.label is not None else next(iter(faces.values()))
                x[slot.columns] = plane_coordinates(slot.unknown, slot.nominal, np.asarray(face.centre), face.axes[0])
            else:
                placed[slot.columns] = slot.datum or slot.unknown.nominal is None
        if placed.any():  # bodies and frames: where the true arm says they are
            part = Restricted(bound, placed, x)
            x = part.expand(lm(part).x)
        return x

    def of(self, instrument: str) -> Simulation:
        """The same arm with one of several instruments; raises UnknownNameError where none is called so."""
        return self.parts[self.problem.number(instrument)] if self.parts else self

    def true_tips(self, joints: Array, *, readings: Array | None = None, when: Array | float = 0.5) -> Array:
        """Where the tip truly stands when the controller says `joints`: what an ideal tracker would see.

        Gear waves, sag and growth move it beside the geometry. What differs from time to time at the same posture
        (repeatability, backlash, rounded encoders) is taken at its mean, zero. Of several instruments it is the tip of
        the first; `of` gives those of the others.

        Args:
            joints: as the controller says (N, n; rad, mm).
            readings: how far the plunger truly stands (N,; mm); zero by default.
            when: place in the session (N,) or for all, 0 at its first row and 1 at its last; by default half-way.

        Returns:
            Tips (N, 3; mm) in the base frame.

        Raises SimulationError for joints of another shape, and for readings where no plunger shows any.

        """
        if self.parts:
            return self.parts[0].true_tips(joints, readings=readings, when=when)
        problem, probe = self.problem, self.problem.instrument.probe
        q = np.asarray(joints, dtype=np.float64)
        if q.ndim != 2 or q.shape[1] != len(problem.robot.axes):
            raise SimulationError(
                f"Joint values came in the shape {q.shape}", f"Give (N, {len(problem.robot.axes)}) of them"
            )
        if probe is None:
            if readings is not None:
                raise SimulationError(f"{type(problem.instrument).__name__} has no plunger", "Leave the readings out")
            bound = bind(problem.without_effects, self.measured)
            return bound.tips(self.truth(bound), waved(self.arm_errors.waves, q))
        touch = Touch.of(problem.robot, problem.instrument, probe, self.local)
        ways, places = (
            np.broadcast_to(np.asarray(v, dtype=np.float64), len(q))
            for v in (0.0 if readings is None else readings, when)
        )
        return self.arm_errors.tips(touch, q, ways, places)

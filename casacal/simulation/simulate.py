"""Samples of a simulated arm, with the truth behind them: touches of faces, or rows that any residual fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.errors import SimulationError, came
from casacal.estimators import lm
from casacal.least_squares.restricted import Restricted
from casacal.problem.cell import Cell
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.arm_errors import ArmErrors
from casacal.simulation.dial_errors import DialErrors
from casacal.simulation.joint_errors import waved
from casacal.simulation.places import default_cell
from casacal.simulation.reach import Touch
from casacal.simulation.rows import fitting_rows
from casacal.simulation.session import touched_rows
from casacal.simulation.true_arm import plane_coordinates
from casacal.values import FrozenMapping, Value


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Value):
    """Samples, and the truth they came from: local coordinates of the unknowns by name, and what disturbed them."""

    problem: Problem
    samples: Samples
    local: Mapping[str, Array]
    cell: Disturbances
    seed: int
    arm_errors: ArmErrors = ArmErrors()
    """What moves the tip beside the geometry, as it was drawn."""
    dial_errors: DialErrors = DialErrors()
    """What the dial gets wrong beside what the problem declares, as it was drawn."""

    def __repr__(self) -> str:
        return f"<Simulation of {self.problem.robot.name}, seed {self.seed}: {self.samples!r}>"

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
            elif faces and slot.unknown.nominal_plane(slot.nominal) is not None:
                face = faces[slot.label] if slot.label is not None else next(iter(faces.values()))
                x[slot.columns] = plane_coordinates(slot.unknown, slot.nominal, np.asarray(face.centre), face.axes[0])
            else:
                placed[slot.columns] = slot.datum or slot.unknown.nominal is None
        if placed.any():  # bodies and frames: where the true arm says they are
            part = Restricted(bound, placed, x)
            x = part.expand(lm(part).x)
        return x

    def true_tips(self, joints: Array, *, readings: Array | None = None, when: Array | float = 0.5) -> Array:
        """Where the tip truly stands when the controller says `joints`: what an ideal tracker would see.

        Gear waves, sag and growth move it beside the geometry. What differs from time to time at the same posture
        (repeatability, backlash, rounded encoders) is taken at its mean, zero.

        Args:
            joints: as the controller says (N, n; rad, mm).
            readings: how far the plunger truly stands (N,; mm); zero by default.
            when: place in the session (N,) or for all, 0 at its first row and 1 at its last; by default half-way.

        Returns:
            Tips (N, 3; mm) in the base frame.

        Raises SimulationError for joints of another shape, and for readings where no plunger shows any.

        """
        problem, probe = self.problem, self.problem.instrument.probe
        q = np.asarray(joints, dtype=np.float64)
        if q.ndim != 2 or q.shape[1] != len(problem.robot.axes):
            raise SimulationError(
                f"Joint values came in the shape {q.shape}", f"Give (N, {len(problem.robot.axes)}) of them"
            )
        if probe is None:
            if readings is not None:
                raise SimulationError(f"{type(problem.instrument).__name__} has no plunger", "Leave the readings out")
            bound = bind(problem.without_effects, self.samples)
            return bound.tips(self.truth(bound), waved(self.arm_errors.waves, q))
        touch = Touch.of(problem.robot, problem.instrument, probe, self.local)
        ways, places = (
            np.broadcast_to(np.asarray(v, dtype=np.float64), len(q))
            for v in (0.0 if readings is None else readings, when)
        )
        return self.arm_errors.tips(touch, q, ways, places)


MOST_SAMPLES = 1_000_000
"""Rows beyond which drawing postures takes hours."""


def simulate(problem: Problem, cell: Disturbances | None = None, *, samples: int = 120, seed: int = 0) -> Simulation:
    """Draw a true arm from the prior and let its instrument measure.

    An instrument that touches faces (`Instrument.probe`) touches those of a cell: the true tip, at joint values inside
    the limits, within the travel of the dial. Any other instrument measures in random postures: its columns, and where
    it reads none the joints, take the values at which its residual vanishes. What is recorded are the joint values
    without sag, backlash and repeatability, and the readings with their faults.

    Args:
        problem: a robot with one instrument.
        cell: what surrounds and disturbs it; by default `default_cell(problem)` where faces are touched.
        samples: rows, shared evenly between the faces, or between the labels.
        seed: of every random number drawn here.

    Returns:
        The samples (rows in mm and rad), and the truth behind them: `truth(bound)` is the true x (n,) of a bound
        problem.

    Raises SimulationError when it cannot be measured as asked.

    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise SimulationError(f"The seed is {seed!r}", "Give a whole number from zero on")
    if not 1 <= samples <= MOST_SAMPLES:
        raise SimulationError(f"{samples} samples were asked for", f"Ask for at least one, at most {MOST_SAMPLES:,}")
    if not isinstance(problem, Problem):
        raise SimulationError(
            f"{came(problem)} came as the problem", "Give a Problem; load_problem(path).problem is one"
        )
    if cell is not None and not isinstance(cell, Disturbances):
        raise SimulationError(f"{came(cell)} came as the cell", "Give a Cell(faces=...), or Disturbances(...)")
    instrument = problem.instrument
    if instrument.probe is None:
        cell = Disturbances() if cell is None else cell
        rows, local, arm = fitting_rows(problem, cell, samples, seed)
        return Simulation(problem, rows, FrozenMapping(local), cell, seed, arm)
    cell = default_cell(problem) if cell is None else cell
    if not isinstance(cell, Cell):
        raise SimulationError(
            f"{type(instrument).__name__} touches faces, and the disturbances that came have none",
            "Give a Cell(faces=...)",
        )
    rows, local, arm, dial = touched_rows(problem, instrument, instrument.probe, cell, samples, seed)
    return Simulation(problem, rows, FrozenMapping(local), cell, seed, arm, dial)

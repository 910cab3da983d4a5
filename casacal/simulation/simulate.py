"""Samples of a simulated arm, with the truth behind them: touches of faces, or rows that any residual fits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.errors import SimulationError, came
from casacal.estimators import lm
from casacal.instruments import Instrument
from casacal.instruments.instrument import Probe
from casacal.least_squares.restricted import Restricted
from casacal.problem.cell import Cell, Disturbances
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.places import default_cell
from casacal.simulation.reach import Touch
from casacal.simulation.rows import fitting_rows
from casacal.simulation.touches import find_touches
from casacal.simulation.true_arm import lag, plane_coordinates, true_unknowns
from casacal.tables.labels import Labels
from casacal.values import FrozenMapping, Value


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Value):
    """Samples, and the truth they came from: local coordinates of the unknowns by name, and what disturbed them."""

    problem: Problem
    samples: Samples
    local: Mapping[str, Array]
    cell: Disturbances
    seed: int

    def __repr__(self) -> str:
        return f"<Simulation of {self.problem.robot.name}, seed {self.seed}: {self.samples!r}>"

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
        rows, local = fitting_rows(problem, Disturbances() if cell is None else cell, samples, seed)
        return Simulation(problem, rows, FrozenMapping(local), Disturbances() if cell is None else cell, seed)
    cell = default_cell(problem) if cell is None else cell
    if not isinstance(cell, Cell):
        raise SimulationError(
            f"{type(instrument).__name__} touches faces, and the disturbances that came have none",
            "Give a Cell(faces=...)",
        )
    return _touched(problem, instrument, instrument.probe, cell, samples, seed)


def _touched(problem: Problem, instrument: Instrument, probe: Probe, cell: Cell, samples: int, seed: int) -> Simulation:
    """Touches on the faces of a cell."""
    if len(cell.faces) > 1 and probe.label is None:
        raise SimulationError(
            f"The cell has {len(cell.faces)} faces and the problem one plane", 'Declare plane=Plane(per="plane")'
        )
    truth_rng, pose_rng, noise_rng, form_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4))
    local = true_unknowns(problem, probe, cell.error_scale, truth_rng)
    touch = Touch.of(problem.robot, instrument, probe, local)
    which = np.arange(samples) % len(cell.faces)
    noise = probe.noise_std if cell.repeatability is None else cell.repeatability
    gross = noise_rng.random(samples) < cell.outliers
    outlier = gross * noise_rng.choice([-1.0, 1.0], size=samples) * cell.outlier_size * noise_rng.uniform(1, 2, samples)
    # errors of touch and form raise the face under the tip; a dial's own errors come on top of its reading
    lift = noise_rng.normal(size=samples) * (noise if probe.column is None else probe.contact_std)
    if probe.column is None:
        lift = lift + outlier
    joints, readings = find_touches(touch, probe, cell, which, lift, pose_rng, form_rng)
    recorded = joints - _sag(touch, joints, readings, cell.compliance)
    recorded -= noise_rng.normal(size=joints.shape) * cell.joint_std
    recorded += lag(joints, cell.backlash)
    columns = {}
    if probe.column is not None:
        shown = readings + noise_rng.normal(size=samples) * noise + outlier
        columns[probe.column] = np.round(shown / cell.resolution) * cell.resolution if cell.resolution > 0 else shown
    labels = {probe.label: Labels([face.label for face in cell.faces], which)} if probe.label is not None else {}
    name = f"simulated-{seed}"
    rows = Samples(recorded, columns, labels, tuple(range(1, samples + 1)), {}, name, name)
    return Simulation(problem, rows, FrozenMapping(local), cell, seed)


def _sag(touch: Touch, joints: Array, readings: Array, compliance: float) -> Array:
    """Joint deflections (N, n) under gravity on the tip: each joint yields to its own torque, J' of the height.

    Scaled so that the tip sags by `compliance` mm RMS over the samples.
    """
    if compliance == 0:
        return np.zeros_like(joints)
    _, _, slope, _ = touch(joints, readings)
    lever = slope[:, 2, :]
    yielding = -lever * touch.robot.revolute
    sags = np.linalg.norm(np.einsum("kai,ki->ka", slope, yielding), axis=1)
    return np.asarray(yielding * compliance / math.sqrt(float((sags**2).mean())))

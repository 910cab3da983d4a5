"""Samples of a simulated cell, with the truth behind them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.errors import SimulationError
from casacal.estimators import lm
from casacal.instruments import DialOnPlane
from casacal.least_squares.objective import Restricted
from casacal.problem.cell import Cell, Face, corner
from casacal.problem.problem import Problem
from casacal.robots.joint_space import random_joints
from casacal.samples.samples import Samples
from casacal.simulation.reach import Touch
from casacal.simulation.touches import find_touches, try_touches
from casacal.tables.labels import Labels
from casacal.unknowns import Plane


@dataclass(frozen=True)
class Simulation:
    """Samples, and the truth they came from: local coordinates of the arm's unknowns, and the cell."""

    problem: Problem
    samples: Samples
    local: Mapping[str, Array]
    cell: Cell
    seed: int

    def truth(self, bound: BoundProblem) -> Array:
        """The true x (n,) of a problem bound to these samples (or a part of them)."""
        x = np.zeros(bound.unknowns)
        faces = {face.label: face for face in self.cell.faces}
        for slot in bound.slots:
            if slot.key in self.local:
                x[slot.columns] = self.local[slot.key]
            elif isinstance(slot.unknown, Plane) and slot.unknown.size:
                face = faces[slot.label] if slot.label is not None else self.cell.faces[0]
                x[slot.columns] = plane_coordinates(slot.unknown, slot.nominal, face)
        placed = np.array(
            [slot.datum and not isinstance(slot.unknown, Plane) for slot in bound.slots for _ in slot.columns]
        )
        if placed.any():  # bodies and frames: where the true arm says they are
            part = Restricted(bound, placed, x)
            x = part.expand(lm(part).x)
        return x


def plane_coordinates(plane: Plane, nominal: Array, face: Face) -> Array:
    """Local coordinates (3,) of a face about a nominal plane."""
    normal = face.axes[0]
    normal = normal if normal @ nominal[:3] > 0 else -normal
    raw = np.concatenate([normal, [normal @ (np.asarray(face.centre) - nominal[9:12])]])
    return np.asarray(plane.raw_local(ca.DM(nominal), ca.DM(raw))).ravel()


def simulate(problem: Problem, cell: Cell | None = None, *, samples: int = 120, seed: int = 0) -> Simulation:
    """Draw a true arm from the prior and let it touch the faces of a cell.

    The true tip, at joint values inside the limits, touches a face within the dial's travel; what is recorded are the
    joint values without sag, backlash and repeatability, and the reading with its faults.

    Args:
        problem: one robot with one `DialOnPlane`.
        cell: what surrounds it; by default `default_cell(problem)`.
        samples: rows, shared evenly between the faces.
        seed: of every random number drawn here.

    Raises SimulationError when the faces cannot be touched as asked.

    """
    instrument = dial_of(problem)
    cell = default_cell(problem) if cell is None else cell
    if samples < 1:
        raise SimulationError(f"{samples} samples were asked for", "Ask for at least one")
    if len(cell.faces) > 1 and instrument.plane.per is None:
        raise SimulationError(
            f"The cell has {len(cell.faces)} faces and the problem one plane", 'Declare plane=Plane(per="plane")'
        )
    truth_rng, pose_rng, noise_rng, form_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4))
    local = true_unknowns(problem, cell.error_scale, truth_rng)
    touch = Touch.of(problem.robot, instrument, local)
    which = np.arange(samples) % len(cell.faces)
    noise = instrument.noise_std if cell.repeatability is None else cell.repeatability
    gross = noise_rng.random(samples) < cell.outliers
    outlier = gross * noise_rng.choice([-1.0, 1.0], size=samples) * cell.outlier_size * noise_rng.uniform(1, 2, samples)
    # errors of touch and form raise the face under the tip; a dial's own errors come on top of its reading
    lift = noise_rng.normal(size=samples) * (instrument.contact_std if instrument.reading else noise)
    if not instrument.reading:
        lift = lift + outlier
    joints, readings = find_touches(touch, instrument, cell, which, lift, pose_rng, form_rng)
    recorded = joints - _sag(touch, joints, readings, cell.compliance)
    recorded -= noise_rng.normal(size=joints.shape) * cell.joint_std
    recorded += _lag(joints, cell.backlash)
    columns = {}
    if instrument.reading:
        shown = readings + noise_rng.normal(size=samples) * noise + outlier
        columns["reading"] = np.round(shown / cell.resolution) * cell.resolution if cell.resolution > 0 else shown
    labels = {"plane": Labels([face.label for face in cell.faces], which)} if instrument.plane.per else {}
    name = f"simulated-{seed}"
    rows = Samples(recorded, columns, labels, tuple(range(1, samples + 1)), {}, name, name)
    return Simulation(problem, rows, MappingProxyType(local), cell, seed)


def dial_of(problem: Problem) -> DialOnPlane:
    """Return the one instrument of a problem that the simulator understands; raises SimulationError."""
    (first, *others) = problem.instruments
    if others or not isinstance(first, DialOnPlane):
        names = ", ".join(type(instrument).__name__ for instrument in problem.instruments)
        raise SimulationError(f"The problem is measured by {names}", "The simulator knows one DialOnPlane alone")
    return first


def true_unknowns(problem: Problem, error_scale: float, rng: np.random.Generator) -> dict[str, Array]:
    """Local coordinates of the arm's unknowns, drawn from the prior (flat: `start_std`) times `error_scale`."""
    dial = dial_of(problem)
    unknowns = {**problem.robot.parameters, "tool": dial.tool, "plunger": dial.plunger}
    return {key: error_scale * u.start_stds * rng.normal(size=u.size) for key, u in unknowns.items()}


def default_cell(problem: Problem) -> Cell:
    """Three faces at right angles where this arm touches them most readily; the same for the same problem.

    Raises SimulationError when no such place is found, as for arms that cannot point their plunger freely.
    """
    instrument, rng = dial_of(problem), np.random.default_rng(0)
    nominal = true_unknowns(problem, 0.0, rng)
    touch = Touch.of(problem.robot, instrument, nominal)
    tips = touch(random_joints(problem.robot, 400, rng), np.zeros(400))[0]
    base = np.median(tips, axis=0)
    reach = float(np.quantile(np.linalg.norm(tips - base, axis=1), 0.9))
    size = min(600.0, 0.4 * reach)
    best, best_share = None, 0.0
    for centre in tips[rng.choice(len(tips), 24, replace=False)]:
        away = (base - centre)[:2]
        faces = corner(centre, size=size, towards=away if np.linalg.norm(away) > 1e-6 else (-1.0, 0.0))
        cell = Cell(faces=faces)
        share = _share_reached(touch, instrument, cell, np.random.default_rng(1))
        if share > best_share:
            best, best_share = cell, share
    if best is None or best_share < 0.1:
        raise SimulationError(
            f"No place was found where '{problem.robot.name}' can touch three faces at right angles",
            "Define `cell = Cell(faces=...)` in the problem file",
        )
    return best


def _share_reached(touch: Touch, instrument: DialOnPlane, cell: Cell, rng: np.random.Generator) -> float:
    which = np.arange(30) % len(cell.faces)
    *_, good = try_touches(touch, instrument, cell, which, np.zeros(30), [None] * len(cell.faces), rng)
    shares = [good[which == i].mean() for i in range(len(cell.faces))]
    return float(min(shares))


def _sag(touch: Touch, joints: Array, readings: Array, compliance: float) -> Array:
    """Joint deflections (N, n) under gravity on the tip: each joint yields to its own torque, J' of the height.

    Scaled so that the tip sags by `compliance` mm RMS over the samples.
    """
    if compliance == 0:
        return np.zeros_like(joints)
    _, _, slope, _ = touch(joints, readings)
    lever = slope[:, 2, :]
    turns = np.array([joint.kind == "revolute" for joint in touch.robot.axes])
    yielding = -lever * turns
    sags = np.linalg.norm(np.einsum("kai,ki->ka", slope, yielding), axis=1)
    return np.asarray(yielding * compliance / math.sqrt(float((sags**2).mean())))


def _lag(joints: Array, backlash: float) -> Array:
    """How far joints (N, n) stand behind what they were sent to: half the backlash against each joint's last move.

    The arm moves from row to row as they come, to the first one from all joints at zero.
    """
    moves = np.diff(joints, axis=0, prepend=np.zeros((1, joints.shape[1])))
    return np.asarray(np.sign(moves) * backlash / 2)

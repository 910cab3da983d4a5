"""Simulated samples: an arm drawn from the prior, its touches and its truth, as a value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.errors import SamplesError, SimulationError, came
from casacal.estimators import lm
from casacal.least_squares.conditioned import Conditioned
from casacal.problem.problem import Problem
from casacal.samples.layout import Layout
from casacal.samples.measurements import Measurements
from casacal.samples.samples import Samples
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.faults import ArmErrors, DialErrors, waved
from casacal.simulation.reach import TouchingArm
from casacal.simulation.rows import fitting_rows
from casacal.simulation.session import touched_rows
from casacal.simulation.touches import default_cell, refuse_lost_steps
from casacal.simulation.true_arm import Draw, check_asked, frame_coordinates, plane_coordinates
from casacal.values import FrozenMapping, Value

ROUNDED = 1e-5  # rad or mm by which postures of a file may be beyond a joint's limit
MOST_SAMPLES = 1_000_000  # rows beyond which drawing postures takes hours


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
            part = Conditioned(bound, placed, x)
            x = part.expand(lm(part).x)
        return x

    def of(self, instrument: str) -> Simulation:
        """The same arm with one of several instruments; raises UnknownNameError where none is called so."""
        return self.parts[self.problem.number(instrument)] if self.parts else self

    def true_tips(self, joints: Array, *, readings: Array | None = None, when: Array | float = 0.5) -> Array:
        """Where the tip truly stands (N, 3; mm, base frame) at `joints` of the controller: what an ideal tracker sees.

        Gear waves, sag and growth move it beside the geometry. What differs from time to time at the same posture
        (repeatability, backlash, rounded encoders) is taken at its mean, zero. Of several instruments it is the tip of
        the first; `of` gives those of the others.

        Args:
            joints: as the controller says (N, n; rad, mm).
            readings: how far the plunger truly stands (N,; mm); zero by default.
            when: place in the session (N,) or for all, 0 at its first row and 1 at its last; by default half-way.

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
            bound = bind(problem.without_terms, self.measured)
            return bound.tips(self.truth(bound), waved(self.arm_errors.waves, q))
        touch = TouchingArm.of(problem.robot, problem.instrument, probe, self.local)
        ways, places = (
            np.broadcast_to(np.asarray(v, dtype=np.float64), len(q))
            for v in (0.0 if readings is None else readings, when)
        )
        return self.arm_errors.tips(touch, q, ways, places)


def simulate_one(problem: Problem, cell: Disturbances | None, samples: int | Samples, draw: Draw) -> Simulation:
    """Samples of a problem with one instrument; raises SimulationError when it cannot be measured as asked."""
    instrument = problem.instrument
    if instrument.probe is None:
        cell = Disturbances() if cell is None else cell
        rows, bench, arm = fitting_rows(problem, cell, samples, draw)
        true, frames = FrozenMapping(bench.local), FrozenMapping(bench.frames)
        return Simulation(problem, Measurements.of(rows), true, cell, draw.seed, arm, frames=frames)
    cell = default_cell(problem) if cell is None else cell
    if not isinstance(cell, Cell):
        raise SimulationError(
            f"{type(instrument).__name__} touches faces, and the disturbances that came have none",
            "Give a Cell(faces=...)",
        )
    refuse_lost_steps(problem, instrument.probe, cell)
    rows, local, arm, dial = touched_rows(problem, instrument, instrument.probe, cell, samples, draw)
    return Simulation(problem, Measurements.of(rows), FrozenMapping(local), cell, draw.seed, arm, dial)


def simulate_several(
    problem: Problem, cell: Disturbances | None, counts: Mapping[str, int], seed: int, session: int = 0
) -> Simulation:
    """Samples of every instrument on the same true arm; what they share is the same, too.

    Those that touch faces touch those of the cell. Raises SimulationError as `simulate` does, and for what only those
    that touch can be asked.
    """
    local: dict[str, Array] = {}
    frames: dict[str, Array] = {}
    parts: list[Simulation] = []
    for i, name in enumerate(problem.names):
        alone = problem.measured_by(name)
        names = {key: key for key in problem.robot.parameters} | dict(problem.full_names[i])
        known = {key: local[full] for key, full in names.items() if full in local}
        own = cell if alone.instrument.probe is not None else _elsewhere(alone, cell)
        occasion = i + len(problem.names) * session
        part = simulate_one(alone, own, counts[name], Draw(seed, occasion, FrozenMapping(known)))
        parts.append(part)
        for of_part, of_all in ((part.local, local), (part.frames, frames)):
            for key, value in of_part.items():
                head, dot, label = key.partition(".")
                of_all.setdefault(names[head] + dot + label, value)
    sets = tuple(part.samples for part in parts)
    touched = next((part.cell for part in parts if isinstance(part.cell, Cell)), parts[0].cell)
    together, true = Measurements(problem.names, sets), FrozenMapping(frames)
    return Simulation(problem, together, FrozenMapping(local), touched, seed, frames=true, parts=tuple(parts))


def _elsewhere(alone: Problem, cell: Disturbances | None) -> Disturbances | None:
    """What disturbs an instrument that touches no faces, in the cell of those that do."""
    if not isinstance(cell, Cell):
        return cell
    check_asked(alone, cell)
    return Disturbances(**{field.name: getattr(cell, field.name) for field in fields(Disturbances)})


def simulate(
    problem: Problem,
    cell: Disturbances | None = None,
    *,
    samples: int | Mapping[str, int] | Samples = 120,
    seed: int = 0,
    session: int = 0,
) -> Simulation:
    """Draw a true arm from the prior and let its instruments measure.

    An instrument that touches faces (`Instrument.probe`) touches those of a cell: the true tip, at joint values inside
    the limits, within the travel of the dial. Any other instrument measures in random postures: its columns, and where
    it reads none the joints, take the values at which its residual vanishes. What is recorded are the joint values
    without sag, backlash and repeatability, and the readings with their faults.

    Args:
        problem: a robot with its instruments; what they share is the same for all.
        cell: what surrounds and disturbs it; by default `default_cell(problem)` where faces are touched.
        samples: rows, shared evenly between the faces, or between the labels; of several instruments each has so
            many, or as many as stand by its name. Or the postures to measure in, such as `samples` of a plan. Those
            are left out where the true arm cannot, as the reading is beyond its range; `lines` count all of them.
        seed: of every random number drawn here.
        session: on which occasion the arm of that seed is measured: another one has other postures and other noise.

    Raises SimulationError when it cannot be measured as asked.

    """
    for name, number in (("seed", seed), ("session", session)):
        if not isinstance(number, (int, np.integer)) or number < 0:
            raise SimulationError(f"The {name} is {number!r}", "Give a whole number from zero on")
    if not isinstance(problem, Problem):
        raise SimulationError(
            f"Got {came(problem)} as the problem", "Give a Problem; load_problem(path).problem is one"
        )
    if cell is not None and not isinstance(cell, Disturbances):
        raise SimulationError(f"Got {came(cell)} as the cell", "Give a Cell(faces=...), or Disturbances(...)")
    if isinstance(samples, Samples):
        found = simulate_one(problem, cell, _postures_of(problem, samples), Draw(int(seed), int(session)))
        if not len(found.samples):
            raise SimulationError(
                f"In none of the {len(samples)} postures can the true arm measure",
                "Plan them for this problem and cell",
            )
        return found
    asked = _counts_of(problem, samples)
    if len(problem.instruments) > 1:
        return simulate_several(problem, cell, asked, int(seed), int(session))
    return simulate_one(problem, cell, asked[problem.names[0]], Draw(int(seed), int(session)))


def _postures_of(problem: Problem, samples: Samples) -> Samples:
    """Postures of an only instrument, inside the joint limits.

    Raises ProblemError of several, SamplesError without the joints and labels that it takes.
    """
    _ = problem.instrument
    layout, robot = problem.layout(), problem.robot
    samples.check(Layout(layout.joints, {}, layout.labels))
    _check_count(len(samples))
    lower, upper = robot.limits
    beyond = np.maximum(lower - samples.joints, samples.joints - upper) > ROUNDED
    if beyond.any():
        k, j = map(int, np.argwhere(beyond)[0])
        factor, unit = (180 / math.pi, "degrees") if robot.revolute[j] else (1.0, "mm")
        raise SamplesError(
            samples.file,
            f"joint {j + 1} stands at {factor * samples.joints[k, j]:.6g} {unit}, outside its limits "
            f"{factor * lower[j]:g} to {factor * upper[j]:g}",
            "Leave the posture out, or mend the limits of the robot",
            line=int(samples.lines[k]),
        )
    return samples


def _counts_of(problem: Problem, samples: int | Mapping[str, int]) -> dict[str, int]:
    """How many rows each instrument takes."""
    if isinstance(samples, Mapping):
        for name in samples:
            problem.number(name)
        if missing := [name for name in problem.names if name not in samples]:
            raise SimulationError(f"How many samples of the {missing[0]} was not said", f"Say it: {missing[0]}=120")
    counts = {name: samples[name] if isinstance(samples, Mapping) else samples for name in problem.names}
    for count in counts.values():
        _check_count(count)
    return {name: int(count) for name, count in counts.items()}


def _check_count(count: object) -> None:
    """Raise SimulationError unless so many samples can be simulated."""
    if not isinstance(count, (int, np.integer)):
        fix = "Give a number, numbers by the name of the instrument, or the postures of a plan: plan.samples"
        raise SimulationError(f"Got {came(count)} as the samples", fix)
    if not 1 <= count <= MOST_SAMPLES:
        fix = f"Ask for at least one, at most {MOST_SAMPLES:,}"
        raise SimulationError(f"{count} samples were asked for", fix)

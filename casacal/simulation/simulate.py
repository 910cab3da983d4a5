"""Simulated samples: an arm drawn from the prior, its touches in sessions or rows of any residual, and the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from casacal.data.columns import Labels
from casacal.data.samples import Layout, Measurements, Samples
from casacal.errors import SamplesError, SimulationError, came
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.least_squares import Conditioned
from casacal.fit.lm import lm
from casacal.model.instrument import Probe, readings_within
from casacal.model.problem import Problem
from casacal.simulation.bench import Bench, bench_of, found_rows, read_there
from casacal.simulation.cell import Cell, Disturbances, Face, levels, rectangles
from casacal.simulation.faults import (
    ArmErrors,
    DialErrors,
    drawn_waves,
    gross_errors,
    last_moves,
    rounded,
    unwaved,
    waved,
    ways,
    weighed,
)
from casacal.simulation.places import default_cell, refuse_cell
from casacal.simulation.touches import (
    EDGE,
    MOST_ROUNDS,
    ROUNDS,
    Draw,
    TouchingArm,
    frame_coordinates,
    own_noise,
    plane_coordinates,
    refuse_face_settings,
    row_labels,
    true_unknowns,
    try_touches,
)
from casacal.values import Array, FrozenMapping, Index, Rows, Value


@dataclass(frozen=True)
class SessionPlan:
    """Touches of a session (N,): the face and the place of each row, and the how manieth touch of its face it is."""

    which: Index
    place: Index
    turn: Index

    @staticmethod
    def of(samples: int, faces: int, repeats: int) -> SessionPlan:
        """Faces in turn, each place so many times in a row."""
        rows = np.arange(samples)
        place = rows // repeats
        return SessionPlan(place % faces, place, place // faces * repeats + rows % repeats)

    @staticmethod
    def at(postures: Samples, column: str | None, faces: Sequence[Face]) -> SessionPlan:
        """One touch in each posture, of the face that its label names; raises SimulationError where there is none."""
        known = {face.label: k for k, face in enumerate(faces)}
        names = [faces[0].label] * len(postures) if column is None else list(postures.labels[column])
        if lost := next((name for name in names if name not in known), None):
            raise SimulationError(
                f"{postures.file} touches '{lost}' (column '{column}'), which is no face of the cell",
                f"Its faces are {', '.join(known)}",
            )
        which = np.array([known[name] for name in names], dtype=np.intp)
        turn = np.array([(which[:k] == which[k]).sum() for k in range(len(which))])
        return SessionPlan(which, np.arange(len(which)), turn)

    @cached_property
    def again(self) -> Rows:
        """Rows (N,) that touch a place once more."""
        return np.asarray(np.diff(self.place, prepend=-1) == 0)

    @cached_property
    def first(self) -> Index:
        """The row that touches each place first (P,)."""
        return np.flatnonzero(~self.again)

    @cached_property
    def when(self) -> Array:
        """Places (N,) of the rows in the session, 0 to 1."""
        return np.arange(len(self.which)) / max(len(self.which) - 1, 1)


FIRST = "first"  # name of a simulated session, and of other labels that are no faces


@dataclass(frozen=True)
class _Contact:
    """Contact in one session: faces with form errors, errors of touch, thermal growth of the arm.

    lift: by how much each touch stands above its face (N,; mm). forms: a seed for the form of each face. growth: times
    (N,) that the tip is further from the base.
    """

    touch: TouchingArm
    probe: Probe
    cell: Cell
    plan: SessionPlan
    lift: Array
    forms: Sequence[int | None]
    growth: Array

    def found(self, rng: np.random.Generator, poses: Array | None = None) -> tuple[Array, Array]:
        """Joints (P, n) and true readings (P,) of the first touch of each place; poses: as for `try_touches`."""
        touch, cell, first = self.touch, self.cell, self.plan.first
        which, lift, growth = self.plan.which[first], self.lift[first], self.growth[first]
        joints, readings = np.full((len(which), len(touch.robot.axes)), np.nan), np.full(len(which), np.nan)
        waiting = np.arange(len(which))
        for tried in range(MOST_ROUNDS):
            if tried >= ROUNDS and 2 * len(waiting) > len(which):
                break
            found = try_touches(touch, self.probe, cell, which, lift, self.forms, rng, waiting, growth, poses=poses)
            good = found[2]
            joints[waiting[good]], readings[waiting[good]] = found[0][good], found[1][good]
            waiting = waiting[~good]
            if not waiting.size:
                return joints, readings
        label = cell.faces[int(which[waiting[0]])].label
        raise SimulationError(
            f"'{touch.robot.name}' cannot touch face '{label}' within joint limits, tilt {math.degrees(cell.tilt):g} "
            f"degrees and the dial's travel ({len(waiting)} of {len(which)} samples are missing)",
            "Move or enlarge the face, or allow more tilt",
        )

    def there(self, standing: Array, readings: Array) -> tuple[Array, Array, Rows]:
        """Joint corrections until contact (N, n), plunger positions (N,), and which touches succeeded.

        standing: joints (N, n) as they truly stand. readings: expected ones (N,); where the dial would be near an end
        of its travel, the arm is moved until it reads about that, as operators do. Faces reach as far as anybody asks.
        """
        axes, centres, half = (each[self.plan.which] for each in rectangles(self.cell.faces))
        tips, _ = self.touch.place(self.touch.local, standing, readings[:, None])
        uv = np.clip(np.einsum("kx,kax->ka", tips - centres, axes[:, 1:]) / half, -1, 1)
        normals, heights = axes[:, 0], levels(self.cell, self.plan.which, uv, self.forms, self.lift) / self.growth
        moved, ways_in = self._met(standing, readings, normals, heights)
        low, high = readings_within(self.probe.travel if self.cell.travel is None else self.cell.travel)
        low, high = low + EDGE * (high - low), high - EDGE * (high - low)
        if self.probe.column is not None and (out := ~((ways_in >= low) & (ways_in <= high))).any():
            ways_in[out] = np.clip(readings[out], low, high)
            moved[out] = self.touch.land(standing[out], ways_in[out], normals[out], heights[out]) - standing[out]
        tips, _ = self.touch.place(self.touch.local, standing + moved, ways_in[:, None])
        met = np.abs((normals * tips).sum(axis=1) - heights) < 1e-6
        return moved, ways_in, met & self.touch.within_limits(standing + moved)[1]

    def again(self, joints: Array, readings: Array, standing: Array) -> tuple[Array, Array]:
        """Joint offsets of repeats from the first touch at their place (N, n), and plunger positions (N,).

        joints, readings: of the first touch of each place. standing: joints (N, n) as they stand with the same said.
        """
        plan, touch, again = self.plan, self.touch, self.plan.again
        normals = np.array([face.axes[0] for face in self.cell.faces])[plan.which]
        tips, _ = touch.place(touch.local, joints, readings[:, None])
        level = (normals[plan.first] * tips).sum(axis=1) * self.growth[plan.first] - self.lift[plan.first]
        heights = (level[plan.place] + self.lift) / self.growth
        moved, ways_in = np.zeros_like(standing), readings[plan.place]
        moved[again], ways_in[again] = self._met(standing[again], ways_in[again], normals[again], heights[again])
        return moved, ways_in

    def _met(self, standing: Array, readings: Array, normals: Array, heights: Array) -> tuple[Array, Array]:
        """Joint corrections (N, n) that bring the tip to its height, and plunger positions (N,).

        A plunger makes up for joints that stand elsewhere; a tool without one moves on until it touches.
        """
        if self.probe.column is None:
            return self.touch.land(standing, readings, normals, heights) - standing, readings
        return np.zeros_like(standing), self.touch.plunge(standing, readings, normals, heights)


def touched_rows(
    problem: Problem,
    probe: Probe,
    cell: Cell,
    samples: int | Samples,
    draw: Draw,
    poses: Array | None = None,
    touch: TouchingArm | None = None,
) -> tuple[Samples, dict[str, Array], ArmErrors, DialErrors]:
    """Samples of touches, the true local coordinates by name, and the errors of arm and dial that were drawn.

    samples: how many, or the postures in which to touch; those in which the true arm cannot are left out. poses:
    (K, n; rad, mm) from which postures are sought; by default random ones. touch: the true arm, where it is known.
    """
    truth_rng, pose_rng, noise_rng, form_rng, gear_rng, dial_rng, way_rng = draw.streams(7, of_the_arm=(0, 3, 4))
    local = draw.true(true_unknowns(problem, probe, cell.error_scale, truth_rng))
    touch = touch or TouchingArm.of(problem.robot, problem.instrument, probe, local)
    postures = samples if isinstance(samples, Samples) else None
    if isinstance(samples, Samples):
        cell, plan = replace(cell, repeats=1), SessionPlan.at(samples, probe.label, cell.faces)
    else:
        plan = SessionPlan.of(samples, len(cell.faces), cell.repeats)
    count = len(plan.which)
    noise, outlier, lift = _touch_errors(probe, cell, count, noise_rng)
    arm = ArmErrors(thermal=cell.thermal, waves=drawn_waves(problem.robot, cell.waves, gear_rng))
    forms = [int(form_rng.integers(2**32)) if cell.flatness > 0 else None for _ in cell.faces]
    contact = _Contact(touch, probe, cell, plan, lift, forms, arm.growth(plan.when))
    if postures is None:
        joints, readings = contact.found(pose_rng, poses)
    else:
        joints, readings = postures.joints, postures.columns.get(probe.column or "", np.zeros(count))
    if cell.compliance > 0:
        arm = replace(arm, compliance=cell.compliance, pull=_pull(touch, probe, cell, draw, poses))
    sag = arm.sag(touch, joints, readings)
    came, pushed = ways(joints, plan.turn, cell.repeats, cell.approach, way_rng)
    scatter, lag = noise_rng.normal(size=(count, joints.shape[1])) * cell.joint_std, came * cell.backlash / 2
    said, ways_in, met = joints, readings[plan.place], np.ones(count, dtype=bool)
    if postures is None:
        said = unwaved(arm.waves, joints - sag - scatter[plan.first] + lag[plan.first])[plan.place]
    standing = waved(arm.waves, said) + sag[plan.place] + scatter - lag
    moved = np.zeros_like(said)
    if postures is not None:
        moved, ways_in, met = contact.there(standing, ways_in)
    elif plan.again.any():
        moved, ways_in = contact.again(joints, readings, standing)
    if moved.any():  # by as much the joints themselves move
        said = unwaved(arm.waves, waved(arm.waves, said) + moved)
    columns, dial = dict[str, Array](), DialErrors.drawn(cell, dial_rng)
    if probe.column is not None:
        shown = dial.shown(ways_in, -probe.sign * pushed, plan.when) + noise_rng.normal(size=count) * noise + outlier
        columns[probe.column] = rounded(shown, cell.resolution)
    labels = _labels(problem, probe, cell, plan) if postures is None else dict(postures.labels)
    recorded = rounded(said, cell.encoder_step)
    file = draw.name if postures is None else postures.file
    rows = Samples(recorded, columns, labels, tuple(range(1, count + 1)), {}, file, draw.name)
    return rows if met.all() else rows.take(np.flatnonzero(met)), local, arm, dial


WEIGHED = 120  # touches over which an arm's sag is as large as it is said to be, whatever is touched afterwards


def _pull(touch: TouchingArm, probe: Probe, cell: Cell, draw: Draw, poses: Array | None) -> float:
    """RMS move (mm^2) of the tip as joints yield, over touches of the arm's first session."""
    plan = SessionPlan.of(WEIGHED, len(cell.faces), 1)
    _, rng = replace(draw, session=0).streams(2, of_the_arm=(0,))  # of postures, as `touched_rows` has it
    flat, plain = [None] * len(cell.faces), np.ones(WEIGHED)
    return weighed(touch, *_Contact(touch, probe, cell, plan, np.zeros(WEIGHED), flat, plain).found(rng, poses))


def _touch_errors(probe: Probe, cell: Cell, count: int, rng: np.random.Generator) -> tuple[float, Array, Array]:
    """Noise of a touch, mm, gross errors (N,), and by how much each touch stands above its face (N,).

    Errors of touch raise the face under the tip; a dial's own errors come on top of its reading.
    """
    noise = probe.noise_std if cell.repeatability is None else cell.repeatability
    outlier = gross_errors(cell, count, rng)
    lift = rng.normal(size=count) * (noise if probe.column is None else probe.contact_std)
    return noise, outlier, lift + outlier if probe.column is None else lift


def _labels(problem: Problem, probe: Probe, cell: Cell, plan: SessionPlan) -> dict[str, Labels]:
    """Labels of the rows by column: their faces; other labels are all alike."""
    count = len(plan.which)
    labels = {name: Labels([FIRST], np.zeros(count, dtype=np.intp)) for name in problem.layout().labels}
    if probe.label is not None:
        labels[probe.label] = Labels([face.label for face in cell.faces], plan.which)
    return labels


def fitting_rows(
    problem: Problem, cell: Disturbances, samples: int | Samples, draw: Draw
) -> tuple[Samples, Bench, ArmErrors]:
    """Samples of an instrument that is shown no faces, the true arm before it, and the arm's errors.

    samples: how many, or the postures in which to measure; those in which the true arm cannot are left out. Raises
    SimulationError when no posture inside the joint limits fits, or a cell asks for what only faces have.
    """
    refuse_face_settings(problem, cell)
    truth_rng, pose_rng, noise_rng, _, gear_rng = draw.streams(5, of_the_arm=(0, 4))
    postures, count = (samples, len(samples)) if isinstance(samples, Samples) else (None, samples)
    labels = row_labels(problem, cell, count) if postures is None else dict(postures.labels)
    bench = bench_of(problem, cell, labels, truth_rng, count, draw)
    instrument, n = problem.instrument, len(problem.robot.axes)
    outlier = gross_errors(cell, count, noise_rng)
    own = own_noise(problem) if cell.repeatability is None else cell.repeatability
    target = noise_rng.normal(size=(count, problem.model.components)) * own + outlier[:, None]
    scatter = noise_rng.normal(size=(count, n)) * cell.joint_std
    arm = ArmErrors(drawn_waves(problem.robot, cell.waves, gear_rng))
    if postures is None:
        free, met = found_rows(bench, target, pose_rng)
        if not met.all():
            raise _no_posture(bench, target, met, pose_rng)
        lag = last_moves(free[:, :n]) * cell.backlash / 2
        said = unwaved(arm.waves, free[:, :n] - scatter + lag)
    else:
        standing = waved(arm.waves, postures.joints) + scatter - last_moves(postures.joints) * cell.backlash / 2
        free, met = read_there(bench, standing, target)
        said = unwaved(arm.waves, waved(arm.waves, postures.joints) + free[:, :n] - standing)
    recorded = rounded(said, cell.encoder_step)
    columns, read = {}, instrument.as_read(dict(zip(instrument.columns, free[:, n:].T, strict=True)))
    for name, dimension in instrument.columns.items():
        shown = read[name] + noise_rng.normal(size=count) * instrument.column_stds.get(name, 0.0)
        columns[name] = rounded(shown, cell.resolution if dimension == "length" else 0.0)
    file = draw.name if postures is None else postures.file
    rows = Samples(recorded, columns, labels, tuple(range(1, count + 1)), {}, file, draw.name)
    return rows if met.all() else rows.take(np.flatnonzero(met)), bench, arm


ROUNDED = 1e-5  # rad or mm by which postures of a file may be beyond a joint's limit
MOST_SAMPLES = 1_000_000  # rows beyond which drawing postures takes hours


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Value):
    """Samples, and the truth that they came from.

    measured: samples of every instrument. local: local coordinates of the unknowns, by name. cell: what disturbed them.
    arm_errors, dial_errors: what moves the tip beside the geometry, and what the dial gets wrong beside what the
    problem declares, as they were drawn. frames: true transforms (4, 4; mm) by name of the frames that rows propose.
    parts: the same arm with each of several instruments.
    """

    problem: Problem
    measured: Measurements
    local: Mapping[str, Array]
    cell: Disturbances
    seed: int
    arm_errors: ArmErrors = ArmErrors()
    dial_errors: DialErrors = DialErrors()
    frames: Mapping[str, Array] = field(default_factory=dict)
    parts: tuple[Simulation, ...] = ()

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
        """The true arm with one of several instruments; raises UnknownNameError for an unknown one."""
        return self.parts[self.problem.number(instrument)] if self.parts else self

    def true_tips(self, joints: Array, *, readings: Array | None = None, when: Array | float = 0.5) -> Array:
        """True tips (N, 3; mm, base frame) at `joints` of the controller, as an ideal tracker sees them.

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
            fix = f"Give (N, {len(problem.robot.axes)}) of them"
            raise SimulationError(f"Joint values came in the shape {q.shape}", fix)
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


def _no_posture(bench: Bench, target: Array, met: Rows, rng: np.random.Generator) -> SimulationError:
    """Why some rows find no posture: for the limits of readings, where they would find one without these."""
    robot, instrument = bench.problem.robot, bench.problem.instrument
    what = (
        f"No posture inside the limits of '{robot.name}' and its readings makes the residual of "
        f"{type(instrument).__name__} vanish in {(~met).sum()} of {len(met)} rows"
    )
    limits = instrument.reading_limits
    if limits and found_rows(bench, target, rng, 1, limited=False)[1].sum() > met.sum():
        said = ", ".join(f"'{name}' {low:g} to {high:g}" for name, (low, high) in limits.items())
        return SimulationError(f"{what}; without its reading_limits ({said}) more do", "Widen reading_limits")
    fix = "Give its unknowns nominal values within the arm's reach, or give the instrument a `probe`"
    return SimulationError(what, fix)


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
    refuse_cell(problem, instrument.probe, cell)
    rows, local, arm, dial = touched_rows(problem, instrument.probe, cell, samples, draw)
    return Simulation(problem, Measurements.of(rows), FrozenMapping(local), cell, draw.seed, arm, dial)


def simulate_several(
    problem: Problem, cell: Disturbances | None, counts: Mapping[str, int], seed: int, session: int = 0
) -> Simulation:
    """Samples of every instrument on the same true arm; what they share is the same, too.

    Those that touch faces touch those of the cell. Raises SimulationError as `simulate` does, and for what only those
    that touch can be asked.
    """
    local, frames, parts = dict[str, Array](), dict[str, Array](), list[Simulation]()
    for i, name in enumerate(problem.names):
        alone = problem.measured_by(name)
        names = {key: key for key in problem.robot.parameters} | dict(problem.full_names[i])
        known = {key: local[full] for key, full in names.items() if full in local}
        own = cell
        if isinstance(cell, Cell) and alone.instrument.probe is None:  # such as a tracker in the cell of a dial
            refuse_face_settings(alone, cell)
            own = Disturbances(**{field.name: getattr(cell, field.name) for field in fields(Disturbances)})
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
        fix = "Give a Problem; load_problem(path).problem is one"
        raise SimulationError(f"Got {came(problem)} as the problem", fix)
    if cell is not None and not isinstance(cell, Disturbances):
        raise SimulationError(f"Got {came(cell)} as the cell", "Give a Cell(faces=...), or Disturbances(...)")
    if isinstance(samples, Samples):
        found = simulate_one(problem, cell, _postures_of(problem, samples), Draw(int(seed), int(session)))
        if not len(found.samples):
            fix = "Plan them for this problem and cell"
            raise SimulationError(f"In none of the {len(samples)} postures can the true arm measure", fix)
        return found
    if isinstance(samples, Mapping):
        for name in samples:
            problem.number(name)
        if missing := [name for name in problem.names if name not in samples]:
            raise SimulationError(f"How many samples of the {missing[0]} was not said", f"Say it: {missing[0]}=120")
    counts = {name: samples[name] if isinstance(samples, Mapping) else samples for name in problem.names}
    for count in counts.values():
        _check_count(count)
    requested = {name: int(count) for name, count in counts.items()}
    if len(problem.instruments) > 1:
        return simulate_several(problem, cell, requested, int(seed), int(session))
    return simulate_one(problem, cell, requested[problem.names[0]], Draw(int(seed), int(session)))


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


def _check_count(count: object) -> None:
    """Raise SimulationError unless so many samples can be simulated."""
    if not isinstance(count, (int, np.integer)):
        fix = "Give a number, numbers by the name of the instrument, or the postures of a plan: plan.samples"
        raise SimulationError(f"Got {came(count)} as the samples", fix)
    if not 1 <= count <= MOST_SAMPLES:
        fix = f"Ask for at least one, at most {MOST_SAMPLES:,}"
        raise SimulationError(f"{count} samples were asked for", fix)

"""One session in a simulated cell: a plunger touches faces, and controller and dial say what they see of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array, Index, Rows
from casacal.errors import SimulationError
from casacal.instruments.description import Probe, readings_within
from casacal.instruments.instrument import Instrument
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.cell import OF_DIALS, Cell, Face
from casacal.simulation.faults import (
    ArmErrors,
    DialErrors,
    drawn_waves,
    form_seeds,
    levels,
    rounded,
    unwaved,
    waved,
    ways,
    weighed,
)
from casacal.simulation.reach import TouchingArm
from casacal.simulation.touches import EDGE, find_touches
from casacal.simulation.true_arm import Draw, true_unknowns
from casacal.tables.columns import Labels


@dataclass(frozen=True)
class SessionPlan:
    """Which face and which place each row touches, and when; rows (N,), places (P,)."""

    which: Index
    place: Index
    first: Index
    """The row that touches a place first."""
    turn: Index
    """The how manieth touch of its face a row is."""
    when: Array

    @staticmethod
    def of(samples: int, faces: int, repeats: int) -> SessionPlan:
        """Faces in turn, each place so many times in a row."""
        rows = np.arange(samples)
        place = rows // repeats
        turn = place // faces * repeats + rows % repeats
        return SessionPlan(place % faces, place, rows[::repeats], turn, rows / max(samples - 1, 1))

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
        rows, which = np.arange(len(names)), np.array([known[name] for name in names], dtype=np.intp)
        turn = np.array([(which[:k] == which[k]).sum() for k in rows])
        return SessionPlan(which, rows, rows, turn, rows / max(len(rows) - 1, 1))

    @property
    def again(self) -> Rows:
        """Rows (N,) that touch a place once more."""
        return np.asarray(np.diff(self.place, prepend=-1) == 0)


FIRST = "first"  # what a simulated session is called, as are other labels that are no faces


@dataclass(frozen=True)
class _Contact:
    """What one session's touches meet: faces of a form, lifted by errors of touch, under an arm that grows.

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

    def found(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Joints (P, n) and readings (P,) of the first touch of each place."""
        plan, first = self.plan, self.plan.first
        lift, growth = self.lift[first], self.growth[first]
        return find_touches(self.touch, self.probe, self.cell, plan.which[first], lift, rng, self.forms, growth)

    def there(self, standing: Array, readings: Array) -> tuple[Array, Array, Rows]:
        """What is added to given joints until the tip touches (N, n), where the plunger stands (N,), and which touch.

        standing: joints (N, n) as they truly stand. readings: expected ones (N,); where the dial would be near an end
        of its travel, the arm is moved until it reads about that, as operators do. Faces reach as far as anybody asks.
        """
        axes, centres, half = (
            np.array([getattr(face, name) for face in self.cell.faces])[self.plan.which]
            for name in ("axes", "centre", "size")
        )
        tips, _ = self.touch.place(self.touch.local, standing, readings[:, None])
        uv = np.clip(2 * np.einsum("kx,kax->ka", tips - centres, axes[:, 1:]) / half, -1, 1)
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
        """What rows add to the joints of their place's first touch (N, n), and where the plunger stands (N,).

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
        """What is added to joints (N, n) until the tip is at its height, and where the plunger then stands (N,).

        A plunger makes up for joints that stand elsewhere; a tool without one moves on until it touches.
        """
        if self.probe.column is None:
            return self.touch.land(standing, readings, normals, heights) - standing, readings
        return np.zeros_like(standing), self.touch.plunge(standing, readings, normals, heights)


def touched_rows(
    problem: Problem, instrument: Instrument, probe: Probe, cell: Cell, samples: int | Samples, draw: Draw
) -> tuple[Samples, dict[str, Array], ArmErrors, DialErrors]:
    """Samples of touches, the true local coordinates by name, and the errors of arm and dial that were drawn.

    samples: how many, or the postures in which to touch; those in which the true arm cannot are left out.
    """
    _refuse(cell, probe)
    truth_rng, pose_rng, noise_rng, form_rng, gear_rng, dial_rng, way_rng = draw.streams(7, of_the_arm=(0, 3, 4))
    local = draw.true(true_unknowns(problem, probe, cell.error_scale, truth_rng))
    touch = TouchingArm.of(problem.robot, instrument, probe, local)
    given = samples if isinstance(samples, Samples) else None
    if isinstance(samples, Samples):
        cell, plan = replace(cell, repeats=1), SessionPlan.at(samples, probe.label, cell.faces)
    else:
        plan = SessionPlan.of(samples, len(cell.faces), cell.repeats)
    count = len(plan.which)
    noise = probe.noise_std if cell.repeatability is None else cell.repeatability
    gross = noise_rng.random(count) < cell.outliers
    outlier = gross * noise_rng.choice([-1.0, 1.0], size=count) * cell.outlier_size * noise_rng.uniform(1, 2, count)
    # errors of touch and form raise the face under the tip; a dial's own errors come on top of its reading
    lift = noise_rng.normal(size=count) * (noise if probe.column is None else probe.contact_std)
    if probe.column is None:
        lift = lift + outlier
    arm = ArmErrors(thermal=cell.thermal, waves=drawn_waves(problem.robot, cell.waves, gear_rng))
    contact = _Contact(touch, probe, cell, plan, lift, form_seeds(cell, form_rng), arm.growth(plan.when))
    if given is None:
        joints, readings = contact.found(pose_rng)
    else:
        joints, readings = given.joints, given.columns.get(probe.column or "", np.zeros(count))
    if cell.compliance > 0:
        arm = replace(arm, compliance=cell.compliance, pull=weighed(touch, joints, readings))
    sag = arm.sag(touch, joints, readings)
    came, pushed = ways(joints, plan.turn, cell.repeats, cell.approach, way_rng)
    scatter, lag = noise_rng.normal(size=(count, joints.shape[1])) * cell.joint_std, came * cell.backlash / 2
    said, ways_in, met = joints, readings[plan.place], np.ones(count, dtype=bool)
    if given is None:
        said = unwaved(arm.waves, joints - sag - scatter[plan.first] + lag[plan.first])[plan.place]
    standing = waved(arm.waves, said) + sag[plan.place] + scatter - lag
    if given is not None:
        moved, ways_in, met = contact.there(standing, ways_in)
        said = said + moved
    elif plan.again.any():
        moved, ways_in = contact.again(joints, readings, standing)
        said = said + moved
    columns, dial = dict[str, Array](), DialErrors.drawn(cell, dial_rng)
    if probe.column is not None:
        shown = dial.shown(ways_in, -probe.sign * pushed, plan.when) + noise_rng.normal(size=count) * noise + outlier
        columns[probe.column] = rounded(shown, cell.resolution)
    labels = _labels(problem, probe, cell, plan) if given is None else dict(given.labels)
    recorded = rounded(said, cell.encoder_step)
    file = draw.name if given is None else given.file
    rows = Samples(recorded, columns, labels, tuple(range(1, count + 1)), {}, file, draw.name)
    return rows if met.all() else rows.take(np.flatnonzero(met)), local, arm, dial


def _labels(problem: Problem, probe: Probe, cell: Cell, plan: SessionPlan) -> dict[str, Labels]:
    """Labels of the rows by column: their faces; other labels are all alike."""
    count = len(plan.which)
    labels = {name: Labels([FIRST], np.zeros(count, dtype=np.intp)) for name in problem.layout().labels}
    if probe.label is not None:
        labels[probe.label] = Labels([face.label for face in cell.faces], plan.which)
    return labels


def _refuse(cell: Cell, probe: Probe) -> None:
    """Raise SimulationError for a cell that this plunger cannot measure in."""
    if len(cell.faces) > 1 and probe.label is None:
        raise SimulationError(
            f"The cell has {len(cell.faces)} faces and the problem one plane", 'Declare plane=Plane(per="plane")'
        )
    asked = [name for name in OF_DIALS if getattr(cell, name) > 0]
    if asked and probe.column is None:
        raise SimulationError(
            f"The cell has a {asked[0]}, and the problem touches without a dial",
            "Leave it out, or declare reading=True",
        )

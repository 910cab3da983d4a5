"""One session in a simulated cell: a plunger touches faces, and controller and dial say what they see of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.errors import SimulationError
from casacal.instruments.description import Probe
from casacal.instruments.instrument import Instrument
from casacal.problem.cell import OF_DIALS, Cell
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.faults import ArmErrors, DialErrors, drawn_waves, rounded, unwaved, waved, ways, weighed
from casacal.simulation.reach import Touch
from casacal.simulation.touches import find_touches
from casacal.simulation.true_arm import Draw, true_unknowns
from casacal.tables.columns import Labels


@dataclass(frozen=True)
class Plan:
    """Which face and which place each row touches, and when; rows (N,), places (P,)."""

    which: NDArray[np.intp]
    place: NDArray[np.intp]
    first: NDArray[np.intp]
    """The row that touches a place first."""
    turn: NDArray[np.intp]
    """The how manieth touch of its face a row is."""
    when: Array

    @staticmethod
    def of(samples: int, faces: int, repeats: int) -> Plan:
        """Faces in turn, each place so many times in a row."""
        rows = np.arange(samples)
        place = rows // repeats
        turn = place // faces * repeats + rows % repeats
        return Plan(place % faces, place, rows[::repeats], turn, rows / max(samples - 1, 1))

    @property
    def again(self) -> NDArray[np.bool_]:
        """Rows (N,) that touch a place once more."""
        return np.asarray(np.diff(self.place, prepend=-1) == 0)


FIRST = "first"  # what a simulated session is called, as are other labels that are no faces


def touched_rows(
    problem: Problem, instrument: Instrument, probe: Probe, cell: Cell, samples: int, draw: Draw
) -> tuple[Samples, dict[str, Array], ArmErrors, DialErrors]:
    """Samples of touches, the true local coordinates by name, and the errors of arm and dial that were drawn."""
    _refuse(cell, probe)
    truth_rng, pose_rng, noise_rng, form_rng, gear_rng, dial_rng, way_rng = draw.streams(7, of_the_arm=(0, 4))
    local = draw.true(true_unknowns(problem, probe, cell.error_scale, truth_rng))
    touch = Touch.of(problem.robot, instrument, probe, local)
    plan = Plan.of(samples, len(cell.faces), cell.repeats)
    noise = probe.noise_std if cell.repeatability is None else cell.repeatability
    gross = noise_rng.random(samples) < cell.outliers
    outlier = gross * noise_rng.choice([-1.0, 1.0], size=samples) * cell.outlier_size * noise_rng.uniform(1, 2, samples)
    # errors of touch and form raise the face under the tip; a dial's own errors come on top of its reading
    lift = noise_rng.normal(size=samples) * (noise if probe.column is None else probe.contact_std)
    if probe.column is None:
        lift = lift + outlier
    arm = ArmErrors(thermal=cell.thermal, waves=drawn_waves(problem.robot, cell.waves, gear_rng))
    growth = arm.growth(plan.when)
    joints, readings = find_touches(
        touch, probe, cell, plan.which[plan.first], lift[plan.first], pose_rng, form_rng, growth[plan.first]
    )
    if cell.compliance > 0:
        arm = replace(arm, compliance=cell.compliance, pull=weighed(touch, joints, readings))
    sag = arm.sag(touch, joints, readings)
    came, pushed = ways(joints, plan.turn, cell.repeats, cell.approach, way_rng)
    scatter, lag = noise_rng.normal(size=(samples, joints.shape[1])) * cell.joint_std, came * cell.backlash / 2
    said = unwaved(arm.waves, joints - sag - scatter[plan.first] + lag[plan.first])[plan.place]
    ways_in = readings[plan.place]
    if plan.again.any():
        standing = waved(arm.waves, said) + sag[plan.place] + scatter - lag
        moved, ways_in = _touched_again(touch, probe, cell, plan, joints, readings, standing, lift, growth)
        said = said + moved
    columns = {}
    dial = DialErrors.drawn(cell, dial_rng)
    if probe.column is not None:
        shown = dial.shown(ways_in, -probe.sign * pushed, plan.when) + noise_rng.normal(size=samples) * noise + outlier
        columns[probe.column] = rounded(shown, cell.resolution)
    labels = {name: Labels([FIRST], np.zeros(samples, dtype=np.intp)) for name in problem.layout().labels}
    if probe.label is not None:
        labels[probe.label] = Labels([face.label for face in cell.faces], plan.which)
    recorded = rounded(said, cell.encoder_step)
    rows = Samples(recorded, columns, labels, tuple(range(1, samples + 1)), {}, draw.name, draw.name)
    return rows, local, arm, dial


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


def _touched_again(
    touch: Touch,
    probe: Probe,
    cell: Cell,
    plan: Plan,
    joints: Array,
    readings: Array,
    standing: Array,
    lift: Array,
    growth: Array,
) -> tuple[Array, Array]:
    """What rows add to the joints of their place's first touch (N, n), and where the plunger stands (N,).

    joints, readings: of the first touch of each place. standing: joints (N, n) as they stand with the same said.
    A plunger makes up for joints that stand elsewhere; a tool without one moves on until it touches.
    """
    normals = np.array([face.axes[0] for face in cell.faces])[plan.which]
    tips, _ = touch.place(touch.local, joints, readings[:, None])
    level = (normals[plan.first] * tips).sum(axis=1) * growth[plan.first] - lift[plan.first]
    heights = (level[plan.place] + lift) / growth
    again, moved, ways_in = plan.again, np.zeros_like(standing), readings[plan.place]
    if probe.column is None:
        landed = touch.land(standing[again], ways_in[again], normals[again], heights[again])
        moved[again] = landed - standing[again]
    else:
        ways_in[again] = touch.plunge(standing[again], ways_in[again], normals[again], heights[again])
    return moved, ways_in

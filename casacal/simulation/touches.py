"""Touches of a simulated arm: faces within reach, postures solved for contact, readings within the dial's travel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from casacal.data.columns import Labels
from casacal.errors import SimulationError
from casacal.fit.kernel_rows import constraint_set, stated_prior
from casacal.fit.slots import Slot
from casacal.kernels.block_rows import Batch
from casacal.model.constraint import Constraint
from casacal.model.instrument import Instrument, Probe, readings_within
from casacal.model.problem import Problem
from casacal.model.robot import AXIS_WEIGHT, Robot, inside_limits, random_joints
from casacal.model.traced_pose import traced
from casacal.model.unknown import Unknown
from casacal.simulation.cell import OF_TOUCHES, Cell, Disturbances, levels, rectangles
from casacal.values import Array, Index, Rows

ARRIVED = 1e-16
"""Squared miss (mm^2) below which a tip counts as arrived: no target needs more, and no machine's rounding less."""

PLUNGES = 10  # rounds in which a reading is found: the tip goes nearly as the reading does

RIDGE = 1e-7
"""Fraction of the largest curvature added to all: a joint that turns the tool about its plunger then stays there."""


@dataclass(frozen=True)
class TouchingArm:
    """A plunger on an arm with given true parameters: tip, direction and their slopes by the joints."""

    robot: Robot
    place: Batch
    evaluate: Batch
    local: Array

    @staticmethod
    def of(robot: Robot, instrument: Instrument, probe: Probe, local: Mapping[str, Array]) -> TouchingArm:
        """Compile for the arm whose unknowns stand at `local` coordinates by key; the plane plays no part."""
        unknowns = {**robot.parameters, **{key: instrument.unknowns[key] for key in probe.moves}}
        z = {key: ca.SX.sym(key, unknown.size) for key, unknown in unknowns.items()}
        nominal: dict[str, Any] = {key: unknown.nominal for key, unknown in unknowns.items()}
        p = SimpleNamespace(**{key: unknown.at(ca.DM(nominal[key]), z[key]) for key, unknown in unknowns.items()})
        q, reading, kind = ca.SX.sym("q", len(robot.axes)), ca.SX.sym("r"), type(instrument).__name__
        pose = robot.flange(p, q)
        row = SimpleNamespace(**({} if probe.column is None else {probe.column: reading}))
        tip = traced(instrument.tip, "tip", kind, (3, 1), pose, p, row)
        axis = traced(instrument.plunger_direction, "plunger_direction", kind, (3, 1), pose, p, optional=True)
        if not axis.numel():
            fix = "Override plunger_direction"
            raise SimulationError(f"{kind} touches faces and says no direction of its plunger", fix)
        place, slopes = [tip, axis], [ca.jacobian(tip, q).T, ca.jacobian(axis, q).T]

        def batch(outputs: list[ca.SX]) -> Batch:
            inputs = [ca.vertcat(*z.values()), q, reading]
            return Batch(ca.Function("touch", inputs, [ca.densify(o) for o in ca.cse(outputs)]))

        touch = TouchingArm(
            robot, batch(place), batch(place + slopes), np.concatenate([local[key] for key in unknowns])
        )
        tips, *_ = touch(random_joints(robot, 20, np.random.default_rng(0)), np.zeros(20))
        if not np.isfinite(tips).all(axis=1).any():
            fix = "Let pose build on q and p with casadi.sin and the like: math and float() of them give no numbers"
            raise SimulationError(f"The tip of '{robot.name}' is not finite in any posture", fix)
        return touch

    def __call__(self, joints: Array, readings: Array) -> tuple[Array, Array, Array, Array]:
        """Tips (N, 3), directions (N, 3) and their slopes by the joints, each (N, 3, n)."""
        count, n = joints.shape
        tip, axis, tip_slope, axis_slope = self.evaluate(self.local, joints, readings[:, None])
        return tip, axis, tip_slope.reshape(count, 3, n), axis_slope.reshape(count, 3, n)

    def reach(self, targets: Array, axes: Array, readings: Array, start: Array, *, steps: int = 60) -> Array:
        """Joint values (N, n) that bring tips (N, 3) and plunger directions (N, 3) as near to the targets as they go.

        Damped Gauss-Newton, each target with its own damping; the turn about the plunger is left free. An arm with
        fewer joints ends at the best compromise, which the caller must judge.
        """
        joints, damping = start.copy(), np.full(len(start), 1e-2)
        error, slope = self._error(joints, readings, targets, axes)
        size = (error**2).sum(axis=1)
        for _ in range(steps):
            # once there, a row rests: steps that only rounding judges would turn the tool at random about its plunger
            k = np.flatnonzero(size > ARRIVED)
            if not k.size:
                break
            information = np.einsum("kai,kaj->kij", slope[k], slope[k])
            diagonal = np.einsum("kii->ki", information)
            floor = RIDGE * diagonal.max(axis=1, keepdims=True)
            lift = damping[k, None] * diagonal + floor
            lifted = information + np.einsum("ki,ij->kij", lift, np.eye(joints.shape[1]))
            step = -np.linalg.solve(lifted, np.einsum("kai,ka->ki", slope[k], error[k])[..., None])[..., 0]
            trial_error, trial_slope = self._error(joints[k] + step, readings[k], targets[k], axes[k])
            trial_size = (trial_error**2).sum(axis=1)
            better = trial_size < size[k]
            there = k[better]
            joints[there] += step[better]
            error[there], slope[there], size[there] = trial_error[better], trial_slope[better], trial_size[better]
            damping[k] = np.clip(np.where(better, damping[k] * 0.2, damping[k] * 5), 1e-12, 1e6)
        return joints

    def nearest(self, targets: Array, axes: Array, poses: Array, own: Index) -> Array:
        """For each target (N, 3) with its plunger direction, the nearest of its own (N, M) among poses (K, n): (N, n).

        From afar, steps are so erratic that rounding decides where they lead; from nearby they are not.
        """
        tips, directions = self.place(self.local, poses, np.zeros((1,)))
        miss = ((tips[own] - targets[:, None]) ** 2).sum(axis=2)
        miss += AXIS_WEIGHT**2 * ((directions[own] - axes[:, None]) ** 2).sum(axis=2)
        return np.asarray(poses[own[np.arange(len(own)), np.argmin(miss, axis=1)]])

    def land(self, joints: Array, readings: Array, normals: Array, heights: Array) -> Array:
        """Smallest joint moves that put tips exactly on n . tip = height: (N, n)."""
        for _ in range(6):
            tip, _, slope, _ = self(joints, readings)
            row = np.einsum("ka,kai->ki", normals, slope)
            miss = (normals * tip).sum(axis=1) - heights
            joints = joints - row * (miss / np.maximum((row**2).sum(axis=1), 1e-12))[:, None]
        return joints

    def plunge(self, joints: Array, readings: Array, normals: Array, heights: Array) -> Array:
        """Readings (N,) that put tips on n . tip = height where joints (N, n) stay."""
        for _ in range(PLUNGES):
            here, _ = self.place(self.local, joints, readings[:, None])
            beyond, _ = self.place(self.local, joints, readings[:, None] + 1)
            rise = (normals * (beyond - here)).sum(axis=1)
            readings = readings - ((normals * here).sum(axis=1) - heights) / rise
        return readings

    def within_limits(self, joints: Array) -> tuple[Array, Rows]:
        """Joint values with whole turns taken out, and which rows are inside all limits."""
        lower, upper = self.robot.limits
        middle = (lower + upper) / 2
        turned = middle + (joints - middle + np.pi) % (2 * np.pi) - np.pi
        wrapped = np.where(self.robot.revolute, turned, joints)
        return wrapped, inside_limits(self.robot, wrapped)

    def _error(self, joints: Array, readings: Array, targets: Array, axes: Array) -> tuple[Array, Array]:
        tip, axis, tip_slope, axis_slope = self(joints, readings)
        error = np.concatenate([tip - targets, AXIS_WEIGHT * (axis - axes)], axis=1)
        return error, np.concatenate([tip_slope, AXIS_WEIGHT * axis_slope], axis=1)


LABELS = ("1", "2", "3")  # labels of simulated rows where neither the instrument nor a cell names any


def own_noise(problem: Problem) -> Array | float:
    """Standard deviation of each component of the residual by itself."""
    instrument = problem.instrument
    if said := next((block.name for block in instrument.blocks if isinstance(block.std, str)), ""):
        fix = "Declare it as a number"
        raise SimulationError(f"The noise of '{said}' comes from a column, which simulated rows do not have", fix)
    stds = [float(block.std) for block in instrument.blocks for _ in range(block.size)]
    return np.array(stds) if stds else instrument.residual_std


def refuse_face_settings(problem: Problem, cell: Disturbances) -> None:
    """Raise SimulationError where a cell has settings that mean something only for touches of faces."""
    plain = Cell(faces=cell.faces) if isinstance(cell, Cell) else cell
    own = [name for name in OF_TOUCHES if getattr(cell, name, None) != getattr(plain, name, None)]
    if own:
        raise SimulationError(
            f"The cell has {own[0]}, and {type(problem.instrument).__name__} touches no faces that the simulator knows",
            "Leave it out, or ask it of an instrument that touches faces",
        )


def row_labels(problem: Problem, cell: Disturbances, samples: int) -> dict[str, Labels]:
    """Labels of the rows, in turn: those that the instrument knows, the cell's faces, or 1, 2, 3."""
    turn, found = np.arange(samples), {}
    for column in problem.layout().labels:
        names = label_names(problem, cell, column)
        found[column] = Labels(names, turn % len(names))
        turn //= len(names)  # each label of one column meets each of the next
    return found


def label_names(problem: Problem, cell: Disturbances, column: str) -> tuple[str, ...]:
    """Labels that a column of simulated rows has; what bears the first of them stands in the first place, and so on."""
    instrument = problem.instrument
    known = instrument.known_columns.values() if instrument.known_by == column else ()
    names = tuple(dict.fromkeys(label for values in known for label in values))
    if isinstance(cell, Cell):
        names = names or tuple(face.label for face in cell.faces)
    return names or LABELS


def true_unknowns(problem: Problem, probe: Probe, error_scale: float, rng: np.random.Generator) -> dict[str, Array]:
    """Local coordinates of what moves the tip, drawn from the prior (flat: `start_std`) times `error_scale`."""
    own = problem.instrument.unknowns
    unknowns = {**problem.robot.parameters, **{key: own[key] for key in probe.moves}}
    return drawn_together(problem, unknowns, error_scale, rng)


def drawn_together(
    problem: Problem, unknowns: Mapping[str, Unknown], scale: float, rng: np.random.Generator
) -> dict[str, Array]:
    """True local coordinates by key, drawn from priors `scale` times as wide, as what is known of them together has it.

    Correlated, about a certified quantity, and where ties and bounds are met: of these the nearest in units of priors.
    unknowns: without labels.
    """
    drawn = {key: scale * unknown.start_stds * rng.normal(size=unknown.size) for key, unknown in unknowns.items()}
    names = {each for key, unknown in unknowns.items() for each in (key, *unknown.component_names(key))}
    known = [each for each in problem.constraints if names.issuperset(each.names)]
    if not known or not scale:
        return drawn
    slots, first = list[Slot](), 0
    for key, unknown in unknowns.items():
        slots.append(Slot(key, unknown, None, np.asarray(unknown.nominal), first, datum=False))
        first += unknown.size
    x, stds = np.concatenate([*drawn.values()]), np.concatenate([unknown.start_stds for unknown in unknowns.values()])
    if (prior := stated_prior(known, slots)) is not None:
        every = [name for slot in slots for name in slot.unknown.names(slot.name)]
        index = [every.index(name) for name in prior.names]
        x[index] = prior.mean + np.linalg.cholesky(prior.covariance) @ x[index] / stds[index]
    exact = constraint_set([each for each in known if isinstance(each, Constraint) and not each.std], slots, stds)
    if exact is not None and (met := exact.restored(x)) is not None:
        x = met
    return {slot.key: x[slot.columns] for slot in slots}


@dataclass(frozen=True)
class Draw:
    """Random draw: an arm by its seed, and one of the sessions in which it is measured.

    known: true local coordinates that stand already, by key, such as those of the same arm in another session.
    nominals: the same of nominal values, where others than those of a simulation are meant.
    """

    seed: int
    session: int = 0
    known: Mapping[str, Array] = field(default_factory=dict)
    nominals: Mapping[str, Array] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name in place of a file's for such samples."""
        return f"simulated-{self.seed}" + (f"-{self.session + 1}" if self.session else "")

    def streams(self, count: int, of_the_arm: Sequence[int]) -> tuple[np.random.Generator, ...]:
        """Independent random numbers for each thing that is drawn; further ones leave the first as they are.

        Those of the arm are the same in every session.
        """
        arm = np.random.SeedSequence(self.seed).spawn(count)
        here = np.random.SeedSequence((self.seed, self.session)).spawn(count) if self.session else arm
        return tuple(np.random.default_rng(arm[k] if k in of_the_arm else here[k]) for k in range(count))

    def true(self, drawn: Mapping[str, Array]) -> dict[str, Array]:
        """Local coordinates as they were drawn, but for those that stand."""
        return {key: np.asarray(self.known.get(key, values)) for key, values in drawn.items()}


def frame_coordinates(frame: Unknown, nominal: Array, matrix: Array) -> Array:
    """Local coordinates (6,) of a true transform (4, 4; mm) about a nominal frame."""
    from scipy.spatial.transform import Rotation

    turn = nominal[:9].reshape(3, 3) @ matrix[:3, :3]  # the nominal rotation, column by column, is transposed so
    quaternion = np.roll(Rotation.from_matrix(turn).as_quat(canonical=True), 1)
    raw = np.concatenate([quaternion, matrix[:3, 3] - nominal[9:12]])
    return np.asarray(frame.raw_local(ca.DM(nominal), ca.DM(raw))).ravel()


def plane_coordinates(plane: Unknown, nominal: Array, centre: Array, normal: Array) -> Array:
    """Local coordinates (3,) of a face about a nominal plane; none (0,) where the plane is held.

    centre: a point (3, mm) of the face; normal: its unit normal (3,), of either sign.
    """
    if not plane.size:
        return np.zeros(0)
    normal = normal if normal @ nominal[:3] > 0 else -normal
    raw = np.concatenate([normal, [normal @ (centre - nominal[9:12])]])
    return np.asarray(plane.raw_local(ca.DM(nominal), ca.DM(raw))).ravel()


EDGE = 0.05  # readings stay this part of the travel away from its ends

STARTS = 200
"""Random poses among which each target finds its start: its own, so that targets near one another differ in posture."""

ROUNDS, MOST_ROUNDS = 60, 600
"""Fresh targets tried for a touch before the face counts as out of reach; and where most of the touches were found."""


def try_touches(
    touch: TouchingArm,
    probe: Probe,
    cell: Cell,
    which: Index,
    lift: Array,
    seeds: Sequence[int | None],
    rng: np.random.Generator,
    waiting: Index | None = None,
    growth: Array | None = None,
    *,
    starts: int = STARTS,
    poses: Array | None = None,
) -> tuple[Array, Array, Rows]:
    """One try at each touch, or at those that wait: joint values, readings, and which of them succeeded.

    What is drawn does not depend on which touches wait, so that one touch that rounding decides leaves the others as
    they are. starts: random poses among which each finds where to begin, drawn from poses (K, n) where there are some.
    """
    count = len(which)
    waiting = np.arange(count) if waiting is None else waiting
    axes, centres, half = (each[which] for each in rectangles(cell.faces))
    low, high = readings_within(probe.travel if cell.travel is None else cell.travel)
    readings = low + rng.uniform(EDGE, 1 - EDGE, count) * (high - low) if probe.column is not None else np.zeros(count)
    uv = rng.uniform(-1, 1, size=(count, 2))
    targets = centres + np.einsum("ka,kax->kx", uv * half, axes[:, 1:])
    # directions into the faces, uniform over the cone of half-angle `tilt`
    cosine = rng.uniform(math.cos(cell.tilt), 1.0, count)
    sine, azimuth = np.sqrt(1 - cosine**2), rng.uniform(0, 2 * math.pi, count)
    parts = np.column_stack([-cosine, sine * np.cos(azimuth), sine * np.sin(azimuth)])
    directions = np.einsum("ka,kax->kx", parts, axes)
    if poses is None:
        drawn = random_joints(touch.robot, count * starts, rng).reshape(count, starts, -1)[waiting]
        poses, own = drawn.reshape(-1, drawn.shape[2]), np.arange(len(waiting) * starts).reshape(-1, starts)
    else:
        own = rng.integers(len(poses), size=(count, starts))[waiting]
    which, grown = which[waiting], (np.ones(count) if growth is None else growth)[waiting]
    lift, readings, uv, axes, centres, half, targets, directions = (
        each[waiting] for each in (lift, readings, uv, axes, centres, half, targets, directions)
    )
    joints = touch.reach(targets, directions, readings, touch.nearest(targets, directions, poses, own))
    joints, inside = touch.within_limits(joints)
    heights = levels(cell, which, uv, seeds, lift) / grown  # where the arm without its growth stands as it touches
    joints = touch.land(joints, readings, axes[:, 0], heights)
    tip, direction, *_ = touch(joints, readings)
    offset = np.abs(np.einsum("kx,kax->ka", tip - centres, axes[:, 1:]))
    landed = np.abs((axes[:, 0] * tip).sum(axis=1) - heights) < 1e-7
    upright = -(axes[:, 0] * direction).sum(axis=1) >= math.cos(cell.tilt) - 1e-6
    turned, still = touch.within_limits(joints)
    good = inside & landed & upright & (offset <= half + 1e-6).all(axis=1) & still
    return np.where(np.abs(turned - joints) > 1.0, turned, joints), readings, good

"""Joint values that bring a robot to whole poses, inside its joint limits: from near, or from many starts.

`casacal.simulation.touches` leaves the turn about a plunger free; here position and orientation both count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from casacal.deployment.arm import NO_COLUMNS
from casacal.kernels.block_rows import BLOCK, Batch
from casacal.model.problem import Problem
from casacal.model.robot import AXIS_WEIGHT, Robot, joint_units, random_joints
from casacal.model.trace import row_function
from casacal.values import Array, Rows

FEW_JOINTS_WEIGHT = 1.0  # mm that weigh as much as a radian for fewer than six joints: the position goes first

TOLERANCE = 5e-3, 5e-6  # position (mm) and orientation (rad) within which joint values take a pose
ARRIVED = 1e-18  # squared miss (mm^2) below which a row is done
STILL = 1e-11  # step (rad, or mm over `AXIS_WEIGHT`) below which a row is done
GIVEN_UP = 1e9  # damping at which no step helps any more


@dataclass(frozen=True)
class PosedArm:
    """A robot whose unknowns stand at `local` coordinates: pose of its flange or tip, and slopes by the joints."""

    robot: Robot
    evaluate: Batch
    local: Array
    frame: Literal["flange", "tip"]
    columns: Array
    """Columns (N, k) of the rows that drive effects; an arm without any takes any number of rows."""

    @staticmethod
    def of(
        problem: Problem,
        local: Array,
        frame: Literal["flange", "tip"] = "flange",
        constants: Array | None = None,
        columns: Mapping[str, Array] = NO_COLUMNS,
    ) -> PosedArm:
        """Compile at `local` (nz,), row constants c (nc,), zero by default, and columns (N,) by name; reading zero."""
        model, n = problem.model, len(problem.robot.axes)
        c = ca.DM.zeros(model.pose.size_in(1)) if constants is None else ca.DM(constants)
        z, q = ca.SX.sym("z", model.pose.numel_in(0)), ca.SX.sym("q", n)
        symbols = {name: ca.SX.sym(name) for name in columns}
        row = ca.vertcat(q, *(symbols.get(name, 0) for name in model.names))
        pose = ca.reshape(model.pose(z, c, row), 4, 4)
        place, turn = (model.tip(z, c, row) if frame == "tip" else pose[:3, 3]), pose[:3, :3]
        by_joint = ca.jacobian(ca.vec(turn), q)
        rates = [ca.mtimes(ca.reshape(by_joint[:, j], 3, 3), turn.T) for j in range(n)]  # dR/dq R' = [omega]x
        omega = ca.horzcat(*(ca.vertcat(rate[2, 1], rate[0, 2], rate[1, 0]) for rate in rates))
        outputs = [place, ca.vec(turn.T), ca.vec(ca.vertcat(ca.jacobian(place, q), omega).T)]
        made = Batch(row_function("pose", [z, ca.vertcat(q, *symbols.values())], outputs))
        return PosedArm(problem.robot, made, local, frame, np.array([*columns.values()]).T)

    def of_rows(self, rows: NDArray[Any]) -> PosedArm:
        """The arm with the columns of some rows (M,)."""
        return replace(self, columns=self.columns[rows]) if self.columns.size else self

    def __call__(self, joints: Array) -> tuple[Array, Array, Array]:
        """Positions (N, 3; mm), rotations (N, 3, 3), slopes (N, 6, n): velocity, then angular velocity, by joint."""
        count, n = joints.shape
        # widths in whole blocks or powers of two: a mapped function of every width would be built otherwise
        width = -(-count // BLOCK) * BLOCK if count > BLOCK else 1 << max(count - 1, 0).bit_length()
        row = np.hstack([joints, self.columns]) if self.columns.size else joints
        padded = np.concatenate([row, np.zeros((width - count, row.shape[1]))])
        place, turn, slope = (output[:count] for output in self.evaluate(self.local, padded))
        return place, turn.reshape(-1, 3, 3), slope.reshape(-1, 6, n)

    def miss(self, joints: Array, positions: Array, rotations: Array) -> tuple[Array, Array, Array]:
        """Position errors (N, 3; mm), rotation errors (N, 3; rad, base frame), and their slopes (N, 6, n) by joint."""
        place, turn, slope = self(joints)
        error = turning(turn @ rotations.transpose(0, 2, 1))
        slope = np.concatenate([slope[:, :3], inverse_left_jacobian(error) @ slope[:, 3:]], axis=1)
        return place - positions, error, slope

    def within(self, place: Array, turn: Array) -> Rows:
        """Rows whose miss (N,; mm and rad) counts as none; an arm with few joints owes the position alone."""
        return np.asarray((place <= TOLERANCE[0]) & ((turn <= TOLERANCE[1]) | (len(self.robot.axes) < 6)))

    def takes(self, joints: Array, positions: Array, rotations: Array) -> Rows:
        """Rows (N,) in which joint values bring it to a pose."""
        place, turn, _ = self.miss(joints, positions, rotations)
        return self.within(np.linalg.norm(place, axis=1), np.linalg.norm(turn, axis=1))

    def reach(self, positions: Array, rotations: Array, start: Array, *, steps: int = 60) -> Array:
        """Joint values (N, n), inside the limits, as near to poses (N, 3; mm) and (N, 3, 3) as damped steps lead.

        Damped Gauss-Newton (Levenberg 1944), each row with its own damping, from a start (N, n; rad, mm) inside the
        limits; a joint that is pulled beyond its limit rests. Rows that are not finite stay where they are.
        """
        lower, upper = self.robot.limits
        joints = np.clip(start, lower, upper)
        error, slope = self._weighted(joints, positions, rotations)
        size, damping = (error**2).sum(axis=1), np.full(len(joints), 1e-4)
        rows = np.flatnonzero(size > ARRIVED)  # also drops what is not finite
        for _ in range(steps):
            if not rows.size:
                break
            step = self._step(joints[rows], error[rows], slope[rows], damping[rows])
            trial = np.clip(joints[rows] + step, lower, upper)
            trial_error, trial_slope = self.of_rows(rows)._weighted(trial, positions[rows], rotations[rows])
            trial_size = (trial_error**2).sum(axis=1)
            better = trial_size < size[rows]
            won = rows[better]
            joints[won], error[won], slope[won] = trial[better], trial_error[better], trial_slope[better]
            size[won] = trial_size[better]
            damping[rows] = np.where(better, np.maximum(damping[rows] * 0.1, 1e-12), damping[rows] * 10)
            moving = np.abs(step / joint_units(self.robot)).max(axis=1) > STILL
            rows = rows[(size[rows] > ARRIVED) & moving & (damping[rows] < GIVEN_UP)]
        return joints

    def at_limit(self, joints: Array, positions: Array, rotations: Array) -> Rows:
        """Rows (N,) in which a joint stands at a limit and the pose pulls it beyond."""
        error, slope = self._weighted(joints, positions, rotations)
        return np.asarray(self._resting(joints, np.einsum("kai,ka->ki", slope, error)).any(axis=1))

    def _step(self, joints: Array, error: Array, slope: Array, damping: Array) -> Array:
        """Levenberg's step (N, n) in joints that are free to move."""
        units = joint_units(self.robot)
        gradient = np.einsum("kai,ka->ki", slope, error)
        free = ~self._resting(joints, gradient)
        slope = slope * (free * units)[:, None, :]
        information = slope.transpose(0, 2, 1) @ slope
        lift = damping * np.maximum(np.einsum("kii->ki", information).max(axis=1), 1e-300)
        lifted = information + lift[:, None, None] * np.eye(joints.shape[1])
        scaled = np.linalg.solve(lifted, (gradient * free * units)[..., None])[..., 0]
        return np.asarray(-scaled * units)

    def _resting(self, joints: Array, gradient: Array) -> Rows:
        lower, upper = self.robot.limits
        return np.asarray(((joints <= lower) & (gradient > 0)) | ((joints >= upper) & (gradient < 0)))

    def _weighted(self, joints: Array, positions: Array, rotations: Array) -> tuple[Array, Array]:
        place, turn, slope = self.miss(joints, positions, rotations)
        weight = np.array([1.0] * 3 + [AXIS_WEIGHT if len(self.robot.axes) >= 6 else FEW_JOINTS_WEIGHT] * 3)
        return np.concatenate([place, turn], axis=1) * weight, slope * weight[:, None]


BANK = 4096  # random postures among which starts are looked for
ROUNDS = (6, 24)  # starts per pose in the first round, and in the second for poses that none of them reached
PATIENCE = 16  # steps of a start: those that are not there by then creep along a singularity, and others are faster
SWEEPS = 8  # times that torn paths are repaired
TORN = 0.5  # joint motion (rad) between rows at which a path is torn
ON_A_PATH = 0.5  # distance of two poses (in units of a radian or `AXIS_WEIGHT` mm) up to which they are on one path
BEYOND = 1.05  # fraction of the farthest random posture's distance from the base beyond which no pose is looked for


def postures(arm: PosedArm, positions: Array, rotations: Array) -> Array:
    """Joint values (N, n) at which an arm takes poses (N, 3; mm) and (N, 3, 3), from many starts; NaN where none does.

    Of several postures the one nearest to that of the row before is taken, for the first row the one nearest to
    mid-range. Where neighbours on a path would still differ, the row before is a start too.
    """
    from scipy.spatial import KDTree

    bank = random_joints(arm.robot, BANK, np.random.default_rng(0))
    tree, targets = KDTree(_where(*arm(bank)[:2])), _where(positions, rotations)
    reach = BEYOND * np.linalg.norm(tree.data[:, :3], axis=1).max()
    found: list[Array] = [np.zeros((0, bank.shape[1]))] * len(positions)

    def try_from(rows: NDArray[np.intp], starts: Array) -> None:
        """Add the postures that some rows (m,) reach from their starts (m, k, n)."""
        index = np.repeat(rows, starts.shape[1])
        joints = arm.reach(positions[index], rotations[index], starts.reshape(-1, starts.shape[2]), steps=PATIENCE)
        taken = arm.takes(joints, positions[index], rotations[index]).reshape(starts.shape[:2])
        for row, some, good in zip(rows, joints.reshape(starts.shape), taken, strict=True):
            found[row] = np.concatenate([found[row], some[good]])

    first, rows = 0, np.flatnonzero(np.linalg.norm(targets[:, :3], axis=1) <= reach)
    for starts in ROUNDS:
        if rows.size:
            try_from(rows, bank[tree.query(targets[rows], k=first + starts)[1][:, first:]])
        first, rows = first + starts, np.array([row for row in rows if not len(found[row])], dtype=np.intp)
    chosen = _one_branch(arm, found)
    for _ in range(SWEEPS):
        if not (rows := torn(arm.robot, chosen, positions, rotations)).size:
            break
        try_from(rows, chosen[rows - 1][:, None])
        chosen = _one_branch(arm, found)
    return chosen


def torn(robot: Robot, joints: Array, positions: Array, rotations: Array) -> NDArray[np.intp]:
    """Rows whose joint values are far from those of the row before although their pose is near to that one's."""
    near = np.linalg.norm(np.diff(_where(positions, rotations), axis=0), axis=1) < ON_A_PATH
    far = np.abs(np.diff(joints / joint_units(robot), axis=0)).max(axis=1, initial=0.0) > TORN
    return np.flatnonzero(near & far) + 1


def _where(positions: Array, rotations: Array) -> Array:
    """Poses as points (N, 12), in which a radian weighs about as much as `AXIS_WEIGHT` mm."""
    return np.concatenate([positions / AXIS_WEIGHT, rotations.reshape(-1, 9)], axis=1)


def _one_branch(arm: PosedArm, found: list[Array]) -> Array:
    """For each row the posture nearest to the row before; whole turns are taken where the limits allow."""
    lower, upper = arm.robot.limits
    last = (lower + upper) / 2
    turns = np.where(arm.robot.revolute, 2 * np.pi, np.inf)
    chosen = np.full((len(found), len(last)), np.nan)
    for i, choices in enumerate(found):
        if len(choices):
            lowest, highest = np.ceil((lower - choices) / turns), np.floor((upper - choices) / turns)
            whole = np.clip(np.round((last - choices) / turns), lowest, highest)
            choices = choices + np.where(arm.robot.revolute, whole * 2 * np.pi, 0.0)
            last = choices[np.argmin((((choices - last) / joint_units(arm.robot)) ** 2).sum(axis=1))]
            chosen[i] = last
    return chosen


def turning(rotations: Array) -> Array:
    """Rotation vectors (N, 3; rad) of rotation matrices (N, 3, 3); NaN where a matrix is not finite."""
    sound = np.isfinite(rotations).all(axis=(1, 2))
    vectors = np.full((len(rotations), 3), np.nan)
    if sound.any():
        vectors[sound] = Rotation.from_matrix(rotations[sound]).as_rotvec()
    return vectors


def inverse_left_jacobian(vectors: Array) -> Array:
    """Derivative (N, 3, 3) of a rotation vector by a turn in the base frame: inverse of SO(3)'s left Jacobian."""
    # Barfoot, State Estimation for Robotics, section 7.1
    angle = np.linalg.norm(vectors, axis=1)
    half = np.maximum(angle / 2, 1e-4)
    bend = np.where(angle < 1e-3, 1 / 12, (1 - half / np.tan(half)) / np.maximum(angle, 1e-4) ** 2)
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) - cross / 2 + bend[:, None, None] * (cross @ cross))

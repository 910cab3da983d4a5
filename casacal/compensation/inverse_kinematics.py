"""Joint values that bring a robot to whole poses, inside its joint limits, for many poses at once.

`casacal.simulation.reach` brings a plunger to a face and leaves the turn about it free; here position and orientation
both count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from casacal.array_types import Array, Rows
from casacal.kernels.batch import BLOCK, Batch
from casacal.problem.problem import Problem
from casacal.robots.joint_space import AXIS_WEIGHT
from casacal.robots.robot import Robot

FEW_JOINTS_WEIGHT = 1.0
"""Millimetres that weigh as much as one radian where an arm has fewer than six joints: position first, and the
orientation as near as the position allows (what it costs the position is below a tenth of a micrometre)."""

ARRIVED = 1e-18  # squared miss (mm^2) below which a row is done
STILL = 1e-11  # step (rad, or mm over `AXIS_WEIGHT`) below which a row is done
GIVEN_UP = 1e9  # damping at which no step helps any more


@dataclass(frozen=True)
class PosedArm:
    """A robot whose unknowns stand at `local` coordinates: where its flange or tip is, and the slopes by the joints."""

    robot: Robot
    evaluate: Batch
    local: Array
    frame: Literal["flange", "tip"]

    @staticmethod
    def of(
        problem: Problem, local: Array, frame: Literal["flange", "tip"] = "flange", constants: Array | None = None
    ) -> PosedArm:
        """Compile for the instrument's unknowns at `local` (nz,); the tip stands at reading zero.

        constants: c (nc,) of its row model; zero by default.
        """
        model, n = problem.model, len(problem.robot.axes)
        c = ca.DM.zeros(model.pose.size_in(1)) if constants is None else ca.DM(constants)
        z, q = ca.SX.sym("z", model.pose.numel_in(0)), ca.SX.sym("q", n)
        row = ca.vertcat(q, ca.DM.zeros(model.pose.numel_in(2) - n))
        pose = ca.reshape(model.pose(z, c, row), 4, 4)
        place, turn = (model.tip(z, c, row) if frame == "tip" else pose[:3, 3]), pose[:3, :3]
        by_joint = ca.jacobian(ca.vec(turn), q)
        rates = [ca.mtimes(ca.reshape(by_joint[:, j], 3, 3), turn.T) for j in range(n)]  # dR/dq R' = [omega]x
        omega = ca.horzcat(*(ca.vertcat(rate[2, 1], rate[0, 2], rate[1, 0]) for rate in rates))
        outputs = [place, ca.vec(turn.T), ca.vec(ca.vertcat(ca.jacobian(place, q), omega).T)]
        return PosedArm(problem.robot, Batch(ca.Function("pose", [z, q], _dense(outputs))), local, frame)

    def __call__(self, joints: Array) -> tuple[Array, Array, Array]:
        """Positions (N, 3; mm), rotations (N, 3, 3), slopes (N, 6, n): velocity, then angular velocity, by joint."""
        count, n = joints.shape
        # widths in whole blocks or powers of two: a mapped function of every width would be built otherwise
        width = -(-count // BLOCK) * BLOCK if count > BLOCK else 1 << max(count - 1, 0).bit_length()
        padded = np.concatenate([joints, np.zeros((width - count, n))])
        place, turn, slope = (output[:count] for output in self.evaluate(self.local, padded))
        return place, turn.reshape(-1, 3, 3), slope.reshape(-1, 6, n)

    @property
    def joint_units(self) -> Array:
        """What counts as one unit of motion of each joint (n,): a radian, or as many mm as weigh as much."""
        return joint_units(self.robot)

    @property
    def orientation_weight(self) -> float:
        """Millimetres that weigh as much as one radian."""
        return AXIS_WEIGHT if len(self.robot.axes) >= 6 else FEW_JOINTS_WEIGHT

    def miss(self, joints: Array, positions: Array, rotations: Array) -> tuple[Array, Array, Array]:
        """Position errors (N, 3; mm), rotation errors (N, 3; rad, base frame), and their slopes (N, 6, n) by joint."""
        place, turn, slope = self(joints)
        error = turning(turn @ rotations.transpose(0, 2, 1))
        slope = np.concatenate([slope[:, :3], _inverse_left_jacobian(error) @ slope[:, 3:]], axis=1)
        return place - positions, error, slope

    def reach(self, positions: Array, rotations: Array, start: Array, *, steps: int = 60) -> Array:
        """Joint values (N, n), inside the limits, that bring each row as near to its pose as damped steps lead.

        Damped Gauss-Newton (Levenberg 1944), each row with its own damping; joints that stand at a limit and are
        pulled beyond it rest. Where joints are to spare, each step is the smallest joint motion that does it. Rows
        whose model gives values that are not finite stay where they are.

        Args:
            positions, rotations: the poses (N, 3; mm) and (N, 3, 3).
            start: joint values (N, n; rad, mm), brought inside the limits first.
            steps: at most.

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
            trial_error, trial_slope = self._weighted(trial, positions[rows], rotations[rows])
            trial_size = (trial_error**2).sum(axis=1)
            better = trial_size < size[rows]
            won = rows[better]
            joints[won], error[won], slope[won] = trial[better], trial_error[better], trial_slope[better]
            size[won] = trial_size[better]
            damping[rows] = np.where(better, np.maximum(damping[rows] * 0.1, 1e-12), damping[rows] * 10)
            moving = np.abs(step / self.joint_units).max(axis=1) > STILL
            rows = rows[(size[rows] > ARRIVED) & moving & (damping[rows] < GIVEN_UP)]
        return joints

    def at_limit(self, joints: Array, positions: Array, rotations: Array) -> Rows:
        """Rows (N,) in which a joint stands at a limit and the pose pulls it beyond."""
        error, slope = self._weighted(joints, positions, rotations)
        return np.asarray(self._resting(joints, np.einsum("kai,ka->ki", slope, error)).any(axis=1))

    def _step(self, joints: Array, error: Array, slope: Array, damping: Array) -> Array:
        """Levenberg's step (N, n) in joints that are free to move."""
        gradient = np.einsum("kai,ka->ki", slope, error)
        free = ~self._resting(joints, gradient)
        slope = slope * (free * self.joint_units)[:, None, :]
        information = slope.transpose(0, 2, 1) @ slope
        lift = damping * np.maximum(np.einsum("kii->ki", information).max(axis=1), 1e-300)
        lifted = information + lift[:, None, None] * np.eye(joints.shape[1])
        scaled = np.linalg.solve(lifted, (gradient * free * self.joint_units)[..., None])[..., 0]
        return np.asarray(-scaled * self.joint_units)

    def _resting(self, joints: Array, gradient: Array) -> Rows:
        lower, upper = self.robot.limits
        return np.asarray(((joints <= lower) & (gradient > 0)) | ((joints >= upper) & (gradient < 0)))

    def _weighted(self, joints: Array, positions: Array, rotations: Array) -> tuple[Array, Array]:
        place, turn, slope = self.miss(joints, positions, rotations)
        weight = np.array([1.0] * 3 + [self.orientation_weight] * 3)
        return np.concatenate([place, turn], axis=1) * weight, slope * weight[:, None]


def joint_units(robot: Robot) -> Array:
    """What counts as one unit of motion of each joint (n,): a radian, or as many mm as weigh as much."""
    return np.where(robot.revolute, 1.0, AXIS_WEIGHT)


def turning(rotations: Array) -> Array:
    """Rotation vectors (N, 3; rad) of rotation matrices (N, 3, 3); NaN where a matrix is not finite."""
    from scipy.spatial.transform import Rotation

    sound = np.isfinite(rotations).all(axis=(1, 2))
    vectors = np.full((len(rotations), 3), np.nan)
    if sound.any():
        vectors[sound] = Rotation.from_matrix(rotations[sound]).as_rotvec()
    return vectors


def _inverse_left_jacobian(vectors: Array) -> Array:
    """Derivative (N, 3, 3) of a rotation vector by a turn in the base frame: inverse of SO(3)'s left Jacobian.

    Barfoot, State Estimation for Robotics, section 7.1.
    """
    angle = np.linalg.norm(vectors, axis=1)
    half = np.maximum(angle / 2, 1e-4)
    bend = np.where(angle < 1e-3, 1 / 12, (1 - half / np.tan(half)) / np.maximum(angle, 1e-4) ** 2)
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) - cross / 2 + bend[:, None, None] * (cross @ cross))


def _dense(outputs: list[Any]) -> list[Any]:
    return [ca.densify(output) for output in ca.cse(outputs)]

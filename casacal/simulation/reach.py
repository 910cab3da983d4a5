"""Joint values that bring a plunger's tip to points of a face, for many targets at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array, Rows
from casacal.errors import SimulationError
from casacal.instruments import Instrument
from casacal.instruments.description import Probe
from casacal.kernels.block_rows import Batch
from casacal.robots.robot import AXIS_WEIGHT, Robot, inside_limits, random_joints
from casacal.robots.traced_pose import traced

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

    def nearest(self, targets: Array, axes: Array, poses: Array) -> Array:
        """For each target (N, 3) with its plunger direction, the nearest of its own poses (N, M, n): (N, n).

        From afar, steps are so erratic that rounding decides where they lead; from nearby they are not.
        """
        count, choices, n = poses.shape
        tips, directions = self.place(self.local, poses.reshape(-1, n), np.zeros((1,)))
        miss = ((tips.reshape(count, choices, 3) - targets[:, None]) ** 2).sum(axis=2)
        miss += AXIS_WEIGHT**2 * ((directions.reshape(count, choices, 3) - axes[:, None]) ** 2).sum(axis=2)
        return np.asarray(poses[np.arange(count), np.argmin(miss, axis=1)])

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

"""The tip's expected error and its correction over the workspace, and two views of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.calibration.calibration import Calibration
from casacal.uncertainty.workspace import tip_stds, up_to_base, workspace_joints

POSTURES = 8192
"""Random postures within the joint limits that the map is made of; a multiple of the kernels' block."""


@dataclass(frozen=True)
class Workspace:
    """Tips (N, 3) of random postures, and at each the expected error and the correction (N,), all mm.

    Both apart from where the base stands. The error is the standard deviation, its three axes together; the
    correction is how far the calibrated tip lies from the nominal one.
    """

    tips: Array
    error: Array
    correction: Array

    @staticmethod
    def of(calibration: Calibration) -> Workspace:
        """Over postures of its own; the base frame is that of the postures that the summary's figure is of."""
        motion = calibration.motion
        arm, x = motion.arm, motion.x
        frame_joints, frame_tips, frame_slopes = calibration.workspace
        joints = workspace_joints(arm.problem.robot, poses=POSTURES, seed=1)
        tips, slopes = arm.tips(x, joints), arm.tip_jacobian(x, joints)
        field = up_to_base(slopes, tips, frame_slopes, frame_tips)
        error = np.linalg.norm(tip_stds(motion.covariance, field, motion.off), axis=1)
        moved = (tips - arm.tips(arm.x0, joints)).reshape(-1, 1)
        frame_moved = (frame_tips - arm.tips(arm.x0, frame_joints)).reshape(-1, 1)
        correction = np.linalg.norm(up_to_base(moved, tips, frame_moved, frame_tips).reshape(-1, 3), axis=1)
        return Workspace(tips, error, correction)


def side_view(points: Array) -> Array:
    """Distance from the base's z axis, and height (N, 2; mm)."""
    return np.column_stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]])


def top_view(points: Array) -> Array:
    """x and y of the base frame (N, 2; mm)."""
    return np.asarray(points[:, :2])

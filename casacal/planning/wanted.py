"""Where the tip is wanted: over the workspace, in a box, or at targets."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.errors import CasacalError
from casacal.uncertainty.expectation import Box, joints_in_box
from casacal.uncertainty.workspace import workspace_joints


def wanted_joints(bound: BoundProblem, box: Box | None, targets: Array | None) -> Array:
    """Joint values (M, n) at which the tip is wanted."""
    if box is not None:
        return joints_in_box(bound, bound.x0, box)
    if targets is None:
        return workspace_joints(bound.problem.robot)
    joints = np.atleast_2d(np.asarray(targets, dtype=np.float64))
    if joints.shape[1] != len(bound.problem.robot.axes) or not np.isfinite(joints).all():
        raise CasacalError(
            f"Targets came with the shape {np.shape(targets)}",
            f"Give finite joint values (M, {len(bound.problem.robot.axes)}) in rad and mm",
        )
    return joints

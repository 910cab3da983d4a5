"""Along which of the arm's own unknowns a joint's zero lies: what an update sets free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.uncertainty.workspace import workspace_joints

SAME = 1e-6
"""Part of the motion of tip and flange by a joint that the arm's unknowns may fail to follow."""

POSES = 60
"""Postures at which these motions are compared."""


def joint_direction(shifted: BoundProblem, x: Array, column: int, arm: NDArray[np.bool_]) -> Array | None:
    """Direction (n,) in the arm's unknowns that does what one unit of a joint's shift does; None where there is none.

    One number of the arm where one does it, as an offset of a DH table; else the least of several, in their priors.

    Args:
        shifted: rows bound with shifts.
        x: where everything stands (n,).
        column: the joint's shift in x.
        arm: which unknowns (n,) are the arm's.

    """
    joints = workspace_joints(shifted.problem.robot, poses=POSES)
    block, columns = shifted.blocks[0], shifted.blocks[0].columns[0]
    parts = []
    for what in ("tip_jacobian", "flange_jacobian"):
        slopes = block.posture(what, x, joints)[1].reshape(3 * len(joints), -1)
        whole = np.zeros((len(slopes), shifted.unknowns))
        whole[:, columns] = slopes
        parts.append(whole)
    field = np.vstack(parts)
    wanted, own = field[:, column], np.flatnonzero(arm)
    size = float(np.linalg.norm(wanted))
    if not size:
        return None
    squares = (field[:, own] ** 2).sum(axis=0)
    times = np.divide(field[:, own].T @ wanted, squares, out=np.zeros(own.size), where=squares > 0)
    misses = np.linalg.norm(wanted[:, None] - field[:, own] * times, axis=0)
    found, best = np.zeros(shifted.unknowns), int(misses.argmin())
    if misses[best] <= SAME * size:
        found[own[best]] = times[best]
        return found
    scale = shifted.start_std[own]
    moves = np.linalg.lstsq(field[:, own] * scale, wanted, rcond=1e-10)[0] * scale
    if np.linalg.norm(wanted - field[:, own] @ moves) > SAME * size:
        return None
    found[own] = moves
    return found

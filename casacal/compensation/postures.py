"""Postures at which an arm takes poses when no branch is stated: from many starts, one branch along a path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array, Rows
from casacal.compensation.inverse_kinematics import PosedArm, joint_units
from casacal.robots.joint_space import AXIS_WEIGHT, random_joints
from casacal.robots.robot import Robot

BANK = 4096  # random postures among which starts are looked for
ROUNDS = (6, 24)  # starts per pose in the first round, and in the second for poses that none of them reached
PATIENCE = 16  # steps of a start: those that are not there by then creep along a singularity, and others are faster
SWEEPS, TORN, ON_A_PATH = 8, 0.5, 0.5
"""Times that torn paths are repaired; joint motion (rad) between rows at which one is torn; and how near two poses must
be (in units of a radian or `AXIS_WEIGHT` mm) to count as one path."""
BEYOND = 1.05  # fraction of the farthest random posture's distance from the base beyond which no pose is looked for


def postures(arm: PosedArm, positions: Array, rotations: Array, tolerance: tuple[float, float]) -> Array:
    """Joint values (N, n) at which an arm takes poses, found from many starts; NaN where none was found.

    Of the postures that were found for a pose the one nearest to that of the row before is taken, for the first row
    the one nearest to mid-range. Where neighbours on a path would still differ, the row before is a start too.

    Args:
        arm: usually the nominal one.
        positions, rotations: the poses (N, 3; mm) and (N, 3, 3).
        tolerance: mm and rad within which a pose counts as taken; the radians only where there are six joints.

    """
    from scipy.spatial import KDTree

    bank = random_joints(arm.robot, BANK, np.random.default_rng(0))
    tree, asked = KDTree(_where(*arm(bank)[:2])), _where(positions, rotations)
    reach = BEYOND * np.linalg.norm(tree.data[:, :3], axis=1).max()
    found: list[Array] = [np.zeros((0, bank.shape[1]))] * len(positions)

    def try_from(rows: NDArray[np.intp], starts: Array) -> None:
        """Add the postures that some rows (m,) reach from their starts (m, k, n)."""
        index = np.repeat(rows, starts.shape[1])
        joints = arm.reach(positions[index], rotations[index], starts.reshape(-1, starts.shape[2]), steps=PATIENCE)
        taken = _taken(arm, joints, positions[index], rotations[index], tolerance).reshape(starts.shape[:2])
        for row, some, good in zip(rows, joints.reshape(starts.shape), taken, strict=True):
            found[row] = np.concatenate([found[row], some[good]])

    first, rows = 0, np.flatnonzero(np.linalg.norm(asked[:, :3], axis=1) <= reach)
    for starts in ROUNDS:
        if rows.size:
            try_from(rows, bank[tree.query(asked[rows], k=first + starts)[1][:, first:]])
        first, rows = first + starts, np.array([row for row in rows if not len(found[row])], dtype=np.intp)
    chosen = _one_branch(arm, found)
    for _ in range(SWEEPS):
        rows = torn(arm.robot, chosen, positions, rotations)
        if not rows.size:
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


def _taken(arm: PosedArm, joints: Array, positions: Array, rotations: Array, tolerance: tuple[float, float]) -> Rows:
    """Rows in which a pose is taken: with few joints, its position."""
    place, turn, _ = arm.miss(joints, positions, rotations)
    near = np.linalg.norm(place, axis=1) <= tolerance[0]
    return np.asarray(near & ((np.linalg.norm(turn, axis=1) <= tolerance[1]) | (len(arm.robot.axes) < 6)))


def _one_branch(arm: PosedArm, found: list[Array]) -> Array:
    """Of each row's postures the one nearest to the row before; whole turns are taken where the limits allow."""
    lower, upper = arm.robot.limits
    last = (lower + upper) / 2
    turns = np.where(arm.robot.revolute, 2 * np.pi, np.inf)
    chosen = np.full((len(found), len(last)), np.nan)
    for i, choices in enumerate(found):
        if len(choices):
            lowest, highest = np.ceil((lower - choices) / turns), np.floor((upper - choices) / turns)
            whole = np.clip(np.round((last - choices) / turns), lowest, highest)
            choices = choices + np.where(np.isfinite(turns), whole * np.where(np.isfinite(turns), turns, 0.0), 0.0)
            last = choices[np.argmin((((choices - last) / arm.joint_units) ** 2).sum(axis=1))]
            chosen[i] = last
    return chosen

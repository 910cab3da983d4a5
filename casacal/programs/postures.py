"""Which joint values a controller takes for a pose: those of the configuration that the target states.

The controller's own solution is closed form and knows its arm's bodies. Here damped steps from many starts find the
postures of any arm with six turning joints, and the language says which configuration each has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from casacal.deployment.inverse_kinematics import PATIENCE, PosedArm
from casacal.model.robot import AXIS_WEIGHT, random_joints
from casacal.programs.program import ProgramMove, Target
from casacal.programs.read import Dialect
from casacal.values import Array

BANK = 1 << 13  # random postures among which starts are looked for
STARTS = (4, 16, 48)  # starts per pose and branch in each round: the next is for poses that found nothing
SAME = 1e-3  # rad by which joint values of one posture differ, as they were found from one start and another
BORDER = np.radians(0.05)  # how far beyond the border of its configuration a joint may stand: controllers round


def bits(arm: PosedArm, joints: Array, upright: Sequence[float]) -> Array:
    """Whether the wrist is behind axis 1, and on the other side of the lower arm (N, 2), than in an upright posture."""
    reference, found = _sides(arm, np.radians([upright])), _sides(arm, joints)
    return np.asarray((found * reference < 0).astype(int))


def _sides(arm: PosedArm, joints: Array) -> Array:
    """Signed distances (N, 2) of the wrist: from axis 1, and from the plane through the axes 2 and 3."""
    place, _, slope = arm(joints)
    omega = slope[:, 3:].transpose(0, 2, 1)  # by joint
    points = place[:, None] + np.cross(
        omega, slope[:, :3].transpose(0, 2, 1)
    )  # of each axis, the one nearest the flange
    across = np.eye(3) - omega[..., :, None] * omega[..., None, :]
    normal = across[:, 3:].sum(axis=1) + 1e-12 * np.eye(3)
    wrist = np.linalg.solve(normal, np.einsum("njab,njb->na", across[:, 3:], points[:, 3:])[..., None])[..., 0]
    front = np.einsum("na,na->n", wrist - points[:, 0], np.cross(omega[:, 0], omega[:, 1]))
    lower, upper = points[:, 2] - points[:, 1], wrist - points[:, 2]
    return np.column_stack([front, np.einsum("na,na->n", np.cross(lower, upper), omega[:, 1])])


def stated(arm: PosedArm, dialect: Dialect, joints: Array) -> Array:
    """Configurations (N, k) of joint values (N, 6)."""
    return dialect.configuration(joints, bits(arm, joints, dialect.upright))


def agreement(
    dialect: Dialect, joints: Array, sides: Array, config: Sequence[int | None], border: float = BORDER
) -> NDArray[np.bool_]:
    """Which entries (N, k) of a configuration joint values (N, 6) with bits (N, 2) have; None is open.

    border: how far (rad) a joint may stand beyond the border of an entry.
    """
    near = np.array([dialect.configuration(joints + step, sides) for step in (0.0, border, -border)])
    fits = np.ones((len(joints), len(config)), dtype=bool)
    for k, entry in enumerate(config):
        if entry is not None:
            fits[:, k] = (near[:, :, k] == entry).any(axis=0)
    return fits


def controller_joints(
    arm: PosedArm,
    dialect: Dialect,
    targets: Sequence[Target],
    moves: Sequence[ProgramMove],
    flanges: Array,
    begin: Array | None = None,
) -> tuple[Array, frozenset[int]]:
    """Joint values (N, 6) of targets whose flange stands at (N, 4, 4), and which of them moves take in two postures.

    NaN where none has its configuration. Joint targets are themselves. Of postures that a configuration leaves open,
    that nearest to the joint values which a target names (`near`) is taken, else to those of the move before, at first
    to where the program begins (6,).
    """
    found = np.full((len(targets), 6), np.nan)
    posed = [i for i, target in enumerate(targets) if target.kind == "pose"]

    def fitting(row: int, joints: Array, sides: Array) -> Array:
        config = targets[posed[row]].config
        if all(entry is None for entry in config):
            return joints
        whole, of = _whole_turns(arm, joints)
        return whole[agreement(dialect, whole, sides[of], config).all(axis=1)]

    choices = dict(zip(posed, _postures(arm, dialect, flanges[posed], fitting), strict=True))
    last, twice = begin, set[int]()
    for i in (move.target for move in moves):  # in which targets come in their order
        if (target := targets[i]).kind == "joints":
            taken = np.asarray(target.joints)
        else:
            beside = last if target.near is None else np.array(target.near)
            taken = _nearest(arm, target, choices[i], beside, flanges[i])
        if np.isnan(found[i]).all():
            found[i] = taken
        elif not np.allclose(found[i], taken, atol=SAME, equal_nan=True):
            twice.add(i)
        last = taken if np.isfinite(taken).all() else last
    rows = np.array([i for i in posed if np.isfinite(found[i]).all()], dtype=np.intp)
    if rows.size:  # they take their poses to a tolerance so far
        found[rows] = arm.reach(flanges[rows, :3, 3], flanges[rows, :3, :3], found[rows])
    return found, frozenset(twice)


def _nearest(arm: PosedArm, target: Target, joints: Array, beside: Array | None, flange: Array) -> Array:
    """Of the postures (M, 6) of a target the one nearest to some other (6,); NaN where there is none, or no other."""
    if all(entry is None for entry in target.config):
        if beside is None:
            return np.full(6, np.nan)
        at = flange[None, :3, 3], flange[None, :3, :3]  # what is near is not left to chance
        there = arm.reach(*at, beside[None])
        joints = np.vstack([joints, there[arm.takes(there, *at)]])
        whole = joints + 2 * np.pi * np.round((beside - joints) / (2 * np.pi))
        lower, upper = arm.robot.limits
        joints = np.where((whole >= lower) & (whole <= upper), whole, joints)
    if not len(joints):
        return np.full(6, np.nan)
    beside = np.zeros(6) if beside is None else beside
    return np.asarray(joints[np.argmin(np.square(joints - beside).sum(axis=1))])


def _whole_turns(arm: PosedArm, joints: Array) -> tuple[Array, NDArray[np.intp]]:
    """Joint values (M, 6) with whole turns added wherever the limits allow, and the row that each came from."""
    lower, upper = arm.robot.limits
    of = np.arange(len(joints))
    for axis in range(6):
        moved = [joints.copy() for _ in range(5)]
        for way, each in zip((0, -2, -1, 1, 2), moved, strict=True):
            each[:, axis] += 2 * np.pi * way
        inside = [(each[:, axis] >= lower[axis]) & (each[:, axis] <= upper[axis]) for each in moved]
        joints = np.vstack([each[some] for each, some in zip(moved, inside, strict=True)])
        of = np.concatenate([of[some] for some in inside])
    return joints, of


def _postures(
    arm: PosedArm, dialect: Dialect, flanges: Array, fitting: Callable[[int, Array, Array], Array]
) -> list[Array]:
    """Postures (M, 6) that fit for each of some poses (N, 4, 4), from starts in every branch.

    fitting: row, joint values (M, 6) and their bits (M, 2) -> those that fit.
    """
    from scipy.spatial import KDTree

    found = [np.zeros((0, 6))] * len(flanges)
    if not found:
        return found
    positions, rotations = flanges[:, :3, 3], flanges[:, :3, :3]
    bank = random_joints(arm.robot, BANK, np.random.default_rng(0))
    sides = bits(arm, bank, dialect.upright)
    branch = sides[:, 0] * 4 + sides[:, 1] * 2 + (np.sin(bank[:, 4]) > 0)
    where, wanted = _points(*arm(bank)[:2]), _points(positions, rotations)
    owned = [rows for k in range(8) if len(rows := np.flatnonzero(branch == k)) >= sum(STARTS)]
    trees = [KDTree(where[rows]) for rows in owned]
    first, rows = 0, np.arange(len(flanges))
    for starts in STARTS:
        near = [
            own[tree.query(wanted[rows], k=np.arange(first + 1, first + starts + 1))[1]]
            for tree, own in zip(trees, owned, strict=True)
        ]
        index = np.repeat(rows, starts * len(trees))
        joints = arm.reach(positions[index], rotations[index], bank[np.hstack(near).ravel()], steps=PATIENCE)
        taken = arm.takes(joints, positions[index], rotations[index])
        joints, index = joints[taken], index[taken]
        joint_bits = bits(arm, joints, dialect.upright)
        for row in rows:
            mine = np.flatnonzero(index == row)
            mine = mine[np.unique(np.round(joints[mine], 4), axis=0, return_index=True)[1]] if len(mine) else mine
            found[row] = fitting(int(row), joints[mine], joint_bits[mine])
        first, rows = first + starts, np.array([row for row in rows if not len(found[row])], dtype=np.intp)
        if not len(rows):
            break
    return found


def _points(positions: Array, rotations: Array) -> Array:
    """Poses as points (N, 12), in which a radian weighs about as much as `AXIS_WEIGHT` mm."""
    return np.concatenate([positions / AXIS_WEIGHT, rotations.reshape(-1, 9)], axis=1)

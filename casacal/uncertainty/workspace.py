"""The tip over the workspace: fixed poses, its displacements apart from rigid motion, and their spread."""

from __future__ import annotations

import math

import numpy as np

from casacal.array_types import Array
from casacal.robots.joint_space import random_joints
from casacal.robots.robot import Robot

WORKSPACE_POSES = 400


FEW_UNKNOWNS = 100

BLIND_FIELD = 1e-9
"""Motion (mm per unit) below which a tip does not see an unknown."""


def workspace_joints(robot: Robot, *, poses: int = WORKSPACE_POSES, seed: int = 0) -> Array:
    """Fixed joint values (poses, n; rad, mm) that move every joint through its limits; no sample lies there."""
    return random_joints(robot, poses, np.random.default_rng([20220802, seed]))


def rigid_fields(tips: Array, about: Array) -> Array:
    """Six rigid displacement fields (3 N, 6) of tips (N, 3): three shifts, three turns about a point (3,)."""
    arms = tips - about
    turns = [np.cross(axis, arms).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(tips)) for axis in np.eye(3)]
    return np.column_stack([*shifts, *turns])


def without_rigid(field: Array, tips: Array) -> Array:
    """A displacement of tips, or several as columns (3 N, m), with its best rigid motion taken out.

    Planes alone cannot see where the base frame stands, so six rigid fields of the tips (N, 3) are projected out.
    """
    basis, _ = np.linalg.qr(rigid_fields(tips, tips.mean(axis=0)))
    return np.asarray(field - basis @ (basis.T @ field))


def up_to_base(field: Array, tips: Array, frame_field: Array, frame_tips: Array) -> Array:
    """Displacements (3 N, m) of some tips with the rigid motion taken out that fits another set's displacements best.

    The other set (3 M, m) of tips (M, 3), usually the workspace, says what counts as a move of the base frame.
    """
    about = frame_tips.mean(axis=0)
    motion = np.linalg.lstsq(rigid_fields(frame_tips, about), frame_field, rcond=None)[0]
    return np.asarray(field - rigid_fields(tips, about) @ motion)


def tip_stds(covariance: Array, field: Array, off: Array | None = None) -> Array:
    """Standard deviation (N, 3; mm) of each tip along each axis.

    Args:
        covariance: of the unknowns (n, n); infinite variances count where the field sees them.
        field: derivative (3 N, n) of the tips by the unknowns, apart from where the base stands if that is wanted.
        off: by how much the arm that is asked for leaves unknowns (n,) where they are not; it counts as an error.

    """
    lost = ~np.isfinite(np.diagonal(covariance))
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    if len(held) <= FEW_UNKNOWNS:  # where the threads of matrix products would only wait for one another
        variance = np.einsum("ij,jk,ik->i", field, held, field)
    else:
        variance = ((field @ held) * field).sum(axis=1)
    if off is not None:
        variance += (field @ off) ** 2
    variance[(np.abs(field[:, lost]) > BLIND_FIELD).any(axis=1)] = np.inf
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(-1, 3))


def tip_rms(field: Array) -> float:
    """Root mean square length (mm) of a displacement (3 N,) of N tips."""
    return math.sqrt(float((field.reshape(-1, 3) ** 2).sum(axis=1).mean()))

"""Rotation vectors and lengths of many rows."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array


def lengths(vectors: Array) -> Array:
    """Lengths (N,) of vectors (N, 3)."""
    return np.asarray(np.linalg.norm(vectors, axis=1))


def turning(rotations: Array) -> Array:
    """Rotation vectors (N, 3; rad) of rotation matrices (N, 3, 3); NaN where a matrix is not finite."""
    from scipy.spatial.transform import Rotation

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

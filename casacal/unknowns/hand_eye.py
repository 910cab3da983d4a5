"""Two unknown transforms from many poses: where a body sits on the flange, and where the device that sees it stands.

M = S T B with T the flange in the base, M the body as it is read, S the station, B the body. Rotations first, by
singular values of a Kronecker sum; then translations, which are linear (Shah, Solving the Robot-World/Hand-Eye
Calibration Problem Using the Kronecker Product, Journal of Mechanisms and Robotics 5, 2013).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from casacal.array_types import Array

APART = 1e-3
"""Part of the largest singular value by which it stands apart where both frames are fixed: turns by two degrees."""


def hand_eye(turns: Array, places: Array, quaternions: Array, read: Array) -> tuple[Array, Array] | None:
    """Body and station (4, 4; mm) that fit best, or None where the rows do not fix them.

    Args:
        turns, places: rotations (N, 3, 3) and origins (N, 3; mm) of the flange in the base frame.
        quaternions, read: of the body in the device's frame: w, x, y, z (N, 4), and origins (N, 3; mm).

    """
    apart = np.linalg.svd(np.einsum("kia,kjb->ijab", turns, turns).reshape(9, 9), compute_uv=False)
    if len(turns) < 3 or apart[0] - apart[1] < APART * apart[0]:  # of turns about one axis the largest two are alike
        return None
    seen = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    # S' M = T B for every row: vec(T B) = (1 x T) vec(B), vec(S' M) = (M' x 1) vec(S')
    cross = np.einsum("kia,kjb->ijab", seen, turns).reshape(9, 9)
    left, _, right = np.linalg.svd(cross)
    station, body = _rotation(left[:, 0].reshape(3, 3), right[0].reshape(3, 3))
    # p = S_R (T_R b + t) + s, linear in b and s
    rows = np.concatenate([np.einsum("ij,kjl->kil", station, turns), np.tile(np.eye(3), (len(turns), 1, 1))], axis=2)
    wanted = read - places @ station.T
    shifts, *_ = np.linalg.lstsq(rows.reshape(-1, 6), wanted.ravel(), rcond=None)
    return _frame(body, shifts[:3]), _frame(station, shifts[3:])


def _rotation(station: Array, body: Array) -> tuple[Array, Array]:
    """The two rotations nearest to matrices of unknown size and common sign."""
    sign = np.sign(np.linalg.det(station)) or 1.0
    return _nearest(sign * station), _nearest(sign * body).T


def _nearest(matrix: Array) -> Array:
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def _frame(turn: Array, shift: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, shift
    return matrix

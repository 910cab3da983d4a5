"""What points say of a plane, directions of a rotation, and poses of two unknown transforms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.kinematics import turns_of
from casacal.unknowns.unknown import Unknown

ON_A_LINE = 1e-9  # fraction of the largest extent below which points count as lying on a line


@dataclass(frozen=True)
class FittedPlane:
    """The plane of total least squares through points.

    centre: (3,), mm. normal: unit (3,), of either sign. across: unit vectors (2, 3) on the plane, along the largest
    extent of the points first. flat: whether the points fix a plane at all, rather than lie on a line.
    """

    centre: Array
    normal: Array
    across: Array
    flat: bool


def fitted_plane(points: Array) -> FittedPlane:
    """Plane with the smallest sum of squared distances from points (N, 3): eq (6) with a unit normal."""
    centre = points.mean(axis=0)
    # all three directions, also of fewer points than that
    _, extents, axes = np.linalg.svd(points - centre, full_matrices=len(points) < 3)
    flat = bool(len(points) >= 3 and extents[1] > ON_A_LINE * max(float(extents[0]), 1.0))
    return FittedPlane(centre, axes[2], axes[:2], flat)


def rigid_fit(there: Array, here: Array) -> Array | None:
    """Transform (4, 4) that carries points `there` (N, 3; mm) to `here` as well as one can, if they fix one."""
    turn, fixed = rotation_between(there - there.mean(axis=0), here - here.mean(axis=0))
    if len(here) < 3 or not fixed:
        return None
    return transform(turn, here.mean(axis=0) - turn @ there.mean(axis=0))


def rotation_between(there: Array, here: Array) -> tuple[Array, bool]:
    """Rotation (3, 3) that carries vectors `there` (N, 3) to `here` as well as one can, and whether they fix it.

    Arun, Huang and Blostein, Least-squares fitting of two 3-D point sets, 1987.
    """
    left, sizes, right = np.linalg.svd(there.T @ here)
    mirror = np.diag([1.0, 1.0, np.linalg.det(right.T @ left.T)])
    fixed = bool(len(there) >= 2 and sizes[1] > ON_A_LINE * max(float(sizes[0]), 1.0))
    return np.asarray(right.T @ mirror @ left.T), fixed


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
    seen = turns_of(quaternions)
    # S' M = T B for every row: vec(T B) = (1 x T) vec(B), vec(S' M) = (M' x 1) vec(S')
    cross = np.einsum("kia,kjb->ijab", seen, turns).reshape(9, 9)
    left, _, right = np.linalg.svd(cross)
    station, body = left[:, 0].reshape(3, 3), right[0].reshape(3, 3)  # of unknown size and common sign
    sign = np.sign(np.linalg.det(station)) or 1.0
    station, body = _nearest(sign * station), _nearest(sign * body).T
    # p = S_R (T_R b + t) + s, linear in b and s
    rows = np.concatenate([np.einsum("ij,kjl->kil", station, turns), np.tile(np.eye(3), (len(turns), 1, 1))], axis=2)
    wanted = read - places @ station.T
    shifts, *_ = np.linalg.lstsq(rows.reshape(-1, 6), wanted.ravel(), rcond=None)
    return transform(body, shifts[:3]), transform(station, shifts[3:])


def _nearest(matrix: Array) -> Array:
    """The rotation nearest to a matrix."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def transform(turn: Array, shift: Array) -> Array:
    """The transform (4, 4; mm) of a rotation (3, 3) and a translation (3; mm)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, shift
    return matrix


def packed_symbols(unknowns: Mapping[str, Unknown]) -> tuple[list[ca.SX], dict[str, Any]]:
    """A matrix of symbols for the value of each unknown, and these values, by key."""
    symbols, values = [], {}
    for key, unknown in unknowns.items():
        nominal = ca.SX.zeros(unknown.nominal_size) if unknown.nominal is None else ca.SX(ca.DM(unknown.nominal))
        rows, columns = ca.SX(unknown.packed(unknown.at(nominal, ca.SX.zeros(unknown.size)))).shape
        symbols.append(ca.SX.sym(key, rows, columns))
        values[key] = unknown.unpacked(symbols[-1])
    return symbols, values

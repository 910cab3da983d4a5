"""What points say of a plane, and directions of a rotation: total least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array

ON_A_LINE = 1e-9
"""Fraction of the largest extent below which points count as lying on a line."""


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
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = here.mean(axis=0) - turn @ there.mean(axis=0)
    return matrix


def rotation_between(there: Array, here: Array) -> tuple[Array, bool]:
    """Rotation (3, 3) that carries vectors `there` (N, 3) to `here` as well as one can, and whether they fix it.

    Arun, Huang and Blostein, Least-squares fitting of two 3-D point sets, 1987.
    """
    left, sizes, right = np.linalg.svd(there.T @ here)
    mirror = np.diag([1.0, 1.0, np.linalg.det(right.T @ left.T)])
    fixed = bool(len(there) >= 2 and sizes[1] > ON_A_LINE * max(float(sizes[0]), 1.0))
    return np.asarray(right.T @ mirror @ left.T), fixed

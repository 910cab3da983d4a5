"""Rigid transforms as CasADi expressions: Denavit-Hartenberg, Hayati, screws, rotations, translations, chains.

Functions take CasADi symbols or floats, in mm and rad, and return a 4x4 `SX`, `MX` or (from floats alone) `DM`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property, reduce
from typing import Any, overload

import casadi as ca
import numpy as np

from casacal.values import Array

Expression = Any  # a CasADi symbol or matrix (`SX`, `MX`, `DM`) or a float: the same code serves all of them


@overload
def deg(angle: float, /) -> float: ...
@overload
def deg(angle: float, /, *angles: float) -> tuple[float, ...]: ...
def deg(angle: float, /, *angles: float) -> float | tuple[float, ...]:
    """Degrees to radians: one angle to a float, several to a tuple."""
    return tuple(map(math.radians, (angle, *angles))) if angles else math.radians(angle)


class Product:
    """A product of square matrices that keeps its factors, so that a vector is carried through them one by one.

    Carrying a point through n links costs n products of matrix and vector in place of n of matrix and matrix, and as
    much less again in derivatives. Wherever CasADi wants a matrix, it is the matrix it multiplies out to.
    """

    def __init__(self, factors: Iterable[Expression]) -> None:
        self.factors = tuple(factors)

    @cached_property
    def matrix(self) -> Expression:
        """The product itself."""
        return reduce(ca.mtimes, self.factors)

    def carry(self, vector: Expression) -> Expression:
        """The product times a column."""
        return reduce(lambda carried, factor: ca.mtimes(factor, carried), reversed(self.factors), vector)

    def __matmul__(self, other: Expression) -> Expression:
        if isinstance(other, Product):
            return Product((*self.factors, *other.factors))
        if hasattr(other, "shape") and len(other.shape) == 2 and other.shape[1] == 1:
            return self.carry(other)
        return ca.mtimes(self.matrix, other)

    def __rmatmul__(self, other: Expression) -> Expression:
        return ca.mtimes(other, self.matrix)

    def __getitem__(self, index: Any) -> Expression:
        return self.matrix[index]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.matrix, name)

    def __SX__(self) -> ca.SX:  # what CasADi calls to convert
        return ca.SX(self.matrix)

    def __MX__(self) -> ca.MX:
        return ca.MX(self.matrix)

    def __DM__(self) -> ca.DM | None:
        # CasADi asks for numbers first, and would take symbols for NaN; an exception it may meet much later
        return self.matrix if isinstance(self.matrix, ca.DM) else None

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        if not isinstance(self.matrix, ca.DM):
            raise TypeError("a product of symbols has no numbers")
        return np.array(self.matrix, dtype=dtype)


def stacked_poses(columns: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Transforms (N, 4, 4) from rows (N, 16) that hold them column by column, as CasADi does."""
    return np.asarray(columns).reshape(-1, 4, 4).transpose(0, 2, 1)


def identity() -> Expression:
    """Return the transform that moves nothing, 4x4."""
    return ca.DM.eye(4)


def translate(x: Expression, y: Expression, z: Expression) -> Expression:
    """Translation by (x, y, z) mm, 4x4."""
    return ca.blockcat([[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


def translate_x(x: Expression) -> Expression:
    """Translation by x mm along the x axis, 4x4."""
    return translate(x, 0, 0)


def translate_y(y: Expression) -> Expression:
    """Translation by y mm along the y axis, 4x4."""
    return translate(0, y, 0)


def translate_z(z: Expression) -> Expression:
    """Translation by z mm along the z axis, 4x4."""
    return translate(0, 0, z)


def rotate_x(angle: Expression) -> Expression:
    """Rotation by `angle` rad about the x axis, 4x4."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.blockcat([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])


def rotate_y(angle: Expression) -> Expression:
    """Rotation by `angle` rad about the y axis, 4x4."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.blockcat([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])


def rotate_z(angle: Expression) -> Expression:
    """Rotation by `angle` rad about the z axis, 4x4."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.blockcat([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


ROTATE = {"x": rotate_x, "y": rotate_y, "z": rotate_z}


def dh(alpha: Expression, a: Expression, d: Expression, theta: Expression) -> Expression:
    """Standard DH link, 4x4: RotZ(theta) TransZ(d) TransX(a) RotX(alpha), eq (1) of arXiv:2208.02652.

    `alpha` and `theta` in rad, `a` and `d` in mm; the joint angle is added to `theta` by the caller.
    """
    return chain(rotate_z(theta), translate(a, 0, d), rotate_x(alpha))


def modified_dh(alpha: Expression, a: Expression, d: Expression, theta: Expression) -> Expression:
    """Modified (Craig's) DH link, 4x4: RotX(alpha) TransX(a) RotZ(theta) TransZ(d).

    `alpha` and `a` belong to the axis before the joint. Craig, Introduction to Robotics, eq (3.6).
    """
    return chain(rotate_x(alpha), translate(a, 0, 0), rotate_z(theta), translate(0, 0, d))


def hayati(alpha: Expression, beta: Expression, a: Expression, theta: Expression) -> Expression:
    """Hayati's link between parallel axes, 4x4: RotZ(theta) TransX(a) RotX(alpha) RotY(beta).

    Where two axes are nearly parallel, their common normal, and with it d, jumps by metres when one of them tilts by a
    hair. Here the second axis is met where it pierces the plane across the first, and a turn `beta` about y takes the
    place of d. Hayati, Robot arm geometric link parameter estimation, 22nd IEEE CDC (1983) 1477-1483.
    """
    return chain(rotate_z(theta), translate(a, 0, 0), rotate_x(alpha), rotate_y(beta))


def rotate(axis: Expression, angle: Expression) -> Expression:
    """Rotation by `angle` rad about a unit axis (3,), 4x4: Rodrigues' formula, eq (3.51) of Lynch & Park (2017)."""
    cross: Expression = ca.skew(_column(axis))  # [w] v = w x v
    squared: Expression = ca.mtimes(cross, cross)
    turn = ca.DM.eye(3) + ca.sin(angle) * cross + (1 - ca.cos(angle)) * squared
    return rigid(turn, ca.DM.zeros(3))


def slide(axis: Expression, length: Expression) -> Expression:
    """Translation by `length` mm along a unit axis (3,), 4x4.

    Exponential of the screw of a prismatic joint, eq (3.89) of Lynch & Park, Modern Robotics (2017), with omega = 0.
    """
    return translate(axis[0] * length, axis[1] * length, axis[2] * length)


def screw(axis: Expression, point: Expression, angle: Expression) -> Expression:
    """Rotation by `angle` rad about a unit axis (3,) through a point (3, mm), 4x4.

    Exponential of the screw (omega, v) of a revolute joint, v = -omega x point, eq (3.88) of Lynch & Park, Modern
    Robotics (2017). With G(angle) as printed there, G v = (I - R) point, as omega v = 0.
    """
    turn = rotate(axis, angle)[:3, :3]
    return rigid(turn, _column(point) - ca.mtimes(turn, _column(point)))


def chain(*transforms: Expression) -> Expression:
    """Product T_1 T_2 ... T_n of 4x4 transforms, eq (2) of arXiv:2208.02652."""
    factors = (each.factors if isinstance(each, Product) else (each,) for each in transforms)
    return Product((factor for some in factors for factor in some) if transforms else (identity(),))


def position(pose: Expression) -> Expression:
    """Origin of a pose, 3 mm."""
    return transform_point(pose, ca.DM.zeros(3)) if isinstance(pose, Product) else pose[:3, 3]


def rotation(pose: Expression) -> Expression:
    """Rotation matrix of a pose, 3x3."""
    return Product(factor[:3, :3] for factor in pose.factors) if isinstance(pose, Product) else pose[:3, :3]


def transform_point(pose: Expression, point: Expression) -> Expression:
    """Carry a point (3, mm) given in the pose's own frame to the base frame."""
    factors = pose.factors if isinstance(pose, Product) else (pose,)
    return reduce(lambda carried, link: ca.mtimes(link[:3, :3], carried) + link[:3, 3], reversed(factors), point)


def rotation_of_quaternion(q: Expression) -> Expression:
    """Rotation matrix (3x3) of a unit quaternion (w, x, y, z); a polynomial, so exact only on the unit sphere."""
    return ca.blockcat(_turn(q[0], q[1], q[2], q[3]))


def _turn(w: Any, x: Any, y: Any, z: Any) -> list[list[Any]]:
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _column(vector: Expression) -> Expression:
    """Three numbers or expressions as a column."""
    return ca.vertcat(vector[0], vector[1], vector[2])


def rigid(turn: Expression, shift: Expression) -> Expression:
    """Transform of a rotation matrix (3x3) and a translation (3, mm), 4x4."""
    return ca.vertcat(ca.horzcat(turn, shift), ca.DM([[0, 0, 0, 1]]))


def turns_of(quaternions: Array) -> Array:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4; w, x, y, z) of any length but zero."""
    units = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.moveaxis(np.array(_turn(*units.T)), -1, 0)


def quaternions_of(turns: Array) -> Array:
    """Unit quaternions (N, 4; w, x, y, z) of rotation matrices (N, 3, 3); the first number but zero is positive.

    Q = 4 q q' is linear in the matrix; its column with the largest diagonal is q, whichever number of it is small
    (Shepperd, Journal of Guidance and Control 1, 1978).
    """
    m = np.moveaxis(turns, 0, -1)
    xx, yy, zz = m[0, 0], m[1, 1], m[2, 2]
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    squares = np.array(
        [
            [1 + xx + yy + zz, wx, wy, wz],
            [wx, 1 + xx - yy - zz, xy, xz],
            [wy, xy, 1 - xx + yy - zz, yz],
            [wz, xz, yz, 1 - xx - yy + zz],
        ]
    )
    best = np.argmax(np.einsum("iik->ik", squares), axis=0)
    found = squares[:, best, np.arange(len(best))].T
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    first = np.take_along_axis(found, np.argmax(found != 0, axis=1)[:, None], axis=1)
    return np.asarray(found * np.where(first < 0, -1.0, 1.0))

"""Rigid transforms as CasADi expressions: Denavit-Hartenberg, rotations, translations, chains.

Every function takes CasADi symbols or plain floats and returns a 4x4 `SX`, `MX` or (from floats alone) `DM`.
Lengths in millimetres, angles in radians.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any, overload

import casadi as ca

Expression = Any
"""A CasADi symbol or matrix (`SX`, `MX`, `DM`) or a float: the same code serves all of them."""


@overload
def deg(angle: float, /) -> float: ...
@overload
def deg(angle: float, /, *angles: float) -> tuple[float, ...]: ...
def deg(angle: float, /, *angles: float) -> float | tuple[float, ...]:
    """Degrees to radians: one angle to a float, several to a tuple."""
    if not angles:
        return math.radians(angle)
    return tuple(math.radians(value) for value in (angle, *angles))


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


def dh(alpha: Expression, a: Expression, d: Expression, theta: Expression) -> Expression:
    """Standard DH link, 4x4: RotZ(theta) TransZ(d) TransX(a) RotX(alpha), eq (1) of arXiv:2208.02652.

    `alpha` and `theta` in rad, `a` and `d` in mm; the joint angle is added to `theta` by the caller.
    """
    ct, st, c_alpha, s_alpha = ca.cos(theta), ca.sin(theta), ca.cos(alpha), ca.sin(alpha)
    return ca.blockcat(
        [
            [ct, -st * c_alpha, st * s_alpha, a * ct],
            [st, ct * c_alpha, -ct * s_alpha, a * st],
            [0, s_alpha, c_alpha, d],
            [0, 0, 0, 1],
        ]
    )


def modified_dh(alpha: Expression, a: Expression, d: Expression, theta: Expression) -> Expression:
    """Modified (Craig's) DH link, 4x4: RotX(alpha) TransX(a) RotZ(theta) TransZ(d).

    `alpha` and `a` belong to the axis before the joint. Craig, Introduction to Robotics, eq (3.6).
    """
    ct, st, c_alpha, s_alpha = ca.cos(theta), ca.sin(theta), ca.cos(alpha), ca.sin(alpha)
    return ca.blockcat(
        [
            [ct, -st, 0, a],
            [st * c_alpha, ct * c_alpha, -s_alpha, -d * s_alpha],
            [st * s_alpha, ct * s_alpha, c_alpha, d * c_alpha],
            [0, 0, 0, 1],
        ]
    )


def chain(*transforms: Expression) -> Expression:
    """Product T_1 T_2 ... T_n of 4x4 transforms, eq (2) of arXiv:2208.02652."""
    return reduce(ca.mtimes, transforms, identity())


def position(pose: Expression) -> Expression:
    """Origin of a pose, 3 mm."""
    return pose[:3, 3]


def rotation(pose: Expression) -> Expression:
    """Rotation matrix of a pose, 3x3."""
    return pose[:3, :3]


def transform_point(pose: Expression, point: Expression) -> Expression:
    """Carry a point (3, mm) given in the pose's own frame to the base frame."""
    return ca.mtimes(rotation(pose), point) + position(pose)


def rotation_of_quaternion(q: Expression) -> Expression:
    """Rotation matrix (3x3) of a unit quaternion (w, x, y, z); a polynomial, so exact only on the unit sphere."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ca.blockcat(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )

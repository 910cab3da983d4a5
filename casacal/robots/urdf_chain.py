"""The arm between two links of a URDF: origins of its moving joints as parameters, fixed joints folded in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.kinematics import Expression, chain, rigid, rotate, rotate_x, rotate_y, rotate_z, slide
from casacal.robots.files.urdf import UrdfFile, UrdfJoint, check_joint
from casacal.robots.files.urdf_reader import read_urdf
from casacal.robots.joints import Conventions, Joint
from casacal.unknowns import Parameter, Unknown

MM = 1000.0  # millimetres in a URDF's metre


@dataclass(frozen=True)
class UrdfChain:
    """The joints, moving and fixed, between two links of a URDF.

    `file` is the file's name, without its folder; `path`, where it was read, says nothing of the arm.
    """

    file: str
    name: str
    chain: tuple[UrdfJoint, ...]
    conventions: Conventions | None = None
    path: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not self.moving:
            raise ProblemError(f"{self.file}: no joint moves between base and tip", "Name a tip above moving joints")
        if self.conventions is not None:
            self.conventions.check_joints(len(self.moving), self.name)

    @staticmethod
    def read(path: str | Path, base: str | None, tip: str | None, conventions: Conventions | None) -> UrdfChain:
        """Read a URDF and take the chain from a base link to a tip link; raises ProblemError."""
        found = read_urdf(path)
        joints = found.chain(base, tip)
        for joint in joints:
            check_joint(found.file, joint)
        return UrdfChain(Path(path).name, found.name, joints, conventions, str(Path(path).resolve()))

    @property
    def moving(self) -> tuple[UrdfJoint, ...]:
        """The joints that move, in order."""
        return tuple(joint for joint in self.chain if joint.kind != "fixed")

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Kinds and limits, rad and mm; +-pi for a continuous joint. As the controller shows them, where that differs.

        Where a controller couples joints, each gets the widest range that the model's limits leave it.
        """
        low, high = np.array([_limits(joint) for joint in self.moving]).T
        if self.conventions is not None:
            spread = np.abs(np.linalg.inv(self.conventions.matrix)) @ ((high - low) / 2)
            middle = self.conventions.to_controller((low + high) / 2)
            low, high = middle - spread, middle + spread
        kinds = ["prismatic" if joint.kind == "prismatic" else "revolute" for joint in self.moving]
        rows = zip(kinds, low, high, strict=True)
        return tuple(Joint(kind, float(lower), float(upper)) for kind, lower, upper in rows)  # type: ignore[arg-type]

    def pose(self, p: Any, q: Expression) -> Expression:
        """Pose of the tip link in the base link (4x4, mm) at the origins of `p` and joint values q (n; rad, mm)."""
        q = q if self.conventions is None else self.conventions.to_model(q)
        links, fixed, i = [], np.eye(4), 0
        for joint in self.chain:
            if joint.kind == "fixed":
                fixed = fixed @ origin_matrix(joint)
                continue
            links += [*self._origin(fixed, joint, p, i), _motion(joint, q[i])]
            fixed, i = np.eye(4), i + 1
        return chain(*links, *([] if np.array_equal(fixed, np.eye(4)) else [ca.DM(fixed)]))

    def _origin(self, fixed: Array, joint: UrdfJoint, p: Any, i: int) -> list[Expression]:
        """Origin of moving joint i, after the fixed ones before it: its place and turn, then its small turns."""
        shift = ca.vertcat(p.x[i], p.y[i], p.z[i])
        turn = origin_matrix(joint)[:3, :3]
        place = ca.mtimes(ca.DM(fixed[:3, :3]), shift) + ca.DM(fixed[:3, 3])
        origin = rigid(ca.DM(fixed[:3, :3] @ turn), place)
        return [origin, rotate_x(p.rx[i]), rotate_y(p.ry[i]), rotate_z(p.rz[i])]

    def parameters(self, length_std: float | None, angle_std: float | None) -> dict[str, Unknown]:
        """Unknowns x, y, z (mm): the origins; rx, ry, rz (rad, nominally zero): small turns of each joint's frame.

        The turns are about the frame's own axes and not the file's roll, pitch and yaw: these lose a direction at a
        pitch of 90 degrees, where many drawings stand.
        """
        rows = np.array([joint.xyz for joint in self.moving]).T * MM
        lengths = {
            key: Parameter(tuple(map(float, row)), unit="mm", prior_std=length_std)
            for key, row in zip("xyz", rows, strict=True)
        }
        zeros = (0.0,) * len(self.moving)
        turns = {key: Parameter(zeros, unit="rad", prior_std=angle_std) for key in ("rx", "ry", "rz")}
        return {**lengths, **turns}

    def origins_at(self, p: Any) -> list[Array]:
        """Origins (4x4, mm) of the moving joints in their parents at numbers `p`, without the fixed joints."""
        return [
            np.asarray(chain(*self._origin(np.eye(4), joint, p, i)).matrix, dtype=np.float64)
            for i, joint in enumerate(self.moving)
        ]


def origin_matrix(joint: UrdfJoint) -> Array:
    """Nominal <origin> (4x4, mm): RotZ(yaw) RotY(pitch) RotX(roll), as the URDF's fixed-axis roll, pitch, yaw mean."""
    return placed(joint.xyz, joint.rpy)


def placed(xyz: Sequence[float], rpy: Sequence[float]) -> Array:
    """Pose (4x4, mm) of what a URDF places at xyz (m), turned by roll, pitch and yaw (rad) about fixed axes."""
    roll, pitch, yaw = rpy
    matrix = np.array(chain(rotate_z(yaw), rotate_y(pitch), rotate_x(roll)), dtype=np.float64)
    matrix[:3, 3] = np.array(xyz) * MM
    return matrix


def hangs(found: UrdfFile, link: str, root: str, moving: list[str]) -> tuple[int, Array] | None:
    """The last moving joint of the chain above a link (-1 for none), and the link's pose at zero; None elsewhere."""
    way = found.between(root, link)
    if way is None:
        return None
    pose = np.eye(4)
    for joint in reversed(way):
        pose = origin_matrix(joint) @ pose
    return max((moving.index(joint.name) for joint in way if joint.name in moving), default=-1), pose


def _limits(joint: UrdfJoint) -> tuple[float, float]:
    """Lower and upper limit, rad or mm."""
    if joint.kind == "continuous" or joint.limits is None:
        return -math.pi, math.pi
    scale = MM if joint.kind == "prismatic" else 1.0
    return joint.limits[0] * scale, joint.limits[1] * scale


def _motion(joint: UrdfJoint, q: Expression) -> Expression:
    """What a joint does; turns about a coordinate axis keep their zeros."""
    axis = np.array(joint.axis) / math.hypot(*joint.axis)
    if joint.kind == "prismatic":
        return slide(axis, q)
    for k, turn in enumerate((rotate_x, rotate_y, rotate_z)):
        if abs(axis[k]) > 1 - 1e-15:
            return turn(q if axis[k] > 0 else -q)
    return rotate(axis, q)

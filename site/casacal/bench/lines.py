"""An arm as drawn, as the lines that its joints turn about: what other packages can be given, whatever their form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from casacal.array_types import Array
from casacal.binding.bound_problem import bind
from casacal.errors import CasacalError
from casacal.instruments import TrackedPoint, TrackedPose
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.unknowns.fits import rigid_fit, transform

SAME = 1e-6  # mm by which the arm as lines may differ from the arm as drawn
ALONG = 1e-9  # sine of the angle between axes below which they are parallel as drawn


@dataclass(frozen=True)
class Lines:
    """An arm as drawn: its revolute axes and its point at joint values zero, and the rows that are to be fitted.

    axes: unit vectors (n, 3). points: a point of each axis (n, 3), mm. tip: (3,), mm. station: from the base to the
    frame of the readings (4, 4). joints: (N, n), rad. read: (N, 3), mm. noise: of each coordinate, mm.
    """

    axes: Array
    points: Array
    tip: Array
    station: Array
    joints: Array
    read: Array
    noise: float

    @property
    def frames(self) -> Array:
        """A frame (n, 4, 4) on each axis: z along it, x the common normal to the next, as in modified DH."""
        frames = np.tile(np.eye(4), (len(self.axes), 1, 1))
        for k, (z, at) in enumerate(zip(self.axes, self.points, strict=True)):
            normal = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
            if k + 1 < len(self.axes):
                normal, at = _common_normal(at, z, self.points[k + 1], self.axes[k + 1])
            x = normal / np.linalg.norm(normal)
            frames[k, :3] = np.column_stack([x, np.cross(z, x), z, at])
        return frames

    @property
    def moves(self) -> Array:
        """Transforms (n + 1, 4, 4) at joint values zero: base to first frame, one frame to the next, last to tip."""
        whole = np.stack([np.eye(4), *self.frames, transform(np.eye(3), self.tip)])
        return np.asarray(np.linalg.inv(whole[:-1]) @ whole[1:])


def _common_normal(at: Array, z: Array, point: Array, following: Array) -> tuple[Array, Array]:
    """Direction (3,) of the common normal from one axis to the next, and its foot (3,) on the first."""
    across, apart = np.cross(z, following), point - at
    if np.linalg.norm(across) < ALONG:
        normal = apart - z * (z @ apart)
        return (normal, at) if np.linalg.norm(normal) > SAME else (np.cross(z, np.eye(3)[np.argmin(np.abs(z))]), at)
    along = np.cross(apart, following) @ across / (across @ across)
    return across, at + along * z


def lines_of(problem: Problem, fitted: Samples, package: str) -> Lines:
    """The arm as a package is given it; raises CasacalError where it takes no such arm or instrument."""
    instrument, fix = problem.instrument, f"Leave {package} out"
    if not isinstance(instrument, (TrackedPoint, TrackedPose)) or instrument.station.per is not None:
        name = type(instrument).__name__
        raise CasacalError(f"{package} fits points read in one frame, and this set is measured by {name}", fix)
    if not problem.robot.revolute.all():
        raise CasacalError(f"{package} is given arms of revolute joints, and this one has others", fix)
    bound = bind(problem.without_effects, fitted)
    n, tips = len(problem.robot.axes), bound.tips(bound.x0, fitted.joints)
    turned = bound.poses(bound.x0, np.vstack([np.zeros(n), np.pi / 2 * np.eye(n)]))
    moves = turned[1:] @ np.linalg.inv(turned[0])
    skew = (moves[:, :3, :3] - moves[:, :3, :3].transpose(0, 2, 1)) / 2
    axes = np.column_stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])
    points = np.stack([np.linalg.pinv(np.eye(3) - move[:3, :3]) @ move[:3, 3] for move in moves])
    read = np.column_stack([fitted.columns[axis] for axis in "xyz"])
    tip = bound.tips(bound.x0, np.zeros((1, n)))[0]
    station = rigid_fit(tips, read)
    if station is None:
        raise CasacalError(f"{package} needs points that do not lie on a line", fix)
    found = Lines(axes, points, tip, station, fitted.joints, read, float(bound.block.noise[:, :3].mean()))
    if np.abs(_carried(found) - tips).max() > SAME:
        raise CasacalError(f"{package} is given arms each of whose joints turns one axis, and this one is coupled", fix)
    return found


def _carried(lines: Lines) -> Array:
    """Where the arm as lines carries its tip (N, 3), mm."""
    found = np.tile(lines.tip, (len(lines.joints), 1))
    for axis, point, angles in reversed(list(zip(lines.axes, lines.points, lines.joints.T, strict=True))):
        found = point + Rotation.from_rotvec(angles[:, None] * axis).apply(found - point)
    return found

"""Other packages as ways to calibrate: pybotics, robotkinecal and figaroh, each from the same rows and the same start.

They fit points that are read in one frame; of poses they are given the positions. Each is handed the arm as drawn in
its own form, made of the joints' axes at zero, and the station and tip that the other methods start from. One that is
not installed says so in place of a result: `casacal bench studies/bench --methods studies/bench/packages.py`.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from casacal.data.samples import Samples
from casacal.deployment.export import roll_pitch_yaw
from casacal.errors import CasacalError
from casacal.fit.bound_problem import bind
from casacal.model.geometry import rigid_fit, transform
from casacal.model.points import TrackedPoint
from casacal.model.problem import Problem
from casacal.model.tracked_pose import TrackedPose
from casacal.values import Array

MM = 1000.0  # per metre
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
    bound = bind(problem.without_terms, fitted)
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
    carried = np.tile(tip, (len(fitted.joints), 1))  # where the arm as lines carries its tip
    for axis, point, angles in reversed(list(zip(axes, points, fitted.joints.T, strict=True))):
        carried = point + Rotation.from_rotvec(angles[:, None] * axis).apply(carried - point)
    if np.abs(carried - tips).max() > SAME:
        raise CasacalError(f"{package} is given arms each of whose joints turns one axis, and this one is coupled", fix)
    return found


def by_pybotics(problem: Problem, fitted: Samples, unseen: Samples) -> Array:
    """Modified DH, tool point and world by `scipy.optimize.least_squares` on pybotics' `optimize_accuracy`."""
    lines = lines_of(problem, fitted, "pybotics")
    with _quiet("pybotics"):
        from pybotics.kinematic_chain import MDHKinematicChain
        from pybotics.optimization import OptimizationHandler, optimize_accuracy
        from pybotics.robot import Robot
        from pybotics.tool import Tool

        first, *moves, tool = lines.moves
        tool[:3, :3] = np.eye(3)
        chain = MDHKinematicChain(np.array([np.zeros(4), *map(_modified_dh, moves)]))
        robot = Robot(chain, tool=Tool(tool), world_frame=lines.station @ first)
        handler = OptimizationHandler(robot, True, [True] * 3 + [False] * 3, True)
        start = handler.generate_optimization_vector()
        found = least_squares(optimize_accuracy, start, args=(handler, lines.joints, lines.read))
        handler.apply_optimization_vector(found.x)
        predicted = np.array([handler.robot.fk(q)[:3, 3] for q in unseen.joints])
    return np.asarray(predicted - _read(unseen))


def _modified_dh(move: Array) -> tuple[float, float, float, float]:
    """alpha, a, theta, d of the transform from a frame to the next at joint value zero."""
    alpha, theta = np.arctan2(-move[1, 2], move[2, 2]), np.arctan2(-move[0, 1], move[0, 0])
    d = -np.sin(alpha) * move[1, 3] + np.cos(alpha) * move[2, 3]
    return float(alpha), float(move[0, 3]), float(theta), float(d)


def by_robotkinecal(problem: Problem, fitted: Samples, unseen: Samples) -> Array:
    """Screws of all joints and the tip by `SerialRobotKineCal.solve`; the station is in the screws."""
    lines = lines_of(problem, fitted, "robotkinecal")
    back = np.asarray(np.linalg.inv(lines.station))
    with _quiet("robotkinecal"):
        from roboticstoolbox import ET, ETS, ERobot, Link
        from robotkinecal import SerialRobotKineCal

        links: list[Any] = []
        for k, move in enumerate(lines.moves):
            turn = [ET.Rz()] if k < len(lines.axes) else []
            links.append(Link(ETS([ET.SE3(move), *turn]), name=f"link{k + 1}", parent=links[-1] if links else None))
        fit = SerialRobotKineCal(ERobot(links), links[-1].name)
        fit.set_observations(list(lines.joints), list(_moved(back, lines.read)))
        fit.solve()
        last = len(lines.axes) + 1
        predicted = np.array([fit.forward_kinematics(last, q).t for q in unseen.joints])
    return np.asarray(predicted - _moved(back, _read(unseen)))


def by_figaroh(problem: Problem, fitted: Samples, unseen: Samples) -> Array:
    """Placements of all joints, base and marker by figaroh's `BaseCalibration.solve`, with its own priors ("map").

    Its default, which takes what a structure shows by itself, leaves out parameters that these rows do show.
    """
    lines = lines_of(problem, fitted, "figaroh")
    names = [f"joint{k + 1}" for k in range(len(lines.axes))]
    with _quiet("figaroh"), tempfile.TemporaryDirectory() as folder:
        import pinocchio
        from figaroh.calibration import BaseCalibration
        from figaroh.calibration.calibration_tools import calc_updated_fkm

        class Positions(BaseCalibration):  # type: ignore[misc]
            """Points in the frame of the readings, as figaroh's own examples subclass it."""

            def cost_function(self, var: Array) -> Any:
                """Readings less model, m."""
                return self.PEE_measured - self.get_pose_from_measure(var)

        place = Path(folder)
        robot = pinocchio.RobotWrapper(pinocchio.buildModelFromXML(_urdf(lines, names)))
        rows = np.column_stack([lines.read / MM, lines.joints])
        header = ",".join(["x1", "y1", "z1", *names])
        np.savetxt(place / "rows.csv", rows, delimiter=",", header=header, comments="", fmt="%.17g")
        (place / "task.yaml").write_text(json.dumps(_task(place / "rows.csv", lines, names)), encoding="utf-8")
        fit = Positions(robot, str(place / "task.yaml"))
        fit.calib_config |= {"known_baseframe": False, "known_tipframe": False}
        fit.initialize()
        found = fit.solve(enable_logging=False)
        there = fit.calib_config | {"NbSample": len(unseen)}
        predicted = calc_updated_fkm(fit.model, fit.data, found.x, unseen.joints, there).reshape(3, -1).T
    return np.asarray(MM * predicted - _read(unseen))


def _task(rows: Path, lines: Lines, names: list[str]) -> dict[str, Any]:
    """figaroh's description of the fit: every placement of every joint, points in an unknown frame."""
    estimation = {"method": "map", "noise_std": lines.noise / MM}
    marker = {"measurable_dof": [True] * 3 + [False] * 3}
    calibration = {
        "enabled": True,
        "joints": {"active_joints": names},
        "kinematics": {"base_frame": "universe", "tool_frame": "tip"},
        "measurements": {"markers": [marker]},
        "parameters": {"calibration_level": "full_params", "estimation": estimation},
        "data": {"source_file": str(rows), "number_of_samples": len(lines.joints)},
    }
    return {"robot": {"name": "drawn"}, "tasks": {"calibration": calibration}}


def _urdf(lines: Lines, names: list[str]) -> str:
    """The arm as drawn: a link behind each joint, whose axis is z, and the tip; m and rad."""
    parts = ['<robot name="drawn"><link name="link0"/>']
    for k, move in enumerate(lines.moves):
        turn = roll_pitch_yaw(move[:3, :3], (0.0, 0.0, 0.0))
        kind, name, child = ("revolute", names[k], f"link{k + 1}") if k < len(names) else ("fixed", "at", "tip")
        xyz, rpy = (" ".join(f"{v:.17g}" for v in each) for each in (move[:3, 3] / MM, turn))
        parts.append(
            f'<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="link{k}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
            '<limit lower="-7" upper="7" effort="1" velocity="1"/></joint>'
        )
    return "".join([*parts, "</robot>"])


def _read(samples: Samples) -> Array:
    return np.column_stack([samples.columns[axis] for axis in "xyz"])


def _moved(transform: Array, points: Array) -> Array:
    return np.asarray(points @ transform[:3, :3].T + transform[:3, 3])


@contextlib.contextmanager
def _quiet(package: str) -> Iterator[None]:
    """Without what a package prints and warns of, and with its random numbers the same each time.

    Raises CasacalError where it is not installed.
    """
    if importlib.util.find_spec(package) is None:
        raise CasacalError(f"{package} is not installed", f"Install it with pip install 'casacal[{package}]'")
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        np.random.set_state(state)  # noqa: NPY002


methods = {"pybotics": by_pybotics, "robotkinecal": by_robotkinecal, "figaroh": by_figaroh}

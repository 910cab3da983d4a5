"""Other packages as ways to calibrate: pybotics, robotkinecal and figaroh, each from the same rows and the same start.

They fit points that are read in one frame; of poses they are given the positions. Each is handed the arm as drawn in
its own form, made of the joints' axes at zero, and the station and tip that the other methods start from.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from casacal.array_types import Array
from casacal.bench.lines import Lines, lines_of
from casacal.bench.methods import Way
from casacal.export.controllers import roll_pitch_yaw
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples

MM = 1000.0  # per metre


def by_pybotics(problem: Problem, fitted: Samples, unseen: Samples) -> Array:
    """Modified DH, tool point and world by `scipy.optimize.least_squares` on pybotics' `optimize_accuracy`."""
    lines = lines_of(problem, fitted, "pybotics")
    with _quiet():
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
    with _quiet():
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
    with _quiet(), tempfile.TemporaryDirectory() as folder:
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
def _quiet() -> Iterator[None]:
    """Without what packages print and warn of, and with their random numbers the same each time."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        np.random.set_state(state)  # noqa: NPY002


PACKAGES: Mapping[str, Way] = {"pybotics": by_pybotics, "robotkinecal": by_robotkinecal, "figaroh": by_figaroh}
"""Packages by name, each an extra of casacal."""


def absent(package: str) -> str:
    """What to say of a package that is not installed; nothing of one that is."""
    if importlib.util.find_spec(package) is not None:
        return ""
    return f"{package} is not installed, and left out. Install it with pip install 'casacal[{package}]'"

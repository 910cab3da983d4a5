"""Joint zero corrections: what a controller that knows zero offsets alone can be told of a calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import CalibratedArm, arm_values
from casacal.compensation.result_file import arm_from
from casacal.export.remark import MARK, remark
from casacal.robots.files.dh_fields import plain
from casacal.uncertainty.workspace import workspace_joints

LEVER = 100.0
"""Distance (mm) from the flange's origin of the points that stand for its orientation."""
STEPS = 5


@dataclass(frozen=True)
class ZeroCorrections:
    """Corrections (n,; rad, mm) in the controller's sign, and what they leave.

    values: where the controller shows q, the calibrated arm stands as the drawn one would at q + values. So a target t
        is met by sending t - values; or by changing the controller's zeros so that it shows q + values where it
        showed q. before, after: distance (mm RMS) between the two without and with them, over the workspace, of
        the flange's origin and of three points `LEVER` from it along its axes.
    """

    values: Array
    before: float
    after: float

    @property
    def share(self) -> float:
        """Fraction of the calibration's squared effect that zero offsets express, 0 to 1."""
        return 1.0 - (self.after / self.before) ** 2 if self.before > 0 else 1.0


def zero_corrections(result: CalibratedArm) -> ZeroCorrections:
    """Least-squares zero corrections of a calibration, whatever the robot is built from."""
    result = arm_from(result)
    robot = result.source.problem.robot
    q = ca.SX.sym("q", len(robot.axes))
    drawn, true = (_points(ca.SX(robot.pose(arm_values(result, nominal=nominal), q))) for nominal in (True, False))
    joints = workspace_joints(robot)
    count = len(joints)
    evaluate = ca.Function("points", [q], [drawn, ca.jacobian(drawn, q)]).map(count)
    target = np.asarray(ca.Function("points", [q], [true]).map(count)(joints.T)).T
    values = np.zeros(len(robot.axes))
    misses = []
    for _ in range(STEPS):  # Gauss-Newton on corrections of a degree or less: quadratic at once
        points, slopes = evaluate((joints + values).T)
        error = (target - np.asarray(points).T).ravel()
        misses.append(error)
        slope = np.asarray(slopes).reshape(12, count, -1).transpose(1, 0, 2).reshape(12 * count, -1)
        values = values + np.linalg.lstsq(slope, error, rcond=1e-9)[0]
    rms = [math.sqrt(float((error**2).sum()) / (4 * count)) for error in (misses[0], misses[-1])]
    return ZeroCorrections(values, rms[0], rms[1])


def zeros_text(result: CalibratedArm) -> str:
    """Zero corrections as CSV, degrees (mm where a joint slides), with what they can and cannot express."""
    result = arm_from(result)
    found = zero_corrections(result)
    axes = result.source.problem.robot.axes
    slides = any(joint.kind == "prismatic" for joint in axes)
    lines = [f"# {line}" for line in remark(result, form="zeros")]
    lines += [
        f"# {MARK}where the controller shows q, the arm is where the drawn arm would be at q + correction. Do one of "
        f"these, never both:",
        f"# {MARK}(1) subtract each correction from the joint values of every target, and leave the zeros as they are",
        f"# {MARK}(2) change the controller's zeros so that, at rest, each joint shows its value + correction, and "
        "leave the targets as they are",
        f"# {MARK}the calibration moves the flange by {found.before:.3f} mm RMS over the workspace (its origin and "
        f"points {LEVER:g} mm from it)",
        f"# {MARK}zero offsets express {100 * found.share:.0f} % of its mean square; {found.after:.3f} mm RMS remain",
        "joint,correction_deg" + (",correction_mm" if slides else ""),
    ]
    for i, (joint, value) in enumerate(zip(axes, found.values, strict=True), 1):
        turns = joint.turns
        cells = [str(i), f"{math.degrees(value) + 0.0:.6f}" if turns else ""]
        lines.append(",".join(cells + (["" if turns else plain(round(value, 6))] if slides else [])))
    return "\n".join(lines) + "\n"


def _points(pose: ca.SX) -> ca.SX:
    """The flange's origin and three points along its axes (12), mm."""
    return ca.vertcat(pose[:3, 3], *(pose[:3, 3] + LEVER * pose[:3, k] for k in range(3)))

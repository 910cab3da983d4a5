"""A work object's frame from three touched faces or points, as controllers write it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casacal.deployment.arm import (
    NO_COLUMNS,
    CalibratedArm,
    covariance_of,
    local_coordinates,
    named_covariance,
    row_constants,
    whole_rows,
)
from casacal.deployment.remark import remark
from casacal.deployment.result_file import arm_from
from casacal.errors import CasacalError, refuse_unknown
from casacal.model.carriers import Facing
from casacal.model.geometry import Plane
from casacal.uncertainty.tip_error import rigid_fields, workspace_joints
from casacal.values import Array, Value

SKEW = math.sin(math.radians(5.0))
"""Sine of the angle below which faces are parallel, or points on a line, and fix no frame."""

STEP = 1e-6  # step of a tilt (rad) or an offset (mm), for slopes


@dataclass(frozen=True, eq=False)
class WorkFrame(Value):
    """A work object's frame `matrix` (4, 4; mm) in the base frame of the calibrated arm.

    origin_std, turn_std: standard deviations of its origin (mm) and orientation (rad), three axes together, as the arm
    comes to it, apart from the pose of the base; NaN where the result holds none.
    """

    matrix: Array
    origin_std: float
    turn_std: float


def work_frame(
    result: CalibratedArm,
    *,
    faces: Sequence[str] | None = None,
    points: Sequence[str] | None = None,
    force: bool = False,
) -> WorkFrame:
    """The frame of three faces or of three points that a calibration found.

    Of faces: z is the normal of the first, x that of the second as far as it lies across z, the origin is where all
    three meet. Normals point to the arm's side. Of points: the first is the origin, x points to the second, and the
    third lies in the xy plane, on the side of y. Touches with a ball give faces and points of its centre. Either are
    three labels, of faces or of points of `FixedPoint`. force: take a result whose verdict is not to use it; its frame
    has no standard deviations.

    Raises CasacalError where these fix no frame, or not three are named; UnknownNameError for a label that is none.
    """
    from scipy.spatial.transform import Rotation

    result = arm_from(result)
    result.check_usable(force=force)
    labels, build = (faces, _of_faces) if faces is not None else (points, _of_points)
    named = isinstance(labels, (tuple, list)) and all(isinstance(label, str) for label in labels)
    if (faces is None) == (points is None) or labels is None or not named or len(labels) != 3:
        raise CasacalError("A work object's frame comes from three faces or from three points", "Name three of either")
    if twice := [label for label in labels if labels.count(label) > 1]:
        raise CasacalError(f"'{twice[0]}' is named twice", "Name three different faces, or three different points")
    places, names = _faces(result, labels) if faces is not None else _points(result, labels)
    matrix = build(places(np.zeros(len(names))))
    if result.denial is not None or result.found.covariance is None:
        return WorkFrame(matrix, math.nan, math.nan)
    covariance, known = named_covariance(result)
    slopes = _base(result, matrix[:3, 3], len(known))
    for j, name in enumerate(names):
        if name in known:
            move = np.zeros(len(names))
            move[j] = STEP
            there, back = build(places(move)), build(places(-move))  # central differences
            turn = Rotation.from_matrix(there[:3, :3] @ back[:3, :3].T).as_rotvec()
            slopes[:, known.index(name)] += np.concatenate([there[:3, 3] - back[:3, 3], turn]) / (2 * STEP)
    lost = ~np.isfinite(np.diagonal(covariance)) & (np.abs(slopes) > 0).any(axis=0)
    if lost.any():
        return WorkFrame(matrix, math.inf, math.inf)
    spread = slopes @ np.where(np.isfinite(covariance), covariance, 0.0) @ slopes.T
    origin_variance, turn_variance = np.trace(spread[:3, :3]), np.trace(spread[3:, 3:])
    return WorkFrame(matrix, math.sqrt(max(origin_variance, 0.0)), math.sqrt(max(turn_variance, 0.0)))


def frame_text(
    result: CalibratedArm,
    *,
    faces: Sequence[str] | None = None,
    points: Sequence[str] | None = None,
    force: bool = False,
) -> str:
    """The frame of `work_frame` (arguments and errors as there) as ABB, FANUC, KUKA and Universal Robots write it."""
    from scipy.spatial.transform import Rotation

    result = arm_from(result)
    frame = work_frame(result, faces=faces, points=points, force=force)
    turn, (x, y, z) = Rotation.from_matrix(frame.matrix[:3, :3]), frame.matrix[:3, 3]
    w1, w2, w3, w0 = turn.as_quat(canonical=True)
    c, b, a = turn.as_euler("xyz", degrees=True)
    rx, ry, rz = turn.as_rotvec()
    what = f"faces {', '.join(faces)}" if faces is not None else f"points {', '.join(points or ())}"
    spread = f"{frame.origin_std:.3f} mm, {1e3 * frame.turn_std:.3f} mrad (three axes together)"
    base = "the base frame of the calibrated arm"
    if isinstance(result.source.problem.robot.pose, Facing):  # two chains that face each other
        base = "the frame of what faces the arm and moves with it (a table, another flange), not of the arm's base"
    lines = [
        *(f"# {line}" for line in remark(result, form="frame")),
        f"# work object of {what}, in {base}",
        "# standard deviation, apart from the pose of the base: "
        + (spread if math.isfinite(frame.origin_std) else "not known"),
        f'ABB, RAPID: PERS wobjdata work := [FALSE, TRUE, "", [[{x:.4f}, {y:.4f}, {z:.4f}], '
        f"[{w0:.9f}, {w1:.9f}, {w2:.9f}, {w3:.9f}]], [[0, 0, 0], [1, 0, 0, 0]]];",
        f"FANUC, user frame (mm, deg): X {x:.4f}  Y {y:.4f}  Z {z:.4f}  W {c:.5f}  P {b:.5f}  R {a:.5f}",
        f"KUKA, KRL: FRAME work = {{X {x:.4f}, Y {y:.4f}, Z {z:.4f}, A {a:.5f}, B {b:.5f}, C {c:.5f}}}",
        f"Universal Robots, URScript (m, rad): work = p[{x / 1e3:.7f}, {y / 1e3:.7f}, {z / 1e3:.7f}, "
        f"{rx:.8f}, {ry:.8f}, {rz:.8f}]",
    ]
    return "\n".join(lines) + "\n"


Places = Callable[[Array], Array]
"""Moves of some unknowns (k,) from where they were found -> three faces (3, 6: normal, point) or points (3, 3)."""


def _faces(result: CalibratedArm, labels: Sequence[str]) -> tuple[Places, list[str]]:
    """Three faces, and the names of the unknowns that move them."""
    proposed = result.found.proposed
    refuse_unknown(f"face of {result.file}", labels, result.found.planes)
    plane = result.source.problem.instrument.unknowns.get("plane")
    if not isinstance(plane, Plane):
        raise CasacalError(f"The faces of {result.file} are no planes of the instrument", "Name three points instead")
    names = [name for label in labels for name in plane.names(f"plane.{label}")]
    moved = result.found.values(alone=False)
    local = np.array([moved.get(name, 0.0) for name in names]).reshape(3, -1)
    nominals = [plane.nominal if plane.nominal is not None else proposed[f"plane.{k}"] for k in labels]

    def places(moves: Array) -> Array:
        found = [
            plane.at(ca.DM(nominal), ca.DM(at + move))
            for nominal, at, move in zip(nominals, local, moves.reshape(3, -1), strict=True)
        ]
        return np.array([np.concatenate([np.array(each.normal), np.array(each.point)]).ravel() for each in found])

    return places, names


def _points(result: CalibratedArm, labels: Sequence[str]) -> tuple[Places, list[str]]:
    """Three points, and the names of their coordinates."""
    known = {row.name: row.estimate for row in result.found.parameters}
    labelled = tuple(named[1] for name in known if (named := re.fullmatch(r"point\.(.*)_x", name, re.DOTALL)))
    refuse_unknown(f"point of {result.file}", labels, labelled)
    names = [f"point.{label}_{axis}" for label in labels for axis in "xyz"]
    found = np.array([known[name] for name in names])
    return lambda moves: (found + moves).reshape(3, 3), names


def _of_faces(faces: Array) -> Array:
    """The frame (4, 4) of three faces: normals (3, 3) and a point on each (3, 3)."""
    normals, points = faces[:, :3], faces[:, 3:]
    z, across = normals[0], normals[1] - (normals[1] @ normals[0]) * normals[0]
    if np.linalg.norm(across) < SKEW or abs(np.linalg.det(normals)) < SKEW:
        raise CasacalError(
            "These three faces do not meet in one point", "Name three that are at an angle to each other"
        )
    return _frame(across, z, np.linalg.solve(normals, (normals * points).sum(axis=1)))


def _of_points(points: Array) -> Array:
    """The frame (4, 4) of three points."""
    along, aside = points[1] - points[0], points[2] - points[0]
    z = np.cross(along, aside)
    if np.linalg.norm(z) < SKEW * np.linalg.norm(along) * np.linalg.norm(aside):
        raise CasacalError("These three points lie on a line", "Name three that do not")
    return _frame(along, z, points[0])


def _base(result: CalibratedArm, origin: Array, count: int) -> Array:
    """Minus the derivative (6, count) of the base's shift at the origin (mm) and turn (rad) by each unknown."""
    # the base's move is the rigid motion that fits those of the tips over the workspace best
    problem = result.source.problem.without_terms
    model, joints = problem.model, workspace_joints(problem.robot)
    rows = whole_rows(joints, joints.shape[1], model.names, NO_COLUMNS)
    local, constants = local_coordinates(result, of=problem), row_constants(result, problem)
    tips, field = model.batch("tip_jacobian")(local, constants, rows)
    pairs = covariance_of(result)[1]
    columns, places = ([pair[k] for pair in pairs] for k in (0, 1))
    moved = field.reshape(3 * len(tips), -1)[:, columns]
    found = np.zeros((6, count))
    found[:, places] = -np.linalg.lstsq(rigid_fields(tips, origin), moved, rcond=None)[0]
    return found


def _frame(x: Array, z: Array, origin: Array) -> Array:
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([x, np.cross(z, x), z, origin])
    return matrix

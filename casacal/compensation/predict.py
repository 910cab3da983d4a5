"""Where a calibrated (or true, or nominal) robot is at given joint values, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import (
    FRAMES,
    CalibratedArm,
    covariance_of,
    local_coordinates,
    named_covariance,
    numbers,
    row_constants,
)
from casacal.compensation.result_file import arm_from
from casacal.discrepancy.effect import Site
from casacal.errors import CasacalError, UnknownNameError
from casacal.files import write_text
from casacal.kinematics import stacked_poses
from casacal.problem.compile import RowModel
from casacal.problem.problem_file import ProblemFile
from casacal.robots.joint_space import joint_values
from casacal.samples.layout import Layout
from casacal.samples.samples import Samples
from casacal.tables.columns import Columns
from casacal.tables.read import is_frame, read_columns, table_of_frame
from casacal.uncertainty.workspace import tip_stds, up_to_base, workspace_joints
from casacal.values import Value, frozen


@dataclass(frozen=True, eq=False)
class Prediction(Value):
    """Positions (N, 3; mm) and unit quaternions (N, 4; w, x, y, z, w >= 0) in the base frame.

    `std` (N,) is the standard deviation of the position, mm, its three axes together, apart from where the base
    stands; or None.
    """

    positions: Array
    quaternions: Array
    std: Array | None = None

    def __post_init__(self) -> None:
        frozen((self.positions, self.quaternions, self.std))

    @property
    def poses(self) -> Array:
        """The same as transforms (N, 4, 4), mm."""
        from scipy.spatial.transform import Rotation

        poses = np.tile(np.eye(4), (len(self.positions), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat(np.roll(self.quaternions, -1, axis=1)).as_matrix()
        poses[:, :3, 3] = self.positions
        return poses

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        spread = "" if self.std is None else f", standard deviation up to {self.std.max(initial=0.0):.3g} mm"
        return f"<{len(self)} predicted poses{spread}>"


def read_joints(path: str | Path, source: ProblemFile) -> Samples:
    """Read joint values, and the instrument's columns where the file has them; raises SamplesError."""
    return _joints_of(read_columns(path, lambda header: [n for n in header if n.startswith("q")]), source)


def _joints_of(columns: Columns, source: ProblemFile) -> Samples:
    asked = source.problem.layout()
    present = {
        name: dimension
        for name, dimension in asked.columns.items()
        if any(column == name or column.startswith(f"{name}_") for column in columns.header)
    }
    return Samples.from_columns(columns, Layout(asked.joints, present))


def joints_from(q: Any, source: ProblemFile) -> Samples:
    """Joint values of a problem's arm from numbers (n,) or (N, n) in rad and mm, a frame, a file, or `Samples`.

    Raises CasacalError for numbers that do not fit the joints, SamplesError for a frame or file.
    """
    if isinstance(q, Samples):
        return q
    if isinstance(q, (str, Path)):
        return read_joints(q, source)
    if is_frame(q):
        return _joints_of(table_of_frame(q).columns, source)
    return Samples.of_joints(joint_values(q, source.problem.robot))


def predict(
    result: CalibratedArm,
    joints: Samples,
    *,
    frame: Literal["flange", "tip"] = "flange",
    nominal: bool = False,
    std: bool = False,
) -> Prediction:
    """Pose of the flange, or position of the tip with the flange's orientation, at each row.

    Args:
        result: a calibration or a truth.
        joints: rows of joint values, also as numbers, a frame or a file; columns that are absent (a reading) count as
            zero.
        frame: "flange" is `robot.pose`; "tip" is where the instrument touches.
        nominal: use nominal values instead of the estimate.
        std: whether to add standard deviations.

    Returns:
        Positions (N, 3) in mm and unit quaternions (N, 4; w, x, y, z) in the base frame, and standard deviations (N,)
        in mm where asked for. The quaternions are those of the flange for both frames.

    Raises CasacalError for standard deviations of the nominal arm, of a result that holds no covariance, or of one that
    is not to be used.

    """
    from scipy.spatial.transform import Rotation

    result = arm_from(result)
    joints = joints_from(joints, result.source)
    if frame not in FRAMES:
        raise UnknownNameError("frame", str(frame), FRAMES)
    problem = result.source.problem.without_effects if nominal else result.used
    model, instrument = problem.model, problem.instrument
    z = local_coordinates(result, nominal=nominal, of=problem)
    data = np.zeros((len(joints), model.pose.numel_in(2)))
    data[:, : joints.joints.shape[1]] = joints.joints
    for i, name in enumerate(instrument.columns):
        data[:, joints.joints.shape[1] + i] = joints.columns.get(name, 0.0)
    constants = row_constants(result, problem)
    poses = stacked_poses(model.batch.pose(z, constants, data)[0])
    positions = model.batch.tip(z, constants, data)[0] if frame == "tip" else poses[:, :3, 3]
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    spread = None
    if std:
        if nominal:
            raise CasacalError("The nominal arm has no standard deviation", "Leave out --nominal or --std")
        spread = _spread(result, data, frame)
    return Prediction(positions, np.roll(xyzw, 1, axis=1), spread)


def _spread(result: CalibratedArm, data: Array, frame: str) -> Array:
    """Standard deviation (N,) of the position, mm, all axes together, apart from the position of the base.

    Where it stands is what a rigid motion fitted over the workspace takes out. Effects beside the geometry that are not
    corrected count as errors, by what they do and by how well that is known.
    """
    arm, joints = moved_arm(result), len(result.source.problem.robot.axes)
    evaluate = arm.model.batch.tip_jacobian if frame == "tip" else arm.model.batch.flange_jacobian
    constants, workspace = arm.constants, workspace_joints(result.source.problem.robot)
    fields = []
    for given in (data, workspace):
        rows = np.tile(np.concatenate([np.zeros(joints), arm.elsewhere]), (len(given), 1))
        rows[:, : given.shape[1]] = given
        points, slopes = evaluate(arm.z, constants, rows)
        fields.append((slopes.reshape(3 * len(rows), arm.z.size)[:, arm.columns], points))
    stds = tip_stds(arm.covariance, up_to_base(*fields[0], *fields[1]), arm.off)
    return np.asarray(np.linalg.norm(stds, axis=1))


def write_prediction(path: str | Path, prediction: Prediction) -> None:
    """Write x_mm,y_mm,z_mm,qw,qx,qy,qz, and std_mm where there is one; one row per pose."""
    lines = ["x_mm,y_mm,z_mm,qw,qx,qy,qz" + (",std_mm" if prediction.std is not None else "")]
    for i, (place, turn) in enumerate(zip(prediction.positions, prediction.quaternions, strict=True)):
        cells = [f"{v:.6f}" for v in place] + [f"{v:.12f}" for v in turn]
        lines.append(",".join(cells if prediction.std is None else [*cells, f"{prediction.std[i]:.6f}"]))
    write_text(path, "\n".join(lines) + "\n")


@dataclass(frozen=True, eq=False)
class Moved:
    """A model of the arm with all that moves it, z (nz,) at the result, and which of z (k,) are known how well (k, k).

    off: by how much these (k,) are elsewhere than the arm is said to be. elsewhere: columns of a row at any posture.
    constants: c (nc,) of the model.
    """

    model: RowModel
    z: Array
    columns: list[int]
    covariance: Array
    off: Array | None
    elsewhere: Array
    constants: Array


def with_effects(result: CalibratedArm) -> tuple[Array, dict[str, float]] | None:
    """Covariance (n, n) of geometry and effects together, and by how much each is elsewhere than the arm is said to be.

    By name, in the order of the covariance; None where a result says nothing of effects.
    """
    said = result.discrepancy
    if "covariance" not in said:
        return None
    return numbers(said["covariance"]), dict(zip(said["covariance_of"], map(float, said["off"]), strict=True))


def all_motion(result: CalibratedArm) -> tuple[Array, list[str]]:
    """Covariance (n, n) of all that a result says of arm, cell and effects that move the tip, and their names."""
    found = with_effects(result)
    return named_covariance(result) if found is None else (found[0], list(found[1]))


def known_motion(result: CalibratedArm) -> tuple[Array, list[str]]:
    """The same of all that a result corrects and of its other unknowns.

    Raises CasacalError where it holds none.
    """
    return all_motion(result) if result.corrected else named_covariance(result)


def moved_arm(result: CalibratedArm) -> Moved:
    """All that moves the arm of a result; raises CasacalError where it holds no covariance, or of another kit."""
    problem, found = result.source.problem, with_effects(result)
    covariance, columns = covariance_of(result)
    if found is None:
        index = [j for _, j in columns]
        model, z = problem.model, local_coordinates(result, of=problem)
        elsewhere, constants = np.zeros(len(model.names)), row_constants(result, problem)
        return Moved(model, z, [i for i, _ in columns], covariance[np.ix_(index, index)], None, elsewhere, constants)
    model, site = problem.with_kit.model, Site(problem.robot, problem.instrument)
    names = [name for key, unknown in model.unknowns.items() for name in unknown.names(key)]
    lost = sorted({each["name"] for each in result.discrepancy["unknowns"]} - set(names))
    if lost:
        what = f"{result.file}: it holds an effect beside the geometry ('{lost[0]}') that the problem does not have"
        raise CasacalError(what, "Give the problem that it was calibrated with, or calibrate again")
    whole, off = found
    places = {name: j for j, name in enumerate(off)}
    at = [i for i, name in enumerate(names) if name in places]
    index = [places[names[i]] for i in at]
    known = dict.fromkeys(model.names, 0.0)
    for effect in model.effects:
        known |= effect.away(site)
    return Moved(
        model,
        local_coordinates(result, of=problem.with_kit),
        at,
        whole[np.ix_(index, index)],
        np.array([off[names[i]] for i in at]),
        np.array(list(known.values())),
        row_constants(result, problem.with_kit),
    )

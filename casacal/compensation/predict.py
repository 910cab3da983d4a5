"""Where a calibrated (or true, or nominal) robot is at given joint values, and how well that is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import FRAMES, CalibratedArm, local_coordinates, row_constants
from casacal.compensation.result_file import arm_from
from casacal.compensation.spread import RowZeros, position_stds
from casacal.compensation.told import NOTHING, TellingColumns, whole_rows
from casacal.errors import CasacalError, UnknownNameError
from casacal.files import MADE, write_text
from casacal.kinematics import quaternions_of, stacked_poses, turns_of
from casacal.problem.problem_file import ProblemFile
from casacal.robots.robot import joint_values
from casacal.samples.samples import Layout, Samples
from casacal.tables.read import is_frame, read_columns, table_of_frame
from casacal.values import Value, frozen


@dataclass(frozen=True, eq=False)
class Prediction(Value):
    """Positions (N, 3; mm) and unit quaternions (N, 4; w, x, y, z, w >= 0) in the base frame.

    `std` (N,) is the standard deviation of the position, mm, its three axes together, apart from where the base
    stands; or None. unseen: sessions for which a dial was set to zero that the result has not seen: taken as not moved.
    missing: by the words of an effect that columns tell, those of them that the rows lack, so that it is not corrected.
    beyond: a sentence for each such column that is far from what it was in the fitted rows. denial: the verdict
    where it is not to use the result, and these numbers were asked for all the same; else None.
    """

    positions: Array
    quaternions: Array
    std: Array | None = None
    unseen: tuple[str, ...] = ()
    missing: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    beyond: tuple[str, ...] = ()
    denial: str | None = None

    def __post_init__(self) -> None:
        frozen((self.positions, self.quaternions, self.std))

    @property
    def poses(self) -> Array:
        """Poses as transforms (N, 4, 4), mm."""
        poses = np.tile(np.eye(4), (len(self.positions), 1, 1))
        poses[:, :3, :3] = turns_of(self.quaternions)
        poses[:, :3, 3] = self.positions
        return poses

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        spread = "" if self.std is None else f", standard deviation up to {self.std.max(initial=0.0):.3g} mm"
        against = "" if self.denial is None else ", against the verdict"
        return f"<{len(self)} predicted poses{spread}{against}>"


def joints_from(q: Any, source: ProblemFile) -> Samples:
    """Joint values of a problem's arm from numbers (n,) or (N, n) in rad and mm, a frame, a file, or `Samples`.

    Of a frame or file also those of the instrument's columns that it has. Raises CasacalError for numbers that do not
    fit the joints, SamplesError for a frame or file.
    """
    if isinstance(q, Samples):
        return q
    if not isinstance(q, (str, Path)) and not is_frame(q):
        return Samples.of_joints(joint_values(q, source.problem.robot))
    columns = read_columns(q) if isinstance(q, (str, Path)) else table_of_frame(q).columns
    asked, probe = source.problem.layout(), source.problem.instrument.probe
    present = {
        name: dimension
        for name, dimension in asked.columns.items()
        if any(column == name or column.startswith(f"{name}_") for column in columns.header)
    }
    zero = tuple(name for name in columns.header if probe is not None and name == probe.zero_label)
    return Samples.from_columns(columns, Layout(asked.joints, present, zero, further=asked.further))


def predict(
    result: CalibratedArm,
    joints: Samples | Any,
    *,
    frame: Literal["flange", "tip"] = "flange",
    nominal: bool = False,
    std: bool = False,
    force: bool = False,
) -> Prediction:
    """Pose of the flange, or position of the tip with the flange's orientation, at each row.

    Args:
        result: a calibration or a truth.
        joints: rows of joint values, also as numbers, a frame or a file; columns that are absent (a reading) count as
            zero. An effect that further columns tell (torques, a payload) is corrected by
            these, and where they lack them as in the fitted rows on average, which the standard deviations count.
        frame: "flange" is `robot.pose`; "tip" is where the instrument touches. Where a dial was set to zero anew for
            each session, the tip is that of the row's session; of rows that name none, and have no reading, it is the
            tool's point as the problem declares it.
        nominal: use nominal values instead of the estimate.
        std: whether to add standard deviations.
        force: take a result whose verdict is not to use it.

    Returns:
        Positions (N, 3) in mm and unit quaternions (N, 4; w, x, y, z) in the base frame, and standard deviations (N,)
        in mm where asked for. The quaternions are those of the flange for both frames.

    Raises RefusedResultError for a result that is not to be used, unless forced. Raises CasacalError for standard
    deviations of the nominal arm, of a result that holds no covariance, or of one that is not to be used, and for
    readings of a dial of which no row says when it was set to zero.

    """
    result = arm_from(result)
    joints = joints_from(joints, result.source)
    if frame not in FRAMES:
        raise UnknownNameError("frame", str(frame), FRAMES)
    denial = None if nominal else result.denial
    result.check_usable(force=force or nominal)
    told = NOTHING if nominal else TellingColumns.by(result, joints)
    problem = result.source.problem.without_terms if nominal else result.used
    model, instrument = problem.model, problem.instrument
    z = local_coordinates(result, nominal=nominal, of=problem)
    n = joints.joints.shape[1]
    read = {name: joints.columns[name] for name in instrument.columns if name in joints.columns}
    data = whole_rows(joints.joints, n, model.names, {**read, **told.columns})
    known, constants = n + len(instrument.columns) + len(instrument.known_columns), row_constants(result, problem)
    poses = stacked_poses(model.batch.pose(z, constants, data)[0])
    positions = model.batch.tip(z, constants, data)[0] if frame == "tip" else poses[:, :3, 3]
    found, unseen = result.found.values(alone=not model.terms), tuple[str, ...]()
    zeros = RowZeros.of(instrument, joints, found) if frame == "tip" else None
    if zeros is not None and not nominal:
        unseen = tuple(dict.fromkeys(name.partition(".")[2] for name in zeros.names if name not in found))
        shifts = np.array([[found.get(name, 0.0)] for name in zeros.names])
        positions = positions + shifts * zeros.sign * model.batch.plunger(z, constants, data)[0]
    if std and nominal:
        raise CasacalError("The nominal arm has no standard deviation", "Leave out --nominal or --std")
    spread = position_stds(result, data[:, :known], frame, zeros, told) if std else None
    return Prediction(positions, quaternions_of(poses[:, :3, :3]), spread, unseen, told.missing, told.beyond, denial)


def write_prediction(path: str | Path, prediction: Prediction, remarks: Sequence[str] = ()) -> None:
    """Write x_mm,y_mm,z_mm,qw,qx,qy,qz, and std_mm where there is one, below lines with remarks and any denial."""
    said = " ".join(" ".join((f"predicted, {MADE}: poses in the base frame.", *remarks)).split())
    lines = [f"# {said}"]
    lines += [] if prediction.denial is None else [f"# WARNING, against the verdict: {prediction.denial}"]
    lines += ["x_mm,y_mm,z_mm,qw,qx,qy,qz" + (",std_mm" if prediction.std is not None else "")]
    for i, (place, turn) in enumerate(zip(prediction.positions, prediction.quaternions, strict=True)):
        cells = [f"{v:.6f}" for v in place] + [f"{v:.12f}" for v in turn]
        lines.append(",".join(cells if prediction.std is None else [*cells, f"{prediction.std[i]:.6f}"]))
    write_text(path, "\n".join(lines) + "\n")

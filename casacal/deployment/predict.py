"""`casacal predict`: where the calibrated tip is at given joint values, with standard deviations."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from casacal.data.archives import table_of_frame
from casacal.data.samples import Layout, Samples, is_frame, read_columns
from casacal.deployment.arm import (
    FRAMES,
    NO_COLUMNS,
    NOTHING,
    CalibratedArm,
    TellingColumns,
    all_motion,
    local_coordinates,
    row_constants,
    whole_rows,
    with_effects,
)
from casacal.deployment.result_file import arm_from
from casacal.errors import CasacalError, UnknownNameError
from casacal.files import MADE, write_text
from casacal.model.instrument import Instrument
from casacal.model.kinematics import quaternions_of, stacked_poses, turns_of
from casacal.model.problem_file import ProblemFile
from casacal.model.robot import joint_values, refuse_open
from casacal.model.term import Site
from casacal.model.trace import RowModel
from casacal.uncertainty.tip_error import tip_stds, up_to_base, workspace_joints
from casacal.values import Array, Value, frozen
from casacal.wording import figures


@dataclass(frozen=True, eq=False)
class Moved:
    """A model of the arm with all that moves it, z (nz,) at the result, and the covariance (k, k) of some of z (k,).

    names: of these (k,). off: by how much these (k,) are elsewhere than the arm is said to be. elsewhere: columns of a
    row at any posture. constants: c (nc,) of the model.
    """

    model: RowModel
    z: Array
    columns: list[int]
    names: list[str]
    covariance: Array
    off: Array | None
    elsewhere: Array
    constants: Array


def moved_arm(result: CalibratedArm) -> Moved:
    """All that moves the arm of a result; raises CasacalError without a covariance, and for effects of another kit."""
    problem, effects = result.source.problem, with_effects(result)
    problem = problem if effects is None else result.with_its_kit(problem)
    model, away = problem.model, dict.fromkeys(problem.model.names, 0.0)
    names = [name for key, unknown in problem.symbols.unknowns.items() for name in unknown.names(key)]
    if effects is not None:
        if lost := sorted(set(result.found.effects.values) - set(names)):
            what = f"{result.file}: it holds an effect beside the geometry ('{lost[0]}') that the problem does not have"
            raise CasacalError(what, "Give the problem that it was calibrated with, or calibrate again")
        for effect in model.terms:
            away |= effect.away(Site(problem.robot, problem.instrument))
        away |= {name: value for name, value in result.found.effects.usual.items() if name in away}
    covariance, known = all_motion(result)
    at = [i for i, name in enumerate(names) if name in known]
    found = [names[i] for i in at]
    index = [known.index(name) for name in found]
    off = None if effects is None else np.array([effects[1][name] for name in found])
    z, constants = local_coordinates(result, of=problem), row_constants(result, problem)
    elsewhere = np.array(list(away.values()))
    return Moved(model, z, at, found, covariance[np.ix_(index, index)], off, elsewhere, constants)


@dataclass(frozen=True)
class RowZeros:
    """The dial's zero of each row: name of its unknown, the dial's sign, the prior of any zero, mm."""

    names: list[str]
    sign: int
    prior_std: float

    @staticmethod
    def of(instrument: Instrument, joints: Samples, known: Collection[str]) -> RowZeros | None:
        """Zeros of rows that name their sessions; None where they name none, or the zero was set once.

        known: unknowns that a result has. One of rows that named no session knows one zero, which is that of all rows.
        Raises CasacalError for readings of which nothing says when the dial was set.
        """
        probe = instrument.probe
        if probe is None or probe.zero is None or probe.zero_label is None:
            return None
        labels: Sequence[str] | None = joints.labels.get(probe.zero_label)
        read = probe.column in joints.columns  # without a reading, the tip is the tool's point as it was declared
        if labels is None and read and f"{probe.zero}.{probe.zero_label}" in known:  # as rows without the column are
            labels = [probe.zero_label] * len(joints)
        if labels is not None:
            prior = float(instrument.unknowns[probe.zero].prior_stds[0])
            return RowZeros([f"{probe.zero}.{label}" for label in labels], probe.sign, prior)
        if not read:
            return None
        what = f"The dial was set to zero anew for each {probe.zero_label}, and the rows do not say for which"
        fix = f"Add the column '{probe.zero_label}', or leave out the reading, or ask for the flange"
        raise CasacalError(what, fix)


def position_stds(
    result: CalibratedArm, data: Array, frame: str, zeros: RowZeros | None, extra: TellingColumns = NOTHING
) -> Array:
    """Standard deviation (N,) of the position, mm, all axes together, apart from the pose of the base.

    A rigid motion fitted over the workspace is taken out for the base. Effects beside the geometry that are not
    corrected count as errors, by their size and its uncertainty. extra: columns that drive effects; one that stands at
    its mean is off by its standard deviation in the fitted rows.
    """
    arm, joints = moved_arm(result), workspace_joints(result.source.problem.robot)
    names, n = arm.model.names, joints.shape[1]
    data = whole_rows(data, n, names, extra.columns, arm.elsewhere)
    joints = whole_rows(joints, n, names, NO_COLUMNS, arm.elsewhere)
    squares, sign = np.zeros(len(data)), 0 if zeros is None else zeros.sign
    whole, known = all_motion(result)
    workspace = _field(arm, joints, frame, sign)
    for zero in [None] if zeros is None else dict.fromkeys(zeros.names):
        covariance, off, rows = arm.covariance, arm.off, np.ones(len(data), dtype=bool)
        if zeros is not None:  # a dial's zero as well as the result knows it, or else as its prior does
            at = [known.index(each) for each in (*arm.names, zero) if each in known]
            covariance = np.diag([*np.zeros(len(arm.names)), zeros.prior_std**2])
            covariance[: len(at), : len(at)] = whole[np.ix_(at, at)]
            off, rows = None if arm.off is None else np.append(arm.off, 0.0), np.array(zeros.names) == zero
        moves = up_to_base(*_field(arm, data[rows], frame, sign), *workspace)
        squares[rows] = (tip_stds(covariance, moves, off) ** 2).sum(axis=1)
    for name, deviation in extra.deviations.items():
        moved = data.copy()
        moved[:, n + list(names).index(name)] += deviation
        squares += ((_field(arm, moved, frame)[1] - _field(arm, data, frame)[1]) ** 2).sum(axis=1)
    return np.sqrt(squares)


def _field(arm: Moved, rows: Array, frame: str, sign: int = 0) -> tuple[Array, Array]:
    """Moves of positions (3 N, k) by what moves the arm, with a sign also by the dial's zero, and the positions."""
    batch = arm.model.batch
    points, slopes = batch("tip_jacobian" if frame == "tip" else "flange_jacobian")(arm.z, arm.constants, rows)
    field = slopes.reshape(3 * len(rows), arm.z.size)[:, arm.columns]
    if sign:
        field = np.column_stack([field, sign * batch("plunger")(arm.z, arm.constants, rows)[0].ravel()])
    return field, points


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
        spread = "" if self.std is None else f", standard deviation up to {figures(self.std.max(initial=0.0))} mm"
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
    required, probe = source.problem.layout(), source.problem.instrument.probe
    present = {
        name: dimension
        for name, dimension in required.columns.items()
        if any(column == name or column.startswith(f"{name}_") for column in columns.header)
    }
    zero = tuple(name for name in columns.header if probe is not None and name == probe.zero_label)
    return Samples.from_columns(columns, Layout(required.joints, present, zero, further=required.further))


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
        in mm where asked for, NaN where the flange's error is not known (`CalibratedArm.flange_known`). The quaternions
        are those of the flange for both frames.

    Raises RefusedResultError for a result that is not to be used, unless forced. Raises CasacalError for standard
    deviations of the nominal arm, of a result that holds no covariance, or of one that is not to be used, and for
    readings of a dial of which no row says when it was set to zero. Raises SamplesError for rows in which a loop of
    the arm does not close.

    """
    result = arm_from(result)
    joints = joints_from(joints, result.source)
    if frame not in FRAMES:
        raise UnknownNameError("frame", str(frame), FRAMES)
    denial = None if nominal else result.denial
    result.check_usable(force=force or nominal)
    extra = NOTHING if nominal else TellingColumns.by(result, joints)
    problem = result.source.problem.without_terms if nominal else result.used
    model, instrument = problem.model, problem.instrument
    z = local_coordinates(result, nominal=nominal, of=problem)
    n = joints.joints.shape[1]
    read = {name: joints.columns[name] for name in instrument.columns if name in joints.columns}
    data = whole_rows(joints.joints, n, model.names, {**read, **extra.columns})
    known, constants = n + len(instrument.columns) + len(instrument.known_columns), row_constants(result, problem)
    poses = stacked_poses(model.batch("pose")(z, constants, data)[0])
    refuse_open(problem.robot, joints, np.isfinite(poses).all(axis=(1, 2)))
    positions = model.batch("tip")(z, constants, data)[0] if frame == "tip" else poses[:, :3, 3]
    found, unseen = result.found.values(alone=not model.terms), tuple[str, ...]()
    zeros = RowZeros.of(instrument, joints, found) if frame == "tip" else None
    if zeros is not None and not nominal:
        unseen = tuple(dict.fromkeys(name.partition(".")[2] for name in zeros.names if name not in found))
        shifts = np.array([[found.get(name, 0.0)] for name in zeros.names])
        positions = positions + shifts * zeros.sign * model.batch("plunger")(z, constants, data)[0]
    if std and nominal:
        raise CasacalError("The nominal arm has no standard deviation", "Leave out --nominal or --std")
    spread = position_stds(result, data[:, :known], frame, zeros, extra) if std else None
    if spread is not None and frame == "flange" and not result.flange_known:
        spread = np.full_like(spread, np.nan)
    return Prediction(positions, quaternions_of(poses[:, :3, :3]), spread, unseen, extra.missing, extra.beyond, denial)


def write_prediction(path: str | Path, prediction: Prediction, remarks: Sequence[str] = ()) -> None:
    """Write x_mm,y_mm,z_mm,qw,qx,qy,qz, and std_mm where there is one, below lines with remarks and any denial."""
    said = " ".join(" ".join((f"predicted, {MADE}: poses in the base frame.", *remarks)).split())
    lines = [f"# {said}"]
    lines += [] if prediction.denial is None else [f"# WARNING, against the verdict: {prediction.denial}"]
    lines += ["x_mm,y_mm,z_mm,qw,qx,qy,qz" + (",std_mm" if prediction.std is not None else "")]
    for i, (place, turn) in enumerate(zip(prediction.positions, prediction.quaternions, strict=True)):
        cells = [f"{v:.6f}" for v in place] + [f"{v:.12f}" for v in turn]
        lines.append(
            ",".join(cells if prediction.std is None else [*cells, f"{prediction.std[i]:.6f}".replace("nan", "")])
        )
    write_text(path, "\n".join(lines) + "\n")

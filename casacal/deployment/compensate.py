"""`casacal compensate`: joint targets that put the calibrated tip where it was meant to be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from casacal.data.archives import table_of_frame
from casacal.data.columns import Dimension
from casacal.data.samples import Layout, Samples, is_frame, match_columns, read_any_table, read_further, taken_from
from casacal.data.text import Table
from casacal.deployment.arm import (
    FRAMES,
    CalibratedArm,
    TellingColumns,
    local_coordinates,
    named_covariance,
    row_constants,
)
from casacal.deployment.inverse_kinematics import PosedArm, postures, turning
from casacal.deployment.predict import predict
from casacal.deployment.result_file import arm_from
from casacal.errors import CasacalError, SamplesError, UnknownNameError, came
from casacal.model.kinematics import turns_of
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.model.robot import joint_units, joint_values
from casacal.values import EMPTY, Array, FrozenMapping, Rows, Value, frozen

PLACE, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
POSE: Mapping[str, Dimension] = FrozenMapping({**dict.fromkeys(PLACE, "length"), **dict.fromkeys(QUATERNION, "number")})

NAMES = ("name", "id", "target", "point")
"""Columns of targets that only say which is which, and stand in the answer as well."""
UNIT_LENGTH = 1e-3  # how far a quaternion may be from unit length: more than rounding leaves is a mistake


@dataclass(frozen=True, eq=False)
class Targets(Value):
    """Rows of targets: `joints` (N, n; rad, mm), `poses` as positions (N, 3; mm) and rotations (N, 3, 3), or both.

    With poses, joints only name the branch to take. lines, text: each row's line in its file, and the row itself.
    extra: further columns, as of `Samples`, such as torques. names: text by column that says which target is which.
    """

    joints: Array | None
    poses: tuple[Array, Array] | None
    lines: tuple[int, ...]
    text: tuple[str, ...]
    file: str
    sha256: str
    extra: Mapping[str, Array | tuple[str, ...]] = field(default_factory=dict)
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lines)

    def __repr__(self) -> str:
        return f"<{len(self)} targets of {self.file}: {'poses' if self.poses is not None else 'joint values'}>"

    @staticmethod
    def of(samples: Samples) -> Targets:
        """Joint targets from samples, or from any joint values that `Samples` can hold."""
        text = tuple(",".join(f"{value:.9g}" for value in row) for row in samples.joints)
        return Targets(samples.joints, None, tuple(samples.lines), text, samples.file, samples.sha256, samples.extra)

    @staticmethod
    def of_poses(poses: Array) -> Targets:
        """Pose targets (N, 4, 4; mm); raises CasacalError for what is no rigid transform."""
        if poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
            raise CasacalError(f"Poses came with the shape {poses.shape}", "Give finite transforms (N, 4, 4) in mm")
        turns = poses[:, :3, :3]
        orthonormal = np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=UNIT_LENGTH)
        if not orthonormal or (np.linalg.det(turns) < 0).any():
            raise CasacalError(
                "A target's rotation matrix is not orthonormal and right-handed", "Give a rigid transform"
            )
        text = tuple(" ".join(f"{value:.9g}" for value in pose[:3].ravel()) for pose in poses)
        lines = tuple(range(1, len(poses) + 1))
        return Targets(None, (poses[:, :3, 3], turns), lines, text, "poses", "")


def read_targets(path: str | Path, source: ProblemFile | Problem) -> Targets:
    """Read joint targets (q1_deg, ... as in samples) or poses (x_mm,y_mm,z_mm,qw,qx,qy,qz as `predict` writes them).

    A file with a column qw holds poses; joint columns beside them then name the branch. Raises SamplesError, and
    CasacalError for what is no path or no problem.
    """
    if not isinstance(path, (str, Path)):
        raise CasacalError(f"Got {came(path)} as the path of targets", "Give a path")
    source = ProblemFile.of(source) if isinstance(source, Problem) else source
    if not isinstance(source, ProblemFile):
        raise CasacalError(f"Got {came(source)} as the problem", "Give a Problem, or what load_problem returns")
    return _of_table(read_any_table(path), source)


def targets_from(targets: Any, source: ProblemFile) -> Targets:
    """Targets from joint values (N, n; rad, mm), poses (N, 4, 4; mm), a frame, a file, `Samples` or `Targets`.

    Raises CasacalError for numbers that are neither, SamplesError for a frame or file.
    """
    if isinstance(targets, Targets):
        return targets
    if isinstance(targets, Samples):
        return Targets.of(targets)
    if isinstance(targets, (str, Path)):
        return read_targets(targets, source)
    if is_frame(targets):
        return _of_table(table_of_frame(targets), source)
    if np.ndim(targets) == 3 or np.shape(targets) == (4, 4):
        return Targets.of_poses(np.asarray(targets, dtype=np.float64).reshape(-1, *np.shape(targets)[-2:]))
    return Targets.of(Samples.of_joints(joint_values(targets, source.problem.robot)))


def _of_table(table: Table, source: ProblemFile) -> Targets:
    required, probe = source.problem.layout(), source.problem.instrument.probe
    if probe is not None and probe.zero_label in table.header:
        what = f"targets cannot be of one {probe.zero_label}: the tip is the tool's point as the problem declares it"
        fix = "Leave out this column, or give targets of the flange without it"
        raise SamplesError(table.file, what, fix, column=probe.zero_label)
    posed = "qw" in table.header
    jointed = not posed or any(name.startswith("q1_") for name in table.header)
    joints = Samples.from_table(table, Layout(required.joints, EMPTY)).joints if jointed else None
    layout = Layout(required.joints if jointed else (), POSE if posed else EMPTY, further=required.further)
    text = tuple(",".join(row) for row in table.rows)
    extra = FrozenMapping(read_further(table.columns, layout))
    names = FrozenMapping({name: tuple(table.column(name)) for name in table.header if name.lower() in NAMES})
    if not posed:
        return Targets(joints, None, table.lines, text, table.file, table.sha256, extra, names)
    found = match_columns(table.columns, layout)
    numbers = {name: np.array(table.numbers(column)) * factor for name, (column, factor) in found.items()}
    positions, wxyz = (np.column_stack([numbers[name] for name in part]) for part in (PLACE, QUATERNION))
    lengths = np.linalg.norm(wxyz, axis=1)
    for i in np.flatnonzero(np.abs(lengths - 1) > UNIT_LENGTH)[:1]:
        fix = "Give a unit quaternion qw,qx,qy,qz"
        raise SamplesError(table.file, f"the quaternion has the length {lengths[i]:.6g}", fix, line=table.lines[i])
    return Targets(joints, (positions, turns_of(wxyz)), table.lines, text, table.file, table.sha256, extra, names)


def rows_with(targets: Targets, which: NDArray[np.intp], joints: Array) -> Samples:
    """Joint values (M, n) for some targets (M,), with the further columns of these."""
    lines = tuple(targets.lines[i] for i in which.tolist())
    return Samples(joints, {}, {}, lines, taken_from(targets.extra, which), targets.file, targets.sha256)


class Outcome(Enum):
    """Outcome of a target: a closed set of words, each with a sentence that says what it means."""

    meaning: str

    REACHED = "reached", "the calibrated robot takes the pose"
    LIMIT = "at a joint limit", "a joint would have to pass its limit"
    BEYOND = "beyond the largest correction", "a joint would have to move by more than the largest correction allowed"
    SINGULAR = "singular", "near a singularity: no small joint motion takes the pose"
    UNREACHABLE = "unreachable", "no posture takes the pose"
    OUTSIDE = "outside the joint limits", "the target's own joint values are outside the limits"
    NOT_FINITE = "not finite", "the model gives values that are not finite"

    def __new__(cls, word: str, meaning: str) -> Outcome:
        """A word of the set, as its value."""
        made = object.__new__(cls)
        made._value_, made.meaning = word, meaning
        return made


@dataclass(frozen=True)
class Rounding:
    """Format of written joint values: in degrees (else radians; sliding joints in mm), with a number of decimals."""

    degrees: bool = True
    decimals: int = 7

    def __call__(self, arm: PosedArm, joints: Array) -> Array:
        """Joint values as a reader of the file gets them; inside the limits where they were."""
        unit, turn = 10.0**-self.decimals, 180 / math.pi if self.degrees else 1.0
        factors = np.where(arm.robot.revolute, turn, 1.0)  # from rad and mm to what is written
        lower, upper = (limit * factors for limit in arm.robot.limits)
        exact, written = joints * factors, np.round(joints * factors, self.decimals)
        written -= unit * ((written > upper + 1e-9 * unit) & (exact <= upper))
        written += unit * ((written < lower - 1e-9 * unit) & (exact >= lower))
        return np.asarray(np.round(written, self.decimals) / factors)


@dataclass(frozen=True, eq=False, repr=False)
class Compensation(Value):
    """Corrected targets and their proof, one entry per target (N) in each field.

    joints: corrected (N, n; rad, mm), as written. start: nominal joint values (N, n) they began from. outcomes: how
    each ended. residual_mm, residual_rad: miss of the calibrated robot at `joints`, recomputed by `predict`.
    correction_mm: miss at `start`, which the correction removes. correction: largest joint motion from `start`, rad, a
    sliding joint in mm over 300. A row that is not reached holds the nearest joint values within that motion, or its
    start where that would be a jump; NaN for a pose that no start was found for. expected_mm: standard deviation of the
    position that is left, apart from the pose of the base. missing, beyond: as of a `Prediction`.
    """

    targets: Targets
    frame: Literal["flange", "tip"]
    rounding: Rounding
    joints: Array
    start: Array
    outcomes: tuple[Outcome, ...]
    residual_mm: Array
    residual_rad: Array
    correction_mm: Array
    correction: Array
    expected_mm: Array
    missing: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    beyond: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        frozen(tuple(value for value in vars(self).values() if isinstance(value, np.ndarray)))

    def __repr__(self) -> str:
        return f"<Compensation of {len(self.outcomes)} targets: {int(self.reached.sum())} reached>"

    @property
    def reached(self) -> Rows:
        """Which rows the calibrated robot reaches."""
        return np.array([outcome is Outcome.REACHED for outcome in self.outcomes])

    def left(self, i: int) -> str:
        """Miss that remains at a row that is not reached, as the end of a sentence; empty where unknown."""
        mm, mrad = self.residual_mm[i], 1e3 * self.residual_rad[i]
        return f"; {mm:.3f} mm and {mrad:.3f} mrad remain at the {self.frame}" if math.isfinite(mm + mrad) else ""


LARGEST = math.radians(10)  # joint motion (rad, or its weight in mm) beyond which a correction is a jump
ROUNDED = 1e-6  # how far (rad, mm) the rounding of a file may put joint values beyond a limit
STEPS = 150  # at most, for rows that creep along a singularity
RETRIES, SCATTER = 3, 0.1  # further starts for rows that stuck, and how far (rad) they lie from the first


def compensate(
    result: CalibratedArm,
    targets: Targets,
    *,
    frame: Literal["flange", "tip"] = "flange",
    largest: float = LARGEST,
    rounding: Rounding | None = None,
    force: bool = False,
) -> Compensation:
    """Correct targets for a calibrated robot, all rows at once.

    Each row starts at its nominal joint values (for poses: those of the branch it names, else a posture found from many
    starts) and takes damped Newton steps on the calibrated kinematics, inside the joint limits. An arm with fewer than
    six joints keeps the position and takes the orientation as near as it goes; with more than six the joints move as
    little as the pose allows.

    Args:
        result: a calibration, or a truth.
        targets: joint values or poses, also as numbers, a frame or a file. An effect that further columns tell
            (torques, a payload) is corrected where they have these.
        frame: what poses are of: "flange" is `robot.pose`, "tip" where the instrument touches at reading zero.
        largest: joint motion (rad, or mm over 300) beyond which a row counts as a jump, not as reached.
        rounding: how the joint values will be written; the proof is about these.
        force: take a result whose verdict is not to use it; nothing is then expected of its accuracy (NaN).

    Returns:
        One entry per target (N): joint values (N, n) in rad and mm, how each ended, what the calibrated arm misses
        there in mm and rad, and the standard deviation of its position, mm.

    Raises CasacalError for a result that is not to be used or did not converge, or whose arm has directions that
    nothing holds.

    """
    result = arm_from(result)
    targets = targets_from(targets, result.source)
    if frame not in FRAMES:
        raise UnknownNameError("frame", str(frame), FRAMES)
    if not isinstance(largest, (int, float)) or not largest > 0:
        raise CasacalError(f"The largest motion of a joint is {largest!r}", "Give a positive number of rad")
    rounding, drawn = rounding or Rounding(), result.source.problem.without_terms
    nominal = PosedArm.of(drawn, local_coordinates(result, nominal=True), frame, row_constants(result, drawn))
    result.check_usable(force=force)
    refuse_untrusted(result, frame)
    still = np.zeros((len(targets), len(drawn.robot.axes)))
    extra = TellingColumns.by(result, rows_with(targets, np.arange(len(targets)), still))
    used, local = result.used, local_coordinates(result, of=result.used)
    arm = replace(nominal, local=local)
    if used.terms:
        arm = PosedArm.of(used, local, frame, row_constants(result, used), extra.columns)
    start, positions, rotations = _meant(nominal, targets)
    found: Rows = np.asarray(np.isfinite(start).all(axis=1))
    began = np.where(found[:, None], start, np.mean(nominal.robot.limits, axis=0))
    joints, elsewhere = began.copy(), np.zeros(len(began), dtype=bool)
    wanted = positions[found], rotations[found], start[found]
    joints[found], elsewhere[found] = _solved(arm.of_rows(found), *wanted, largest)
    moved = np.abs((joints - began) / joint_units(arm.robot)).max(axis=1)
    jumps: Rows = np.asarray(moved > largest)
    limited = arm.at_limit(joints, positions, rotations) & ~jumps
    beyond: Rows = jumps & (moved <= LARGEST) & arm.takes(joints, positions, rotations)
    joints = rounding(arm, np.where(jumps[:, None] | ~found[:, None], start, joints))
    miss, turn, expected = _proof(result, arm, targets, joints, positions, rotations)
    cases = (
        (~found, Outcome.UNREACHABLE),
        (~np.isfinite(miss + turn), Outcome.NOT_FINITE),
        (_outside(arm, targets), Outcome.OUTSIDE),
        (arm.within(miss, turn) & ~jumps, Outcome.REACHED),
        (limited, Outcome.LIMIT),
        (beyond, Outcome.BEYOND),
        (jumps | elsewhere, Outcome.SINGULAR),
        (np.ones(len(joints), dtype=bool), Outcome.UNREACHABLE),
    )
    ended = tuple(cases[i][1] for i in np.argmax([rows for rows, _ in cases], axis=0))  # the first that holds
    before, moved = np.linalg.norm(arm.miss(start, positions, rotations)[0], axis=1), np.where(jumps, 0.0, moved)
    return Compensation(
        targets, frame, rounding, joints, start, ended, miss, turn, before, moved, expected, extra.missing, extra.beyond
    )


def refuse_untrusted(result: CalibratedArm, frame: str) -> None:
    """Refuse a result that is no calibrated robot, unless it is forced, which the file then says."""
    if result.denial is not None:
        return
    if not result.found.converged:
        raise CasacalError(f"{result.file}: the calibration did not converge", "Calibrate again before moving a robot")
    problem = result.source.problem
    unknowns = {**problem.robot.parameters, **(problem.instrument.unknowns if frame == "tip" else {})}
    named = {name for key, unknown in unknowns.items() for name in unknown.names(key)}
    covariance, known = named_covariance(result)
    lost = [name for name, v in zip(known, np.diagonal(covariance), strict=True) if name in named and v == np.inf]
    if lost:
        shown = ", ".join(lost[:6]) + (", ..." if len(lost) > 6 else "")
        what = f"{result.file}: neither samples nor prior hold {shown}, so the estimate is arbitrary there"
        fix = f"Calibrate with a prior, such as --prior {lost[0]}=0.7 or 0.001, or hold it with --fix {lost[0]}"
        raise CasacalError(what, fix)


def _meant(nominal: PosedArm, targets: Targets) -> tuple[Array, Array, Array]:
    """Nominal joint values (NaN where none were found) and the poses that were meant."""
    if targets.poses is None:
        assert targets.joints is not None
        place, turn, _ = nominal(targets.joints)
        return targets.joints, place, turn
    positions, rotations = targets.poses
    if targets.joints is None:
        return postures(nominal, positions, rotations), positions, rotations
    start = nominal.reach(positions, rotations, targets.joints)
    return np.where(_outside(nominal, targets)[:, None], targets.joints, start), positions, rotations


def _solved(arm: PosedArm, positions: Array, rotations: Array, start: Array, largest: float) -> tuple[Array, Rows]:
    """Joint values near the start that take the poses best, and rows (N,) where only others far away take them."""
    joints = arm.reach(positions, rotations, start, steps=STEPS)
    elsewhere = np.zeros(len(joints), dtype=bool)
    rng = np.random.default_rng(0)
    for _ in range(RETRIES):  # rows that stuck, as at a singularity, from beside their start
        jumped = np.abs((joints - start) / joint_units(arm.robot)).max(axis=1) > largest
        stuck = np.flatnonzero(~arm.takes(joints, positions, rotations) & ~jumped)
        if not stuck.size:
            break
        scattered = start[stuck] + SCATTER * joint_units(arm.robot) * rng.uniform(-1, 1, (len(stuck), start.shape[1]))
        again = arm.of_rows(stuck).reach(positions[stuck], rotations[stuck], scattered, steps=STEPS)
        arrived = arm.of_rows(stuck).takes(again, positions[stuck], rotations[stuck])
        near = np.abs((again - start[stuck]) / joint_units(arm.robot)).max(axis=1) <= largest
        joints[stuck[arrived & near]] = again[arrived & near]
        elsewhere[stuck[arrived & ~near]] = True
    return joints, elsewhere


def _proof(
    result: CalibratedArm, arm: PosedArm, targets: Targets, joints: Array, positions: Array, rotations: Array
) -> tuple[Array, Array, Array]:
    """Miss (mm; rad) and standard deviation (mm) of the calibrated robot at joint values, by `predict` alone."""
    denied = result.denial is not None
    miss, turn, spread = (np.full(len(joints), np.nan) for _ in range(3))
    missed = arm.miss(joints, positions, rotations)[:2]
    sound = np.flatnonzero(np.isfinite(np.hstack(missed)).all(axis=1))
    if sound.size:
        samples = rows_with(targets, sound, joints[sound])
        # nothing is expected of a result that is not to be used
        prediction = predict(result, samples, frame=arm.frame, std=not denied, force=True)
        turns = turns_of(prediction.quaternions)
        miss[sound] = np.linalg.norm(prediction.positions - positions[sound], axis=1)
        turn[sound] = np.linalg.norm(turning(turns @ rotations[sound].transpose(0, 2, 1)), axis=1)
        spread[sound] = np.nan if denied else prediction.std
    return miss, turn, spread


def _outside(arm: PosedArm, targets: Targets) -> Rows:
    """Rows whose own joint values lie outside the limits."""
    if targets.joints is None:
        return np.zeros(len(targets), dtype=bool)
    lower, upper = arm.robot.limits
    return np.asarray(((targets.joints < lower - ROUNDED) | (targets.joints > upper + ROUNDED)).any(axis=1))

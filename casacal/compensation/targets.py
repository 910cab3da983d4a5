"""Targets to reach, as read from a file, and what became of each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array, Rows
from casacal.compensation.inverse_kinematics import PosedArm
from casacal.errors import CasacalError, SamplesError, came
from casacal.instruments.description import Dimension
from casacal.kinematics import turns_of
from casacal.problem.problem import Problem
from casacal.problem.problem_file import ProblemFile
from casacal.robots.robot import joint_values
from casacal.samples.samples import Layout, Samples, match_columns, read_further, taken_from
from casacal.tables.read import is_frame, read_any_table, table_of_frame
from casacal.tables.text import Table
from casacal.values import EMPTY, FrozenMapping, Value, frozen

PLACE, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
POSE: Mapping[str, Dimension] = FrozenMapping({**dict.fromkeys(PLACE, "length"), **dict.fromkeys(QUATERNION, "number")})

UNIT_LENGTH = 1e-3  # how far a quaternion may be from unit length: more than rounding leaves is a mistake


@dataclass(frozen=True, eq=False)
class Targets(Value):
    """Rows of targets: `joints` (N, n; rad, mm), `poses` as positions (N, 3; mm) and rotations (N, 3, 3), or both.

    With poses, joints only name the branch to take. lines, text: each row's line in its file, and the row itself.
    extra: further columns, as of `Samples`, such as torques.
    """

    joints: Array | None
    poses: tuple[Array, Array] | None
    lines: tuple[int, ...]
    text: tuple[str, ...]
    file: str
    sha256: str
    extra: Mapping[str, Array | tuple[str, ...]] = field(default_factory=dict)

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
            raise CasacalError("A target's rotation is no rotation", "Give orthonormal, right-handed transforms")
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
    asked, probe = source.problem.layout(), source.problem.instrument.probe
    if probe is not None and probe.zero_label in table.header:
        what = f"targets cannot be of one {probe.zero_label}: the tip is the tool's point as the problem declares it"
        fix = "Leave out this column, or give targets of the flange without it"
        raise SamplesError(table.file, what, fix, column=probe.zero_label)
    posed = "qw" in table.header
    jointed = not posed or any(name.startswith("q1_") for name in table.header)
    joints = Samples.from_table(table, Layout(asked.joints, EMPTY)).joints if jointed else None
    layout = Layout(asked.joints if jointed else (), POSE if posed else EMPTY, further=asked.further)
    text = tuple(",".join(row) for row in table.rows)
    extra = FrozenMapping(read_further(table.columns, layout))
    if not posed:
        return Targets(joints, None, table.lines, text, table.file, table.sha256, extra)
    found = match_columns(table.columns, layout)
    numbers = {name: np.array(table.numbers(column)) * factor for name, (column, factor) in found.items()}
    positions, wxyz = (np.column_stack([numbers[name] for name in part]) for part in (PLACE, QUATERNION))
    lengths = np.linalg.norm(wxyz, axis=1)
    for i in np.flatnonzero(np.abs(lengths - 1) > UNIT_LENGTH)[:1]:
        fix = "Give a unit quaternion qw,qx,qy,qz"
        raise SamplesError(table.file, f"the quaternion has the length {lengths[i]:.6g}", fix, line=table.lines[i])
    return Targets(joints, (positions, turns_of(wxyz)), table.lines, text, table.file, table.sha256, extra)


def rows_with(targets: Targets, which: NDArray[np.intp], joints: Array) -> Samples:
    """Joint values (M, n) for some targets (M,), with the further columns of these."""
    lines = tuple(targets.lines[i] for i in which.tolist())
    return Samples(joints, {}, {}, lines, taken_from(targets.extra, which), targets.file, targets.sha256)


class Outcome(Enum):
    """How a target ended: a closed set of words, and what each means in a sentence."""

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
    """How joint values are written: in degrees (else radians; sliding joints in mm), with so many decimals."""

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
    position that is left, apart from the position of the base. missing, beyond: as of a `Prediction`.
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

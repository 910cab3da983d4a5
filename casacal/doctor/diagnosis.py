"""Which conventions explain pendant rows: all of them, sorted into those that mean the same and those that do not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.doctor.axes import Axes, axes_of
from casacal.doctor.family import Family
from casacal.doctor.pendant_rows import ANGLES, LENGTHS, PendantRows, angle_between, rotations_of
from casacal.doctor.same_arm import MOST_MEANINGS, FurtherPose, Meaning, changes, conventions_of, distinct, further_pose
from casacal.doctor.search import Halves, poses_of
from casacal.doctor.slips import PendantSlip, slips_in
from casacal.errors import CasacalError
from casacal.robots.dh_table import DHTable
from casacal.robots.joint_space import AXIS_WEIGHT, random_joints
from casacal.robots.robot import Robot

TOLERANCE = 3.0
"""Miss (mm, and mrad) within which a row counts as explained: rounding of joints at arm's length, and no more."""
ENOUGH = 3  # different postures below which nothing counts as certain
DIFFERENT = np.radians(1.0)  # motion of a joint (rad; or mm over 300) that makes a posture a different one
REACH = 1.2
"""Fraction of the farthest random posture's distance from the base beyond which a unit of length is ruled out."""
MOST_JOINTS = 7  # joints beyond which there are more readings than a search can hold
MOST_TURNING = 25.0  # joint values beyond which a column cannot be in radians
FEW = 6  # conventions of the other rows up to which the numbers of a row are looked at one by one
WORTH_LEAVING_OUT = range(3, 13)  # numbers of rows at which each is left out in turn when no convention fits all


@dataclass(frozen=True)
class Miss:
    """How near the nearest convention comes when none fits: worst row, mm and rad."""

    mm: float
    rad: float


@dataclass(frozen=True)
class Diagnosis:
    """What pendant rows say about a controller's conventions.

    meanings: all that fit, the simplest first; empty when none does. more: whether there are more than were looked at.
    postures: how many different ones the rows hold. further: the pose that would settle it, None where nothing is open.
    nearest: how far off the best is when none fits. odd_lines: rows without which one would.
    slips: single numbers in them that, changed, would let all rows fit, the best first. convention: of a DH table,
    "standard" or "modified", in which it would fit when none does as the table is read.
    """

    rows: PendantRows
    tolerance: float
    meanings: tuple[Meaning, ...]
    more: bool
    postures: int
    further: FurtherPose | None
    nearest: Miss | None
    odd_lines: tuple[int, ...] = ()
    slips: tuple[PendantSlip, ...] = ()
    convention: str = ""

    @property
    def certain(self) -> bool:
        """Whether one meaning, with one convention of orientation, is all that fits enough rows."""
        return (
            len(self.meanings) == 1
            and not self.more
            and self.postures >= ENOUGH
            and len(self.meanings[0].rotations) == 1
        )


@dataclass(frozen=True)
class _ArmAsDrawn:
    """The arm between base and tool, and the distance (mm) from the base that rules out a unit of length."""

    axes: Axes
    halves: Halves
    base: Array
    reach: float


def diagnose(
    robot: Robot,
    rows: PendantRows,
    *,
    base: Array | None = None,
    tool: Array | None = None,
    tolerance: float = TOLERANCE,
) -> Diagnosis:
    """Find joint signs, quarter-turn offsets, couplings, units and the convention of orientation behind pendant rows.

    The arm is the robot at its nominal parameters, which is what controllers compute with. Every convention of the
    family (see `casacal.doctor.family`) is searched, in degrees and radians, mm and metres; two that give
    equal poses at all joint values count as one.

    Args:
        robot: the arm; a prismatic joint has a sign and no offset.
        rows: what the pendant shows.
        base: pose (4, 4; mm) of the robot's base in the frame in which the pendant shows poses; default: the same.
        tool: pose (4, 4; mm) in the flange frame of what the pendant shows; default: the flange.
        tolerance: mm, and mrad, within which a row counts as explained.

    Returns:
        All conventions that fit, the simplest first, whether one is certain, and, where not, the pose that would settle
        it.

    Raises CasacalError when rows and robot do not match, ProblemError for a pose that is not one motion per joint.

    """
    if rows.joints.shape[1] != len(robot.axes):
        fix = "Use its own rows"
        raise CasacalError(f"The rows have {rows.joints.shape[1]} joints and '{robot.name}' has {len(robot.axes)}", fix)
    if len(robot.axes) > MOST_JOINTS:
        fix = f"The doctor searches arms of up to {MOST_JOINTS}"
        raise CasacalError(f"'{robot.name}' has {len(robot.axes)} joints", fix)
    if not tolerance > 0:
        raise CasacalError(f"The tolerance is {tolerance:g} mm", "Give a positive number of mm")
    known = _known_arm(robot, base, tool)
    meanings, more = _meanings(known, rows, tolerance)
    if meanings:
        found = Diagnosis(rows, tolerance, meanings, more, _postures(known.axes, rows, meanings[0]), None, None)
        if found.certain:
            return found
        return replace(found, further=further_pose(known.axes, robot, meanings, tolerance, seed=len(rows)))
    if more:
        return Diagnosis(rows, tolerance, (), True, 0, None, None)
    odd, slips = _odd(known, rows, tolerance) if len(rows) in WORTH_LEAVING_OUT else ((), ())
    convention, other = "", robot.in_other_convention()
    if other is not None and isinstance(other.arm, DHTable):
        convention = other.arm.convention if _meanings(_known_arm(other, base, tool), rows, tolerance)[0] else ""
    return Diagnosis(rows, tolerance, (), False, 0, None, _nearest(known, rows), odd, slips, convention)


def _known_arm(robot: Robot, base: Array | None, tool: Array | None) -> _ArmAsDrawn:
    axes = axes_of(robot)
    if tool is not None:
        axes = replace(axes, turn=axes.turn @ tool[:3, :3], place=axes.turn @ tool[:3, 3] + axes.place)
    places = axes.poses(random_joints(robot, 500, np.random.default_rng(0)))[1]
    far = REACH * float(np.linalg.norm(places, axis=1).max())
    return _ArmAsDrawn(axes, Halves.of(axes), np.eye(4) if base is None else base, far)


def _odd(known: _ArmAsDrawn, rows: PendantRows, tolerance: float) -> tuple[tuple[int, ...], tuple[PendantSlip, ...]]:
    """Lines without which the others fit, and the single numbers in them that could be to blame."""
    lines: list[int] = []
    slips: list[PendantSlip] = []
    looked_at = True
    for i in range(len(rows)):
        meanings, more = _meanings(known, rows.without(i), tolerance)
        if not meanings:
            continue
        lines.append(rows.line(i))
        if more or len(meanings) > FEW:
            looked_at = False  # what is found elsewhere would only seem to be the only one
        else:
            slips += slips_in(known.axes, known.base, rows, i, meanings, tolerance)
    return tuple(lines), tuple(sorted(slips, key=lambda slip: slip.miss)) if looked_at else ()


def _meanings(known: _ArmAsDrawn, rows: PendantRows, tolerance: float) -> tuple[tuple[Meaning, ...], bool]:
    """All meanings that fit the rows, the simplest first, and whether more would."""
    meanings: list[Meaning] = []
    more = False
    for joint_unit, length_unit, q, positions in _guesses(known, rows):
        orientations = {name: known.base[:3, :3].T @ shown for name, shown in rotations_of(rows.orientations).items()}
        readings, left_aside = known.halves.fitting(q, positions, orientations.values(), tolerance)
        more |= left_aside
        if not len(readings):
            continue
        turn, place = poses_of(known.axes, readings, q)
        miss_mm = np.linalg.norm(place - positions, axis=2).max(axis=1)
        misses = {name: angle_between(turn, shown).max(axis=1) for name, shown in orientations.items()}
        fits = np.flatnonzero(np.min(list(misses.values()), axis=0) <= tolerance * 1e-3)
        groups = distinct(known.axes, readings.take(fits))
        more |= len(groups) == MOST_MEANINGS
        for group in groups:
            same = fits[group]
            written = sorted(
                {c for i in same if (c := conventions_of(readings.options[i], known.axes.mixing)) is not None},
                key=changes,
            )
            first = same[int(np.argmin(readings.take(same).changes))]
            rotations = {name: float(miss[first]) for name, miss in misses.items() if miss[first] <= tolerance * 1e-3}
            if written:
                reading, worst = readings.options[first], float(miss_mm[first])
                meanings.append(Meaning(tuple(written), reading, joint_unit, length_unit, rotations, worst))
    stated = {(rows.joint_unit or "deg", rows.length_unit or "mm")}
    meanings.sort(key=lambda m: ((m.joint_unit, m.length_unit) not in stated, changes(m.simplest)))
    return tuple(meanings), more


def _guesses(known: _ArmAsDrawn, rows: PendantRows) -> Iterator[tuple[str, str, Array, Array]]:
    """Units that the rows may be in, with joint values in rad and mm and positions in mm in the robot's base frame."""
    turns = np.array(known.axes.turns)
    for length_unit, length in LENGTHS.items():
        positions = (rows.positions * length - known.base[:3, 3]) @ known.base[:3, :3]
        if np.linalg.norm(positions, axis=1).max() > known.reach:
            continue
        for joint_unit, angle in ANGLES.items():
            if joint_unit == "rad" and np.abs(rows.joints[:, turns]).max(initial=0.0) > MOST_TURNING:
                continue
            yield joint_unit, length_unit, rows.joints * np.where(turns, angle, length), positions


def _nearest(known: _ArmAsDrawn, rows: PendantRows) -> Miss | None:
    """How near the best reading comes; None when the positions are out of the arm's reach in any unit."""
    best: Miss | None = None
    for _, _, q, positions in _guesses(known, rows):
        readings: Family = known.halves.nearest(q, positions)
        turn, place = poses_of(known.axes, readings, q)
        mm = np.linalg.norm(place - positions, axis=2).max(axis=1)
        shown = rotations_of(rows.orientations).values()
        rad = np.min([angle_between(turn, known.base[:3, :3].T @ each).max(axis=1) for each in shown], axis=0)
        i = int(np.argmin(mm + AXIS_WEIGHT * rad))
        if best is None or mm[i] + AXIS_WEIGHT * rad[i] < best.mm + AXIS_WEIGHT * best.rad:
            best = Miss(float(mm[i]), float(rad[i]))
    return best


def _postures(axes: Axes, rows: PendantRows, meaning: Meaning) -> int:
    """How many rows differ from all before them in some joint."""
    scale = np.where(axes.turns, ANGLES[meaning.joint_unit], LENGTHS[meaning.length_unit] / AXIS_WEIGHT)
    kept: list[Array] = []
    for joints in rows.joints * scale:
        if all(np.abs(joints - other).max() > DIFFERENT for other in kept):
            kept.append(joints)
    return len(kept)

"""Which conventions explain pendant rows: those that mean the same, those that do not, and how to tell them apart."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.doctor.pendant_rows import ANGLES, LENGTHS, PendantRows, angle_between, rotations_as, rotations_of
from casacal.doctor.search import Halves, Integers, one_change_away, poses_of, settings_changed
from casacal.errors import CasacalError
from casacal.model.axes import Axes, axes_of
from casacal.model.dh_table import DHTable
from casacal.model.joints import Conventions
from casacal.model.robot import AXIS_WEIGHT, Robot, inside_limits, random_joints
from casacal.values import Array, Index

SAME = 1e-6  # difference (mm; rad) at random joint values below which two conventions are one
COMPARED = 24  # random joint values at which they are compared
MOST_MEANINGS = 48  # different meanings that are told apart; when more fit, the rows say next to nothing


@dataclass(frozen=True)
class Meaning:
    """One meaning of the controller's joint values, and all ways to write it that fit the rows.

    conventions: the simplest first. reading: one of them as the search has it (n, 4). joint_unit, length_unit: of the
    numbers shown. rotations: which conventions of the orientation do the rows, with the worst miss, rad. miss_mm: of
    the positions, the worst.
    """

    conventions: tuple[Conventions, ...]
    reading: Integers
    joint_unit: str
    length_unit: str
    rotations: Mapping[tuple[str, str], float]
    miss_mm: float

    @property
    def simplest(self) -> Conventions:
        """The way to write it with the fewest changes from plain."""
        return self.conventions[0]


def distinct(axes: Axes, options: Integers) -> list[Index]:
    """Indices of the readings (H, n, 4) of each meaning, at most `MOST_MEANINGS` of them, by random joint values."""
    if not len(options):
        return []
    spread = np.where(axes.turns, np.pi, 500.0)
    q = np.random.default_rng(0).uniform(-spread, spread, (COMPARED, len(spread)))
    turn, place = poses_of(axes, options, q)
    signatures = np.concatenate([turn.reshape(len(options), -1), place.reshape(len(options), -1)], axis=1)
    groups: list[Index] = []
    left = np.arange(len(options))
    while left.size and len(groups) < MOST_MEANINGS:
        same = np.abs(signatures[left] - signatures[left[0]]).max(axis=1) < SAME
        groups.append(left[same])
        left = left[~same]
    return groups


def conventions_of(reading: Integers, mixing: Array) -> Conventions | None:
    """A reading (n, 4) as `Conventions` of the robot's own joint values; None where it has no such form.

    mixing: what the robot's pose does to its joint values (n, n), the identity but for a pose that couples joints.
    """
    sign, quarter, partner, factor = reading.astype(int).T
    n = len(reading)
    matrix = np.diag(sign).astype(np.float64)
    for i in np.flatnonzero(partner >= 0):
        matrix[i, partner[i]] = sign[i] * factor[i]
    matrix = np.round(np.linalg.solve(mixing, matrix))
    if (np.abs(np.diagonal(matrix)) != 1).any():
        return None
    signs = np.diagonal(matrix).astype(int)
    turned = np.round(np.linalg.solve(mixing, quarter.astype(np.float64)))
    quarters = 2 - (2 - turned) % 4  # of all that mean the same, -1, 0, 1 or 2
    couplings = [(i, j) for i in range(n) for j in range(n) if i != j and matrix[i, j]]
    return Conventions(
        tuple(int(s) for s in signs),
        tuple(float(k) * np.pi / 2 for k in quarters),
        tuple((i + 1, j + 1, float(matrix[i, j] * signs[i])) for i, j in couplings),
    )


def changes(conventions: Conventions) -> tuple[int, int, float, tuple[float, ...]]:
    """Sort key of the distance from plain conventions: settings changed, couplings, size of offsets, their order."""
    shifted = [offset for offset in conventions.offsets if abs(offset) > 1e-9]
    changed = sum(sign < 0 for sign in conventions.signs) + len(shifted) + len(conventions.coupling)
    size = float(sum(abs(offset) for offset in shifted))
    return changed, len(conventions.coupling), size, (*(-s for s in conventions.signs), *conventions.offsets)


TRIED = 300  # random postures among which the most telling one is chosen
SEPARATED = 5.0  # multiples of the tolerance by which a posture must separate two conventions


@dataclass(frozen=True)
class FurtherPose:
    """Joint values to move to, as the controller shows them (n,), in the joint unit of the simplest meaning.

    separates: part of the pairs of conventions that it tells apart. least_mm, least_rad: what its least different pair
    differs by, the larger of the two in units of the tolerance.
    """

    joints: Array
    separates: float
    least_mm: float
    least_rad: float


def further_pose(
    axes: Axes, robot: Robot, meanings: Sequence[Meaning], tolerance: float, *, seed: int = 0
) -> FurtherPose:
    """The random posture, inside the joint limits as far as they are known, that separates the meanings most.

    A single meaning, held by too few rows, is set against all that differ from it in one joint. Another seed draws
    other postures, so that a pose that is on record already is not proposed again.
    """
    best = meanings[0]
    scale = _scale(axes, best)
    sampled = random_joints(robot, TRIED, np.random.default_rng(seed))
    step = np.where(axes.turns, 1.0 if best.joint_unit == "deg" else 0.01, 1.0 if best.length_unit == "mm" else 0.01)
    shown = np.round(best.simplest.to_controller(sampled) / scale / step) * step
    inside = np.array([inside_limits(robot, m.simplest.to_model(shown * _scale(axes, m))) for m in meanings])
    counts = inside.sum(axis=0)
    shown = shown[counts == counts.max()]
    if len(meanings) == 1:
        rivals = np.concatenate([best.reading[None], one_change_away(best.reading, axes.turns)])
        turn, place = poses_of(axes, rivals, shown * scale)
        one, other = np.zeros(len(turn) - 1, dtype=np.intp), np.arange(1, len(turn))
    else:
        poses = [poses_of(axes, m.reading[None], shown * _scale(axes, m)) for m in meanings]
        turn = np.concatenate([turned for turned, _ in poses])
        # as the controller shows it: a metre and a millimetre that read alike cannot be told apart
        units = [LENGTHS[best.length_unit] / LENGTHS[m.length_unit] for m in meanings]
        place = np.concatenate([moved * unit for (_, moved), unit in zip(poses, units, strict=True)])
        one, other = np.triu_indices(len(turn), k=1)
    mm, rad = np.linalg.norm(place[one] - place[other], axis=-1), angle_between(turn[one], turn[other])
    size = np.maximum(mm / tolerance, rad / (tolerance * 1e-3))
    differ = size.max(axis=1) >= 1e-3  # the others are twins in any posture
    size, mm, rad = size[differ], mm[differ], rad[differ]
    at = int(np.lexsort((size.min(axis=0), (size > SEPARATED).sum(axis=0)))[-1])
    least = int(np.argmin(size[:, at]))
    return FurtherPose(shown[at], float((size[:, at] > SEPARATED).mean()), float(mm[least, at]), float(rad[least, at]))


def _scale(axes: Axes, meaning: Meaning) -> Array:
    """Factors (n,) from joint values as shown to rad and mm."""
    return np.where(axes.turns, ANGLES[meaning.joint_unit], LENGTHS[meaning.length_unit])


AROUND, REFINED, STEPS = 72, 3, 6
"""Values of an angle that are tried, those among them that are refined, and the most steps to refine one."""
AS_WELL = 2.0
"""Multiples of what the other rows miss by, within which a changed number explains its row as well as they are."""
ROUNDING = 0.1  # part of the tolerance that a row may always miss by: numbers are rounded


@dataclass(frozen=True)
class PendantSlip:
    """A number that does not fit, and the one in its place with which its row would.

    line: of the file (counted from 1, or the row where there is no file). column: its name. shown, fitting: in the unit
    of the column. miss: of the row with it, the larger of mm and mrad.
    """

    line: int
    column: str
    shown: float
    fitting: float
    miss: float


def slips_in(
    axes: Axes, base: Array, rows: PendantRows, row: int, meanings: Iterable[Meaning], tolerance: float
) -> tuple[PendantSlip, ...]:
    """Every single number of a row that could be the one copied wrongly, if the others mean what all other rows mean.

    meanings: of the other rows. A number counts when, changed, its row fits as well as the others do, within
    `tolerance` mm and mrad. Of several meanings each number keeps the value with which its row fits best.
    """
    found: dict[str, PendantSlip] = {}
    shown = rows.numbers
    for meaning in meanings:
        for name in meaning.rotations:
            miss = _misses(axes, base, rows, meaning, name)
            others = np.delete(shown, row, axis=0)
            limit = min(tolerance, max(AS_WELL * _size(miss(others)).max(), ROUNDING * tolerance))
            for k, (column, starts) in enumerate(_cells(axes, rows, meaning, name)):
                value, size = _best(miss, shown[row], k, starts)
                if size <= limit and (column not in found or size < found[column].miss):
                    if k < rows.joints.shape[1] and axes.turns[k]:  # within half a turn of zero
                        turn = 2 * np.pi / ANGLES[meaning.joint_unit]
                        value -= turn * round(value / turn)
                    found[column] = PendantSlip(rows.line(row), column, float(shown[row, k]), value, size)
    return tuple(sorted(found.values(), key=lambda slip: slip.miss))


def _misses(
    axes: Axes, base: Array, rows: PendantRows, meaning: Meaning, name: tuple[str, str]
) -> Callable[[Array], Array]:
    """Error function of rows (N, columns) under one meaning: (N, 12), 3 in mm and 9 whose norm is mrad."""
    n, length, scale = rows.joints.shape[1], LENGTHS[meaning.length_unit], _scale(axes, meaning)

    def miss(numbers: Array) -> Array:
        turn, place = poses_of(axes, meaning.reading[None], numbers[:, :n] * scale)
        apart = place[0] @ base[:3, :3].T + base[:3, 3] - numbers[:, n : n + 3] * length
        turned = base[:3, :3] @ turn[0] - rotations_as(numbers[:, n + 3 :], *name)
        # the norm of a difference of rotations is sqrt(2) times a small angle
        return np.hstack([apart, turned.reshape(len(numbers), 9) * (1e3 / np.sqrt(2))])

    return miss


def _size(misses: Array) -> Array:
    """The larger of mm and mrad (N,)."""
    return np.asarray(np.maximum(np.linalg.norm(misses[:, :3], axis=1), np.linalg.norm(misses[:, 3:], axis=1)))


def _cells(axes: Axes, rows: PendantRows, meaning: Meaning, name: tuple[str, str]) -> Iterator[tuple[str, Array]]:
    """Each column, with values to start from: one where poses are linear in it, else all round."""
    kind, unit = name
    n, around = rows.joints.shape[1], np.linspace(-np.pi, np.pi, AROUND, endpoint=False)
    angles = {"quaternion": around / np.pi, "rotation-vector": 2 * around}.get(kind, around) / ANGLES.get(unit, 1.0)
    for k, column in enumerate(rows.names):
        if k < n:
            yield column, around / ANGLES[meaning.joint_unit] if axes.turns[k] else np.zeros(1)
        else:
            yield column, np.zeros(1) if k < n + 3 else angles


def _best(miss: Callable[[Array], Array], numbers: Array, column: int, starts: Array) -> tuple[float, float]:
    """The value of one number with which its row misses least, by Gauss-Newton from the best starts; and that miss."""

    def at(values: Array) -> Array:
        tried = np.tile(numbers, (len(values), 1))
        tried[:, column] = values
        return miss(tried)

    values = starts[np.argsort(np.linalg.norm(at(starts), axis=1), kind="stable")[:REFINED]]
    near = 1e-6 * (1 + np.ptp(starts))
    for _ in range(STEPS):
        here, after, before = np.split(at(np.concatenate([values, values + near, values - near])), 3)
        slope = (after - before) / (2 * near)
        steep = np.maximum((slope**2).sum(axis=1), np.finfo(float).tiny)  # a number that moves nothing stays
        values = values - (slope * here).sum(axis=1) / steep
    sizes = _size(at(values))
    chosen = int(np.argmin(sizes))
    return float(values[chosen]), float(sizes[chosen])


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
    """Error of the nearest convention when none fits: worst row, mm and rad."""

    mm: float
    rad: float


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of a controller's conventions from pendant rows.

    meanings: all that fit, the simplest first; empty when none does. more: whether there are more than were looked at.
    postures: how many different ones the rows hold. further: the pose that would settle it, None where nothing is open.
    nearest: how far off the best is when none fits. odd_lines: rows without which one would.
    slips: single numbers in them that, changed, would let all rows fit, the best first. convention: of a DH table,
    "standard" or "modified", in which it would fit when none does as the table is read. order: in which the numbers of
    the quaternion would fit when none does as the columns call them.
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
    order: str = ""

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
    family (see `casacal.doctor.search`) is searched, in degrees and radians, mm and metres; two that give
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
    if not 0 < tolerance < math.inf:
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
    for by, order in ((1, "x, y, z, w"), (-1, "w, x, y, z")) if rows.orientations.shape[1] == 4 else ():
        if _meanings(known, replace(rows, orientations=np.roll(rows.orientations, by, axis=1)), tolerance)[0]:
            return Diagnosis(rows, tolerance, (), False, 0, None, None, order=order)
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
        groups = distinct(known.axes, readings[fits])
        more |= len(groups) == MOST_MEANINGS
        for group in groups:
            same = fits[group]
            written = sorted(
                {c for i in same if (c := conventions_of(readings[i], known.axes.mixing)) is not None}, key=changes
            )
            first = same[int(np.argmin(settings_changed(readings[same])))]
            rotations = {name: float(miss[first]) for name, miss in misses.items() if miss[first] <= tolerance * 1e-3}
            if written:
                worst = float(miss_mm[first])
                meanings.append(Meaning(tuple(written), readings[first], joint_unit, length_unit, rotations, worst))
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
        readings = known.halves.nearest(q, positions)
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

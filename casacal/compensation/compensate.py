"""Joint targets for which the calibrated robot reaches the poses that the nominal one was meant to reach.

Directions that the samples did not see stay at nominal under a finite prior; with flat priors nothing holds them, and
such a result is refused. Accuracy is stated apart from where the base stands, which a user teaches.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from casacal.array_types import Array, Rows
from casacal.compensation.arm import FRAMES, CalibratedArm, local_coordinates, named_covariance, row_constants
from casacal.compensation.inverse_kinematics import PosedArm, postures, turning
from casacal.compensation.predict import predict
from casacal.compensation.result_file import arm_from
from casacal.compensation.targets import Compensation, Outcome, Rounding, Targets, rows_with, targets_from
from casacal.compensation.told import TellingColumns
from casacal.errors import CasacalError, UnknownNameError
from casacal.kinematics import turns_of
from casacal.robots.robot import joint_units

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
    _trusted(result, frame)
    still = np.zeros((len(targets), len(drawn.robot.axes)))
    told = TellingColumns.by(result, rows_with(targets, np.arange(len(targets)), still))
    used, local = result.used, local_coordinates(result, of=result.used)
    arm = replace(nominal, local=local)
    if used.terms:
        arm = PosedArm.of(used, local, frame, row_constants(result, used), told.columns)
    start, positions, rotations = _meant(nominal, targets)
    found: Rows = np.asarray(np.isfinite(start).all(axis=1))
    began = np.where(found[:, None], start, np.mean(nominal.robot.limits, axis=0))
    joints, elsewhere = began.copy(), np.zeros(len(began), dtype=bool)
    given = positions[found], rotations[found], start[found]
    joints[found], elsewhere[found] = _solved(arm.of_rows(found), *given, largest)
    moved = np.abs((joints - began) / joint_units(arm.robot)).max(axis=1)
    jumps: Rows = np.asarray(moved > largest)
    limited = arm.at_limit(joints, positions, rotations) & ~jumps
    beyond: Rows = jumps & (moved <= LARGEST) & arm.takes(joints, positions, rotations)
    joints = rounding(arm, np.where(jumps[:, None] | ~found[:, None], start, joints))
    place, turn, expected = _proof(result, arm, targets, joints, positions, rotations)
    cases = (
        (~found, Outcome.UNREACHABLE),
        (~np.isfinite(place + turn), Outcome.NOT_FINITE),
        (_outside(arm, targets), Outcome.OUTSIDE),
        (arm.within(place, turn) & ~jumps, Outcome.REACHED),
        (limited, Outcome.LIMIT),
        (beyond, Outcome.BEYOND),
        (jumps | elsewhere, Outcome.SINGULAR),
        (np.ones(len(joints), dtype=bool), Outcome.UNREACHABLE),
    )
    ended = tuple(cases[i][1] for i in np.argmax([rows for rows, _ in cases], axis=0))  # the first that holds
    before, moved = np.linalg.norm(arm.miss(start, positions, rotations)[0], axis=1), np.where(jumps, 0.0, moved)
    return Compensation(
        targets, frame, rounding, joints, start, ended, place, turn, before, moved, expected, told.missing, told.beyond
    )


def _trusted(result: CalibratedArm, frame: str) -> None:
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
        beside = start[stuck] + SCATTER * joint_units(arm.robot) * rng.uniform(-1, 1, (len(stuck), start.shape[1]))
        again = arm.of_rows(stuck).reach(positions[stuck], rotations[stuck], beside, steps=STEPS)
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
    place, turn, spread = (np.full(len(joints), np.nan) for _ in range(3))
    missed = arm.miss(joints, positions, rotations)[:2]
    sound = np.flatnonzero(np.isfinite(np.hstack(missed)).all(axis=1))
    if sound.size:
        samples = rows_with(targets, sound, joints[sound])
        # nothing is expected of a result that is not to be used
        prediction = predict(result, samples, frame=arm.frame, std=not denied, force=True)
        turns = turns_of(prediction.quaternions)
        place[sound] = np.linalg.norm(prediction.positions - positions[sound], axis=1)
        turn[sound] = np.linalg.norm(turning(turns @ rotations[sound].transpose(0, 2, 1)), axis=1)
        spread[sound] = np.nan if denied else prediction.std
    return place, turn, spread


def _outside(arm: PosedArm, targets: Targets) -> Rows:
    """Rows whose own joint values lie outside the limits."""
    if targets.joints is None:
        return np.zeros(len(targets), dtype=bool)
    lower, upper = arm.robot.limits
    return np.asarray(((targets.joints < lower - ROUNDED) | (targets.joints > upper + ROUNDED)).any(axis=1))

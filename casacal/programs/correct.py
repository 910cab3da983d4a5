"""A program corrected in place: for the calibrated arm, back to nominal, or for another arm of its type."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from casacal.deployment.arm import CalibratedArm, local_coordinates, row_constants
from casacal.deployment.compensate import (
    LARGEST,
    ROUNDED,
    STEPS,
    Outcome,
    Rounding,
    Targets,
    compensate,
    refuse_untrusted,
    targets_from,
)
from casacal.deployment.inverse_kinematics import PosedArm
from casacal.deployment.predict import Prediction, predict
from casacal.deployment.result_file import arm_from
from casacal.errors import CasacalError, RefusedResultError
from casacal.files import MADE, write_text
from casacal.model.kinematics import quaternions_of
from casacal.programs.postures import agreement, bits, controller_joints
from casacal.programs.program import SUFFIX, Number, Target, TaughtProgram
from casacal.programs.read import DIALECTS, read_again, read_program
from casacal.values import Array, Value

Which = NDArray[np.intp]
FINE = Rounding(decimals=10)  # joint values in between are not written
ALIKE = 1e-6  # mm by which drawings of one type of arm may differ
MOST_LEFT = 0.1  # mm that a target may miss as written: three times what pulses of a large arm leave
SAME_TOOL = 5.0  # mm by which the ends of two tools may differ: errors of angles make little of them
STILL = 1e-9  # rad within which a joint stands on a border
JUMPS = "the correction jumps to another configuration of the arm, through a singularity or past a border"


@dataclass(frozen=True, eq=False)
class ProgramRun(Value):
    """A program at its controller: joint values (N, 6; rad) that it takes for its targets, NaN where it takes none.

    arm: the nominal arm, which the controller knows. flanges: where that arm's flange is meant to be (N, 4, 4; mm), in
    the problem's base frame. tools: the tools in force (N, 4, 4; mm), none where a joint target does without. why: by
    its index, why a target has no joint values.
    """

    program: TaughtProgram
    arm: PosedArm
    joints: Array
    flanges: Array
    tools: Array
    why: Mapping[int, str]


TWICE = "it is reached in two postures, by where the moves before stand: give each use a target of its own"


def run_program(result: CalibratedArm, program: TaughtProgram, begin: Sequence[float] | None = None) -> ProgramRun:
    """The joint values at which a controller, which knows the nominal arm, takes the targets of a program.

    begin: joint values (6,; rad) of the arm where the program begins, for poses that state no configuration.
    Raises CasacalError for an arm without six joints that turn.
    """
    drawn = result.source.problem.without_terms
    robot = drawn.robot
    if len(robot.axes) != 6 or not robot.revolute.all():
        what = f"'{robot.name}' has {len(robot.axes)} joints, and a program is for an arm with six that turn"
        raise CasacalError(what, "Correct its joint targets as CSV")
    if not program.targets:
        what = f"{program.paths[0]} holds no move to a target that is understood"
        raise CasacalError(what, f"Name a program in {SUFFIX[program.language]} with such moves")
    arm = PosedArm.of(drawn, local_coordinates(result, nominal=True), "flange", row_constants(result, drawn))
    flanges, tools = (np.tile(np.eye(4), (len(program.targets), 1, 1)) for _ in range(2))
    for i, target in enumerate(program.targets):
        tools[i] = np.eye(4) if target.tool is None else target.tool
        if target.base is not None:
            flanges[i] = target.base @ program.form.pose(target.values) @ np.linalg.inv(tools[i])
    start = None if begin is None else np.asarray(begin, dtype=np.float64)
    dialect = DIALECTS[program.language]
    joints, twice = controller_joints(arm, dialect, program.targets, program.moves, flanges, start)
    why = {i: words for i, target in enumerate(program.targets) if (words := _lost(program, arm, target, joints[i]))}
    why |= {i: TWICE for i in twice if i not in why}
    known = np.array([i for i in range(len(joints)) if i not in why], dtype=np.intp)
    flanges[known] = _flanges(arm, joints[known])
    return ProgramRun(program, arm, joints, flanges, tools, why)


def _lost(program: TaughtProgram, arm: PosedArm, target: Target, joints: Array) -> str | None:
    """Why a target has no joint values (6,) inside the limits, if that is so."""
    if np.isnan(joints).any():
        taken = "no posture of the drawn arm takes it"
        asked = "perhaps tool and base are not those that it was taught with"
        if all(entry is None for entry in target.config):
            return f"{taken}: {asked}, or neither a joint target nor --near says where it begins"
        return f"{taken} in the configuration that it states: {asked}, or world and flange stand elsewhere"
    lower, upper = arm.robot.limits
    beyond = np.maximum(lower - joints, joints - upper)
    if beyond.max() <= ROUNDED:
        return None
    k = int(np.argmax(beyond))
    said = f"joint {k + 1} would stand at {math.degrees(joints[k]):g} degrees, and its limits are "
    said += f"{math.degrees(lower[k]):g} to {math.degrees(upper[k]):g}"
    return said + ("; joint values stand in rad, d2r(90) is 90 degrees" if program.language == "urscript" else "")


def _flanges(arm: PosedArm, joints: Array) -> Array:
    """Poses (N, 4, 4; mm) of the flange at joint values (N, 6)."""
    made = np.tile(np.eye(4), (len(joints), 1, 1))
    if len(joints):
        made[:, :3, 3], made[:, :3, :3], _ = arm(joints)
    return made


@dataclass(frozen=True, eq=False)
class CorrectedProgram(Value):
    """A corrected program, and one entry per target (N) of what was done to it.

    texts: of each of the program's files; encoded as Latin-1 they are its bytes. outcomes: how each target ended: those
    that are not REACHED stay as they were, `why` by index. correction_mm: how far the arm was from what was meant, at
    the tip, of joint targets without a tool at the flange. correction_rad: largest motion of a joint. left_mm: what the
    digits of the file leave of that, worked out again from the corrected texts. expected_mm: standard deviation of the
    position of the flange, or of the tip where that is corrected, apart from that of the base; NaN where the result
    tells none. missing: as of a `Prediction`.
    """

    program: TaughtProgram
    texts: tuple[str, ...]
    outcomes: tuple[Outcome, ...]
    why: Mapping[int, str]
    correction_mm: Array
    correction_rad: Array
    left_mm: Array
    expected_mm: Array
    missing: Mapping[str, tuple[str, ...]]

    def __repr__(self) -> str:
        return f"<CorrectedProgram {self.program.paths[0]}: {self.reached.sum()} of {len(self.outcomes)} corrected>"

    @property
    def reached(self) -> Array:
        """Which targets (N,) were corrected."""
        return np.array([outcome is Outcome.REACHED for outcome in self.outcomes])

    @property
    def diff(self) -> str:
        """The lines that differ, as a unified diff."""
        return self.program.changed_lines(self.texts)


def compensate_program(
    result: CalibratedArm,
    program: TaughtProgram | str,
    *,
    frame: Literal["flange", "tip"] = "flange",
    inverse: bool = False,
    onto: CalibratedArm | None = None,
    begin: Sequence[float] | None = None,
    largest: float = LARGEST,
    skip_unknown: bool = False,
) -> CorrectedProgram:
    """Correct a program in place: only the numbers of its targets change, each in the form of its digits.

    The controller takes each target for joint values of the nominal arm, in the configuration that it states. These
    are what was meant; the target then gets the numbers at which the calibrated arm stands there.

    Args:
        result: a calibration, or a truth.
        program: as `read_program` gives it, or its path.
        frame: what goes where it was meant to: "flange", with whatever tool, or "tip", where the instrument touches;
            then the tools of the program must end there.
        inverse: the program was taught on the calibrated arm; it gets the numbers that a nominal arm would have there.
        onto: the result of another arm of this type, on which the program, taught on `result`, is to run.
        begin: joint values (6,; rad) where the program begins, for poses that state no configuration (URScript).
        largest: joint motion (rad) beyond which a correction is a jump.
        skip_unknown: leave what is not understood or not reached as it is, in place of an error.

    Raises CasacalError by line for what is not understood, not reached, or would change its configuration;
    RefusedResultError for a result that must not be used.

    """
    result, program = arm_from(result), program if isinstance(program, TaughtProgram) else read_program(program)
    other = None if onto is None else arm_from(onto)
    if inverse and other is not None:
        raise CasacalError("A program goes back to nominal or onto another arm", "Give inverse or onto")
    if frame != "flange" and (inverse or other is not None):
        raise CasacalError("The tip is corrected for the arm itself", "Leave frame out, or inverse and onto")
    for arm in (result, other or result):
        if arm.denial is not None:
            fix = "Mend what it names and calibrate again; a program has no place for warnings, so none is forced"
            raise RefusedResultError(f"{arm.file}: {arm.denial.removesuffix('.')}", fix)
        refuse_untrusted(arm, frame)
    if not skip_unknown:
        program.refuse_puzzles()
    run = run_program(result, program, begin)
    outcomes, why = [Outcome.UNREACHABLE] * len(program.targets), program.puzzled | dict(run.why)
    known = np.array([i for i in range(len(outcomes)) if i not in why], dtype=np.intp)
    if frame == "tip" and (elsewhere := _other_tools(result, run, known)):
        program.refuse_targets(elsewhere, "Correct the flange, which serves every tool")
    joints, meant, ended, expected, missing = _steered(result, other, run, known, frame, inverse, largest)
    for i, outcome in zip(known.tolist(), ended, strict=True):
        outcomes[i] = outcome
        if outcome is not Outcome.REACHED:
            why[i] = f"{outcome.value}: {outcome.meaning}"
    numbers = dict[Number, float]()
    for i, values in zip(known.tolist(), _numbers(run, known, joints), strict=True):
        if values is None and i not in why:
            outcomes[i], why[i] = Outcome.SINGULAR, JUMPS
        elif i not in why:
            numbers |= values or {}
    if why and not skip_unknown:
        program.refuse_targets(why)
    texts = program.with_numbers(numbers)
    proof = _proof(other or result, run, known, joints, meant, frame, inverse, read_again(program, texts))
    if off := [i for i in np.flatnonzero(proof[1] > MOST_LEFT).tolist() if i not in why]:
        said = "as written it would miss what was meant by {:.3g} mm, for what moves it is corrected elsewhere too"
        program.refuse_targets({i: said.format(proof[1][i]) for i in off}, "Give it numbers of its own")
    motion, error = (np.full(len(outcomes), np.nan) for _ in range(2))
    motion[known], error[known] = np.abs(joints - run.joints[known]).max(axis=1, initial=0.0), expected
    return CorrectedProgram(program, texts, tuple(outcomes), why, proof[0], motion, proof[1], error, missing)


def _steered(
    result: CalibratedArm,
    other: CalibratedArm | None,
    run: ProgramRun,
    known: Which,
    frame: Literal["flange", "tip"],
    inverse: bool,
    largest: float,
) -> tuple[Array, Array, Sequence[Outcome], Array, Mapping[str, tuple[str, ...]]]:
    """Of some targets (M,) joint values, frames as meant, how each ended, standard deviations, and `missing`."""
    joints = run.joints[known]
    if not len(joints):
        return joints, run.flanges[known], (), np.zeros(0), {}
    if not inverse and other is None:
        found = compensate(result, targets_from(joints, result.source), frame=frame, largest=largest, rounding=FINE)
        meant = run.flanges[known] if frame == "flange" else predict(result, joints, frame=frame, nominal=True).poses
        return found.joints, meant, found.outcomes, found.expected_mm, found.missing
    there = predict(result, joints, std=True)
    assert there.std is not None
    at = there.poses[:, :3, 3], there.poses[:, :3, :3]
    if other is not None:
        _refuse_other_type(result, other, joints)
        targets = Targets(joints, at, tuple(range(len(joints))), ("",) * len(joints), run.program.paths[0], "")
        found = compensate(other, targets, largest=largest, rounding=FINE)
        expected = np.hypot(found.expected_mm, there.std)  # both arms err
        return found.joints, there.poses, found.outcomes, expected, {**there.missing, **found.missing}
    moved = run.arm.reach(*at, joints, steps=STEPS)
    way, taken = np.abs(moved - joints).max(axis=1), run.arm.takes(moved, *at)
    beyond = [Outcome.LIMIT if limited else Outcome.UNREACHABLE for limited in run.arm.at_limit(moved, *at)]
    ended = [Outcome.BEYOND if each > largest else Outcome.REACHED for each in way]
    ended = [Outcome.SINGULAR if each > max(largest, LARGEST) else end for each, end in zip(way, ended, strict=True)]
    ended = [end if good else lost for end, good, lost in zip(ended, taken, beyond, strict=True)]
    return moved, there.poses, ended, there.std, there.missing


def _other_tools(result: CalibratedArm, run: ProgramRun, known: Which) -> dict[int, str]:
    """Why some targets (M,) whose tool is known are not for the tip, by index: those whose tool ends elsewhere."""
    targets = (run.program.targets[i] for i in known.tolist())
    posed = known[[each.base is not None or each.tool is not None for each in targets]]
    if not posed.size:
        return {}
    tips = predict(result, run.joints[posed], frame="tip", nominal=True).poses
    off = np.linalg.norm((tips - run.flanges[posed] @ run.tools[posed])[:, :3, 3], axis=1)
    words = "its tool ends {:.1f} mm from the tip of the tool that touched"
    return {int(i): words.format(miss) for i, miss in zip(posed, off, strict=True) if miss > SAME_TOOL}


def _refuse_other_type(result: CalibratedArm, other: CalibratedArm, joints: Array) -> None:
    """Raise CasacalError unless two results are of arms with one drawing."""
    one, two = result.source.problem.robot, other.source.problem.robot
    alike = len(one.axes) == len(two.axes)
    if alike:
        poses = [predict(each, joints, nominal=True).poses for each in (result, other)]
        alike = bool(np.abs(poses[0] - poses[1]).max(initial=0.0) < ALIKE)
    if not alike:
        what = f"{result.file} ('{one.name}') and {other.file} ('{two.name}') are of arms with different drawings"
        raise CasacalError(what, "Give results of two arms of one type")


def _numbers(run: ProgramRun, known: Which, joints: Array) -> list[dict[Number, float] | None]:
    """New values of the numbers of some targets at joint values (M, 6); None for one that leaves its configuration."""
    found = list[dict[Number, float] | None]()
    if not known.size:
        return found
    dialect, sides = DIALECTS[run.program.language], bits(run.arm, joints, DIALECTS[run.program.language].upright)
    flanges, exact = _flanges(run.arm, joints), dialect.configuration(joints, sides)
    before, after = (np.linalg.det(run.arm(each)[2]) for each in (run.joints[known], joints))
    for row, i in enumerate(known.tolist()):
        target = run.program.targets[i]
        if target.base is None:
            found.append({n: float(q) / n.unit for n, q in zip(target.numbers, joints[row], strict=True)})
            continue
        turning = {k for _, indices in target.turns for k in indices}
        fixed = [None if k in turning else entry for k, entry in enumerate(target.config)]
        if before[row] * after[row] <= 0 or not agreement(dialect, joints[[row]], sides[[row]], fixed).all():
            found.append(None)
            continue
        pose = np.linalg.inv(target.base) @ flanges[row] @ run.tools[i]
        values = dict(zip(target.numbers, run.program.form.numbers(pose, target.values).tolist(), strict=True))
        same = agreement(dialect, joints[[row]], sides[[row]], target.config, STILL)[0]
        for number, indices in target.turns:
            if not same[list(indices)].all():  # a joint passed the border of a quadrant, a turn or a sign
                values[number] = float(sum(int(exact[row, k]) << bit for bit, k in enumerate(indices)))
        found.append(values)
    return found


def _proof(
    arm: CalibratedArm,
    run: ProgramRun,
    known: Which,
    joints: Array,
    meant: Array,
    frame: Literal["flange", "tip"],
    nominal: bool,
    written: TaughtProgram,
) -> tuple[Array, Array]:
    """How far tips (N,; mm) were from what was meant, and are with a program as written; NaN for other targets."""
    assert written.moves == run.program.moves
    before, left = (np.full(len(run.joints), np.nan) for _ in range(2))
    taken, tools = joints.copy(), run.tools[known]
    for row, i in enumerate(known.tolist()):
        target = written.targets[i]
        if target.base is None:
            taken[row] = target.joints
        else:
            flange = target.base @ written.form.pose(target.values) @ np.linalg.inv(tools[row])
            taken[row] = run.arm.reach(flange[None, :3, 3], flange[None, :3, :3], joints[[row]])[0]
    for values, into in ((run.joints[known], before), (taken, left)) if known.size else ():
        off = predict(arm, values, frame=frame, nominal=nominal).poses - meant
        into[known] = np.linalg.norm((off @ tools if frame == "flange" else off)[:, :3, 3], axis=1)
    return before, left


def predict_program(
    result: CalibratedArm, program: TaughtProgram | str, *, begin: Sequence[float] | None = None, force: bool = False
) -> tuple[ProgramRun, Prediction]:
    """Where the true arm goes at each target of a program: the run at its controller, and the flange's poses there.

    Targets in `why` of the run have no pose that means anything. Arguments and errors as of `compensate_program`;
    force: take a result whose verdict is not to use it, which has no standard deviations.
    """
    result, program = arm_from(result), program if isinstance(program, TaughtProgram) else read_program(program)
    run = run_program(result, program, begin)
    return run, predict(result, np.nan_to_num(run.joints), std=result.denial is None, force=force)


def write_program_prediction(
    path: str | Path, run: ProgramRun, prediction: Prediction, remarks: Sequence[str] = ()
) -> None:
    """Write a row for each move: line, target, motion, pose, how far off it is, the flange's standard deviation.

    Poses are of the tool in force, of joints without one of the flange, in the base frame. remarks: sentences above.
    """
    lines = [f"# predicted moves of {run.program.paths[0]}, {MADE}: the tool in force, in the base frame"]
    lines += [f"# {remark}" for remark in remarks]
    lines += [] if prediction.denial is None else [f"# WARNING, against the verdict: {prediction.denial}"]
    lines = [" ".join(line.split()).encode("unicode_escape").decode("ascii") for line in lines]
    lines.append("line,target,motion,x_mm,y_mm,z_mm,qw,qx,qy,qz,off_mm,std_mm")
    tips, meant = prediction.poses @ run.tools, run.flanges @ run.tools
    turns, off = quaternions_of(tips[:, :3, :3]), np.linalg.norm((tips - meant)[:, :3, 3], axis=1)
    for move in run.program.moves:
        if (i := move.target) not in run.why:
            std = "" if prediction.std is None else f"{prediction.std[i]:.6f}".replace("nan", "")
            numbers = [f"{v:.6f}" for v in tips[i, :3, 3]] + [f"{v:.12f}" for v in turns[i]] + [f"{off[i]:.6f}", std]
            name = run.program.targets[i].name.replace('"', "'").replace(",", ";")
            lines.append(",".join([str(move.line), name, move.motion, *numbers]))
    write_text(path, "\n".join(lines) + "\n")

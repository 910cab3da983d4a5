"""A program corrected in place: for the calibrated arm, back to nominal, or for another arm of its type."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from casacal.deployment.arm import CalibratedArm, local_coordinates, row_constants
from casacal.deployment.compensate import (
    LARGEST,
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
from casacal.errors import CasacalError, RefusedResultError, harmless
from casacal.files import MADE, write_text
from casacal.model.kinematics import quaternions_of
from casacal.programs.postures import agreement, bits, controller_joints
from casacal.programs.program import SUFFIX, Move, Number, Program, Target
from casacal.programs.read import DIALECTS, read_again, read_program
from casacal.values import Array, Value

Which = NDArray[np.intp]
FINE = Rounding(decimals=10)  # joint values in between are not written
ALIKE = 1e-6  # mm by which drawings of one type of arm may differ


@dataclass(frozen=True, eq=False)
class ProgramRun(Value):
    """A program at its controller: joint values (N, 6; rad) that it takes for its targets, NaN where it takes none.

    arm: the nominal arm, which the controller knows. flanges: where that arm's flange is meant to be (N, 4, 4; mm), in
    the problem's base frame. tools: the tools in force (N, 4, 4; mm), none where a joint target does without. why: by
    its index, why a target has no joint values.
    """

    program: Program
    arm: PosedArm
    joints: Array
    flanges: Array
    tools: Array
    why: dict[int, str]

    def refuse_lost(self) -> None:
        """Raise CasacalError for targets that the controller cannot take."""
        if self.why:
            first, *others = self.why
            target = self.program.targets[first]
            also = f" (and {len(others)} more)" if others else ""
            what = f"{self.program.place(target)}, target '{target.name}': {self.why[first]}{also}"
            raise CasacalError(harmless(what), "Mend it, or leave such targets as they are with --skip-unknown")


def run_program(result: CalibratedArm, program: Program, *, begin: Array | None = None) -> ProgramRun:
    """The joint values at which a controller, which knows the nominal arm, takes the targets of a program.

    begin: joint values (6,; rad) of the arm where the program begins, for poses that state no configuration.
    Raises CasacalError for an arm without six joints that turn.
    """
    robot, drawn = result.source.problem.robot, result.source.problem.without_terms
    if len(robot.axes) != 6 or not robot.revolute.all():
        what = f"'{robot.name}' has {len(robot.axes)} joints, and a program is for an arm with six that turn"
        raise CasacalError(what, "Correct its joint targets as CSV")
    if not program.targets:
        what = f"{program.paths[0]} holds no move to a target that is understood"
        raise CasacalError(what, f"Name a program in {SUFFIX[program.language]} with such moves")
    arm = PosedArm.of(drawn, local_coordinates(result, nominal=True), "flange", row_constants(result, drawn))
    flanges, tools = (np.tile(np.eye(4), (len(program.targets), 1, 1)) for _ in range(2))
    for i, target in enumerate(program.targets):
        tools[i] = target.tool if target.tool is not None else np.eye(4)
        if target.kind == "pose":
            assert target.base is not None
            flanges[i] = target.base @ program.form.pose(target.values) @ np.linalg.inv(tools[i])
    joints = controller_joints(arm, DIALECTS[program.language], program.targets, flanges, begin)
    lower, upper = robot.limits
    why = dict[int, str]()
    for i, target in enumerate(program.targets):
        if target.kind == "joints" and ((joints[i] < lower - LOOSE) | (joints[i] > upper + LOOSE)).any():
            k = int(np.argmax(np.maximum(lower - joints[i], joints[i] - upper)))
            ends = f"{math.degrees(lower[k]):g} to {math.degrees(upper[k]):g}"
            said = f"joint {k + 1} would stand at {math.degrees(joints[i, k]):g} degrees, and its limits are {ends}"
            radians = "; joint values stand in rad, d2r(90) is 90 degrees" if program.language == "urscript" else ""
            why[i] = f"{said}{radians}"
        elif not np.isfinite(joints[i]).all():
            why[i] = _unreached(target, begin is None and i == 0)
    known = np.array([i for i in range(len(joints)) if i not in why], dtype=np.intp)
    if known.size:
        flanges[known] = _transforms(*arm(joints[known])[:2])
    return ProgramRun(program, arm, joints, flanges, tools, why)


LOOSE = 1e-6  # how far (rad) rounding may put joint values beyond a limit


def _unreached(target: Target, first: bool) -> str:
    """Why a pose has no joint values."""
    if any(entry is not None for entry in target.config):
        return (
            "no posture of the drawn arm takes it in the configuration that it states: are tool and base those that it "
            "was taught with, and do world and flange stand where the problem has them?"
        )
    if first:
        return "it states no configuration, and no joint target stands before it (--near says where the arm begins)"
    return "no posture of the drawn arm takes it: are tool and base those that it was taught with?"


def _transforms(positions: Array, rotations: Array) -> Array:
    made = np.tile(np.eye(4), (len(positions), 1, 1))
    made[:, :3, 3], made[:, :3, :3] = positions, rotations
    return made


@dataclass(frozen=True, eq=False)
class CorrectedProgram(Value):
    """A corrected program, and one entry per target (N) of what was done to it.

    texts: of each of the program's files; encoded as Latin-1 they are its bytes. outcomes: how each target ended: those
    that are not REACHED stay as they were, `why` by index. correction_mm: how far the arm was from what was meant, at
    the tip, of joint targets without a tool at the flange. correction_rad: largest motion of a joint. left_mm: what the
    digits of the file leave of that, worked out again from the corrected texts. expected_mm: standard deviation of the
    flange's position, apart from that of the base; NaN where the result tells none. missing: as of a `Prediction`.
    """

    program: Program
    texts: tuple[str, ...]
    outcomes: tuple[Outcome, ...]
    why: dict[int, str]
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

    def by_size(self) -> list[tuple[Move, Target, int]]:
        """The moves to corrected targets, largest correction first, with target and its index."""
        moves = [(move, self.program.targets[move.target], move.target) for move in self.program.moves]
        return sorted((each for each in moves if self.reached[each[2]]), key=lambda each: -self.correction_mm[each[2]])


def compensate_program(
    result: CalibratedArm,
    program: Program | str,
    *,
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
        inverse: the program was taught on the calibrated arm; it gets the numbers that a nominal arm would have there.
        onto: the result of another arm of this type, on which the program, taught on `result`, is to run.
        begin: joint values (6,; rad) where the program begins, for poses that state no configuration (URScript).
        largest: joint motion (rad) beyond which a correction is a jump.
        skip_unknown: leave what is not understood or not reached as it is, in place of an error.

    Raises CasacalError by line for what is not understood, not reached, or would change its configuration;
    RefusedResultError for a result that must not be used.

    """
    result, program = arm_from(result), program if isinstance(program, Program) else read_program(program)
    other = None if onto is None else arm_from(onto)
    if inverse and other is not None:
        raise CasacalError("A program goes back to nominal or onto another arm", "Give inverse or onto")
    for arm in (result, other) if other is not None else (result,):
        refuse_denied(arm)
        refuse_untrusted(arm, "flange")
    if not skip_unknown:
        program.refuse_puzzles()
    run = run_program(result, program, begin=None if begin is None else np.asarray(begin, dtype=np.float64))
    if not skip_unknown:
        run.refuse_lost()
    known = np.array([i for i in range(len(program.targets)) if i not in run.why], dtype=np.intp)
    done = _steered(result, other, run, known, inverse, largest)
    outcomes, why = [Outcome.UNREACHABLE] * len(program.targets), dict(run.why)
    for i, outcome in zip(known.tolist(), done.outcomes, strict=True):
        outcomes[i] = outcome
    for i, words in _kept_configuration(run, known, done).items():
        outcomes[i], why[i] = Outcome.SINGULAR, words
    for i, outcome in enumerate(outcomes):
        if outcome is not Outcome.REACHED:
            why.setdefault(i, f"{outcome.value}: {outcome.meaning}")
    lost = ProgramRun(program, run.arm, run.joints, run.flanges, run.tools, why)
    if not skip_unknown:
        lost.refuse_lost()
    texts = program.with_numbers(_numbers(run, known, done, why))
    return _proven(result, other, run, known, done, inverse, texts, tuple(outcomes), why)


def refuse_denied(result: CalibratedArm) -> None:
    """Raise RefusedResultError for a result that must not be used: a program has no place that would say so."""
    if result.denial is not None:
        fix = "Mend what the verdict names and calibrate again; a program has no place for a warning, so none is forced"
        raise RefusedResultError(f"{result.file}: {result.denial.removesuffix('.')}", fix)


@dataclass(frozen=True, eq=False)
class Steered(Value):
    """Corrected joint values (M, 6; rad) of some targets, how each ended, where its flange was meant (M, 4, 4; mm)."""

    joints: Array
    outcomes: tuple[Outcome, ...]
    meant: Array
    expected_mm: Array
    missing: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def _steered(
    result: CalibratedArm, other: CalibratedArm | None, run: ProgramRun, known: Which, inverse: bool, largest: float
) -> Steered:
    """Joint values at which the arm stands where the controller's joint values were meant to bring it."""
    joints = run.joints[known]
    if not len(joints):
        return Steered(joints, (), np.zeros((0, 4, 4)), np.zeros(0))
    if not inverse and other is None:
        found = compensate(result, targets_from(joints, result.source), largest=largest, rounding=FINE)
        return Steered(found.joints, found.outcomes, run.flanges[known], found.expected_mm, found.missing)
    there = predict(result, joints, std=inverse)
    meant = there.poses
    if other is not None:
        _refuse_other_type(result, other, joints)
        lines, text = tuple(range(1, len(joints) + 1)), ("",) * len(joints)
        targets = Targets(joints, (meant[:, :3, 3], meant[:, :3, :3]), lines, text, run.program.paths[0], "")
        found = compensate(other, targets, largest=largest, rounding=FINE)
        return Steered(found.joints, found.outcomes, meant, found.expected_mm, found.missing)
    at = meant[:, :3, 3], meant[:, :3, :3]
    moved = run.arm.reach(*at, joints, steps=STEPS)
    taken, limited = run.arm.takes(moved, *at), run.arm.at_limit(moved, *at)
    jumps = np.abs(moved - joints).max(axis=1) > largest
    ended = [
        Outcome.SINGULAR if jump else Outcome.REACHED if good else Outcome.LIMIT if limit else Outcome.UNREACHABLE
        for jump, good, limit in zip(jumps, taken, limited, strict=True)
    ]
    assert there.std is not None
    return Steered(moved, tuple(ended), meant, there.std, there.missing)


STEPS = 150  # at most, as of `compensate`


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


def _kept_configuration(run: ProgramRun, known: Which, done: Steered) -> dict[int, str]:
    """By its index, what is wrong with a target whose correction would leave its configuration."""
    found = dict[int, str]()
    if not known.size:
        return found
    dialect = DIALECTS[run.program.language]
    sides = bits(run.arm, done.joints, dialect.upright)
    before, after = (np.linalg.det(run.arm(each)[2]) for each in (run.joints[known], done.joints))
    for row, i in enumerate(known.tolist()):
        target = run.program.targets[i]
        free = {k for _, indices in target.turns for k in indices}
        fixed = [None if k in free else entry for k, entry in enumerate(target.config)]
        kept = agreement(dialect, done.joints[[row]], sides[[row]], fixed).all() and before[row] * after[row] > 0
        if target.kind == "pose" and done.outcomes[row] is Outcome.REACHED and not kept:
            found[i] = (
                "the correction jumps to another configuration of the arm, through a singularity or past a border"
            )
    return found


def _numbers(run: ProgramRun, known: Which, done: Steered, why: dict[int, str]) -> dict[Number, float]:
    """New values of the numbers of all targets that are corrected."""
    found = dict[Number, float]()
    if not known.size:
        return found
    dialect = DIALECTS[run.program.language]
    sides, flanges = bits(run.arm, done.joints, dialect.upright), _transforms(*run.arm(done.joints)[:2])
    exact = dialect.configuration(done.joints, sides)
    for row, i in enumerate(known.tolist()):
        target = run.program.targets[i]
        if i in why:
            continue
        if target.kind == "joints":
            found |= {n: float(q) / n.unit for n, q in zip(target.numbers, done.joints[row], strict=True)}
            continue
        assert target.base is not None
        pose = np.linalg.inv(target.base) @ flanges[row] @ run.tools[i]
        found |= dict(zip(target.numbers, run.program.form.numbers(pose, target.values).tolist(), strict=True))
        same = agreement(dialect, done.joints[[row]], sides[[row]], target.config, STILL)[0]
        for number, indices in target.turns:
            if not same[list(indices)].all():  # a joint passed the border of a quadrant, a turn or a sign
                entries = [int(exact[row, k]) for k in indices]
                found[number] = float(sum(entry << bit for bit, entry in enumerate(entries)))
    return found


STILL = 1e-9  # rad within which a joint stands on a border


def _proven(
    result: CalibratedArm,
    other: CalibratedArm | None,
    run: ProgramRun,
    known: Which,
    done: Steered,
    inverse: bool,
    texts: tuple[str, ...],
    outcomes: tuple[Outcome, ...],
    why: dict[int, str],
) -> CorrectedProgram:
    """The corrected program with its proof: its texts read anew, and where they bring the arm."""
    program, count = run.program, len(run.program.targets)
    written = read_again(program, texts)
    assert len(written.targets) == count
    assert written.moves == program.moves
    correction, motion, left, expected = (np.full(count, np.nan) for _ in range(4))
    if known.size:
        joints, tools = done.joints.copy(), run.tools[known]
        for row, i in enumerate(known.tolist()):
            target = written.targets[i]
            if target.kind == "joints":
                joints[row] = target.joints
                continue
            assert target.base is not None
            flange = target.base @ program.form.pose(target.values) @ np.linalg.inv(tools[row])
            joints[row] = run.arm.reach(flange[None, :3, 3], flange[None, :3, :3], joints[[row]])[0]
        tip = (done.meant @ tools)[:, :3, 3]
        for values, into in ((run.joints[known], correction), (joints, left)):
            there = predict(other or result, values, nominal=inverse).poses
            into[known] = np.linalg.norm((there @ tools)[:, :3, 3] - tip, axis=1)
        motion[known], expected[known] = np.abs(done.joints - run.joints[known]).max(axis=1), done.expected_mm
    return CorrectedProgram(program, texts, outcomes, why, correction, motion, left, expected, done.missing)


def predict_program(
    result: CalibratedArm, program: Program | str, *, begin: Sequence[float] | None = None, force: bool = False
) -> tuple[ProgramRun, Prediction]:
    """Where the true arm goes at each target of a program: the run at its controller, and the flange's poses there.

    Targets without joint values have no pose (NaN). Arguments and errors as of `compensate_program`; force: take a
    result whose verdict is not to use it, which has no standard deviations.
    """
    result, program = arm_from(result), program if isinstance(program, Program) else read_program(program)
    run = run_program(result, program, begin=None if begin is None else np.asarray(begin, dtype=np.float64))
    safe = np.where(np.isfinite(run.joints), run.joints, 0.0)
    return run, predict(result, safe, std=result.denial is None, force=force)


def write_program_prediction(path: str | Path, run: ProgramRun, prediction: Prediction) -> None:
    """Write a row for each move: line, target, motion, pose, how far off it is, the flange's standard deviation.

    Poses are of the tool in force, of joints without one of the flange, in the base frame.
    """
    lines = [f"# predicted moves of {run.program.paths[0]}, {MADE}: the tool in force, in the base frame"]
    lines += [] if prediction.denial is None else [f"# WARNING, against the verdict: {prediction.denial}"]
    lines = [" ".join(line.split()).encode("unicode_escape").decode("ascii") for line in lines]
    lines.append("line,target,motion,x_mm,y_mm,z_mm,qw,qx,qy,qz,off_mm,std_mm")
    tips, meant = prediction.poses @ run.tools, run.flanges @ run.tools
    turns, off = quaternions_of(tips[:, :3, :3]), np.linalg.norm((tips - meant)[:, :3, 3], axis=1)
    for move in run.program.moves:
        if (i := move.target) not in run.why:
            std = "" if prediction.std is None else f"{prediction.std[i]:.6f}"
            numbers = [f"{v:.6f}" for v in tips[i, :3, 3]] + [f"{v:.12f}" for v in turns[i]] + [f"{off[i]:.6f}", std]
            name = run.program.targets[i].name.replace('"', "'").replace(",", ";")
            lines.append(",".join([str(move.line), name, move.motion, *numbers]))
    write_text(path, "\n".join(lines) + "\n")

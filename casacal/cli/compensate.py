"""`casacal compensate`: correct joint targets for the calibrated arm, with their proof."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casacal.cli.common import DONE, FAILED, FORCE, INSTRUMENT, JSON, RESULT, add, add_frame, made_from, read_arm, spare
from casacal.cli.programs import PROGRAM, PROGRAM_OPTIONS, add_program, read_program_of
from casacal.cli.terminal import answer
from casacal.errors import CasacalError
from casacal.wording import capital, counted, figures, shortened

if TYPE_CHECKING:
    from casacal.deployment.arm import CalibratedArm
    from casacal.model.robot import Robot
    from casacal.programs.correct import CorrectedProgram
    from casacal.programs.program import Puzzle, Target
    from casacal.values import Array

HELP = "correct joint targets for the calibrated arm"
SHOWN = 5  # targets not reached that are named one by one


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal compensate`."""
    parser.description = (
        "Write joint targets that bring the calibrated robot to the poses meant for the nominal one. Joint targets "
        "keep their branch. Pose targets (with a column qw) take the branch of the joint columns beside them; without "
        "such columns each takes the posture nearest to that of the row before, and the first the one nearest to the "
        "middle of the joints' ranges. Exit 1 if a target is not reached; every row is written. A robot program in "
        f"place of TARGETS is corrected in place: {PROGRAM}. Only numbers of its targets change. With --from and --to, "
        "the program alone comes first: casacal compensate PROGRAM --from RESULT --to RESULT --out FILE."
    )
    add(parser, *RESULT)
    add(parser, *INSTRUMENT)
    add(parser, "[TARGETS]", "CSV of joints (q1_deg,...) or of poses x_mm,y_mm,z_mm,qw,qx,qy,qz; or a robot program")
    add(parser, "--out FILE", "file for the corrected targets", required=True)
    add(parser, "--inverse", "the program was taught on the calibrated arm: bring it back to the nominal one")
    add(parser, "--from RESULT", "the arm that a program was taught on", dest="taught_on")
    add(parser, "--to RESULT", "the arm of the same type that it is to run on", dest="runs_on")
    add(parser, "--skip-unknown", "leave moves of a program that are not understood or not reached as they are")
    add(parser, "--diff", "print what changes in a program, as a unified diff")
    add_program(parser)
    add(parser, "--format", "default: csv", default="csv", choices=("csv", "rapid", "krl", "urscript"))
    add_frame(parser, "what goes where it was meant to go: the flange, or the tip that touches")
    words = "joint correction above which a target counts as a jump, degrees; default: 10"
    add(parser, "--largest DEG", words, kind=float, default=10.0)
    add(parser, *FORCE)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Compensate as the options say; returns 0, or 1 when a target is not reached."""
    from casacal.deployment.compensate import Outcome, compensate, read_targets
    from casacal.deployment.programs import notes, rounding_of, text_of
    from casacal.files import write_text

    if not 0 < options.largest < math.inf:
        raise CasacalError(
            f"--largest {options.largest:g} is not a joint motion", "Give degrees above zero, such as 10"
        )
    largest = math.radians(options.largest)
    if _is_for_program(options):
        return _run_program(options, largest)
    result = read_arm(options, options.targets)
    rounding = rounding_of(options.format, result.source.problem.robot)
    targets = read_targets(options.targets, result.source)
    compensation = compensate(
        result, targets, frame=options.frame, largest=largest, rounding=rounding, force=options.force
    )
    write_text(options.out, text_of(compensation, options.format, result))
    said, lost, left = [capital(note) for note in notes(compensation, result)], list[dict[str, Any]](), list[str]()
    for i, outcome in enumerate(compensation.outcomes):
        if outcome is not Outcome.REACHED:
            meaning, line = outcome.meaning, compensation.targets.lines[i]
            if outcome is Outcome.OUTSIDE:
                meaning += f" ({', '.join(_outside(compensation.start[i], result.source.problem.robot))})"
            miss = {"residual_mm": float(compensation.residual_mm[i])}
            miss["residual_mrad"] = 1e3 * float(compensation.residual_rad[i])
            lost.append({"line": line, "outcome": outcome.value, "meaning": meaning, **miss})
            left.append(f"Not reached: line {line}, {outcome.value}: {meaning}{compensation.left(i)}")
    if len(left) > SHOWN:
        left[SHOWN:] = [f"... and {len(left) - SHOWN} more; the file's column status names them all"]
    found = {"targets": len(targets), "missed": lost, "verdict": result.verdict, "notes": said}
    answer(options, {**found, "written": [options.out]}, *said, *left, f"Written: {options.out}")
    return FAILED if lost else DONE


def _outside(joints: Array, robot: Robot) -> Iterator[str]:
    """Words for each joint value (n,; rad, mm) that is outside its limits."""
    from casacal.deployment.compensate import ROUNDED

    ends = zip(joints.tolist(), *(limit.tolist() for limit in robot.limits), robot.axes, strict=True)
    for k, (q, low, high, axis) in enumerate(ends, 1):
        if not low - ROUNDED <= q <= high + ROUNDED:
            unit, name = (math.degrees(1), "degrees") if axis.turns else (1.0, "mm")
            yield f"q{k} is {q * unit:g} {name}, its limits {low * unit:g} to {high * unit:g}"


OF_PROGRAMS = ("inverse", "taught_on", "runs_on", "skip_unknown", "diff", *PROGRAM_OPTIONS)


def _is_for_program(options: argparse.Namespace) -> bool:
    """Whether the options are about a robot program; raises CasacalError where they are about both kinds of targets."""
    from casacal.programs.endings import ENDINGS, is_program

    spelled = {"taught_on": "from", "runs_on": "to", "skip_unknown": "skip-unknown"}
    wanted = [f"--{spelled.get(name, name)}" for name in OF_PROGRAMS if getattr(options, name)]
    moved = options.taught_on is not None or options.runs_on is not None
    named = options.result if moved and options.targets is None else options.targets
    if moved and (
        options.taught_on is None or options.runs_on is None or options.targets is not None or options.inverse
    ):
        fix = "Write casacal compensate PROGRAM --from RESULT --to RESULT --out FILE"
        raise CasacalError("--from and --to go together, with the program alone before them", fix)
    if named is None:
        raise CasacalError("There are no TARGETS", "Name the result and then targets or a program")
    if is_program(named):
        if options.format != "csv" or options.force:
            fix = "Leave it out: a program keeps its language, and none is forced"
            raise CasacalError("--format and --force are for lists of targets", fix)
        return True
    if wanted:
        fix = f"Name a file that ends in {', '.join(ENDINGS)}"
        raise CasacalError(f"{wanted[0]} is for a robot program, and '{named}' is none by its ending", fix)
    return False


def _run_program(options: argparse.Namespace, largest: float) -> int:
    """Correct a program in place; returns 0, or 1 where moves stay as they are."""
    from casacal.deployment.arm import for_instrument
    from casacal.deployment.result_file import read_result
    from casacal.programs.correct import compensate_program

    if options.taught_on is not None:
        path, onto = options.result, for_instrument(read_result(options.runs_on), options.instrument)
        spare([options.out], path, options.taught_on, options.runs_on, *made_from(onto))
        options.result = options.taught_on
    else:
        path, onto = options.targets, None
    result = read_arm(options, path)
    program, begin = read_program_of(options, path)
    outs = [Path(options.out).with_suffix(Path(each).suffix) for each in program.paths[1:]] + [Path(options.out)]
    if Path(options.out).suffix.lower() != Path(path).suffix.lower():
        raise CasacalError(f"'{options.out}' does not end in {Path(path).suffix}", "Name the program's own ending")
    spare(outs, *program.paths)
    corrected = compensate_program(
        result,
        program,
        frame=options.frame,
        inverse=options.inverse,
        onto=onto,
        begin=begin,
        largest=largest,
        skip_unknown=options.skip_unknown,
    )
    _write(corrected, outs)
    return _tell(options, (onto or result, result), corrected, [str(out) for out in reversed(outs)])


def _write(corrected: CorrectedProgram, outs: list[Path]) -> None:
    """Write the files of a program, all or none; the one that names it is the last of `outs`."""
    from casacal.files import place_whole, side_by_side

    data = [text.encode("latin-1") for text in (*corrected.texts[1:], corrected.texts[0])]
    if len(outs) == 1:
        place_whole(outs[0], lambda place: place.write_bytes(data[0]))
        return
    with side_by_side(outs) as places:
        for place, each in zip(places, data, strict=True):
            place.write_bytes(each)


def _tell(
    options: argparse.Namespace,
    arms: tuple[CalibratedArm, CalibratedArm],
    corrected: CorrectedProgram,
    written: list[str],
) -> int:
    """Print what was done to a program, for an arm and that which it was taught on; 1 where moves stay as they are."""
    from casacal.deployment.arm import FLANGE_UNKNOWN, PERHAPS_RADIANS, cautions, column_notes
    from casacal.deployment.programs import no_gain

    program, moves, left = corrected.program, list[dict[str, Any]](), list[dict[str, Any]]()
    done = [move for move in program.moves if corrected.reached[move.target]]
    numbers = {"correction_mm": corrected.correction_mm, "left_mm": corrected.left_mm}
    numbers |= {"correction_deg": corrected.correction_rad * math.degrees(1), "expected_mm": corrected.expected_mm}
    for move in sorted(done, key=lambda move: -corrected.correction_mm[move.target]):
        said_of = {"line": move.line, "motion": move.motion, "target": program.targets[move.target].name}
        moves.append(said_of | {name: float(values[move.target]) for name, values in numbers.items()})
    lost: list[tuple[Target | Puzzle, str]] = [(each, each.what) for each in program.puzzles]
    lost += [(program.targets[i], f"'{program.targets[i].name}': {why}") for i, why in corrected.why.items()]
    left += [{"line": at.line, "file": program.paths[at.file], "why": why} for at, why in lost]
    posed = any(target.kind == "pose" for target in program.targets)
    care = no_gain(corrected.correction_mm[corrected.reached], corrected.expected_mm[corrected.reached])
    care += dict.fromkeys(words for arm in arms for words in cautions(arm, posed=posed))
    if options.frame == "flange" and not all(arm.flange_known for arm in arms):
        care.append(FLANGE_UNKNOWN.partition(":")[0])
    care += column_notes(arms[0], corrected.missing, ())
    joints = [abs(value) for target in program.targets if target.kind == "joints" for value in target.values]
    if program.language != "urscript" and 0 < max(joints, default=0.0) <= math.tau:
        care.append(PERHAPS_RADIANS)
    diff = corrected.diff if options.diff else None
    found = {"moves": moves, "left": left, "unused": list(program.unused), "diff": diff}
    largest, missed = (
        f"{figures(float(values[corrected.reached].max(initial=0.0)), 2)} mm"
        for values in (corrected.correction_mm, corrected.left_mm)
    )
    count = f"{counted(len(moves), 'move')} to {counted(int(corrected.reached.sum()), 'target')}"
    said = [f"{count} corrected, by up to {largest}; as written they miss what was meant by up to {missed}"]
    for each in moves[:SHOWN_MOVES]:
        said.append(
            f"  line {each['line']:<6} {each['motion']:<7} {each['target']:<20} {each['correction_mm']:8.3f} mm"
            f" {each['correction_deg']:7.3f} deg"
            + (f"   expected error {each['expected_mm']:.3f} mm" if math.isfinite(each["expected_mm"]) else "")
        )
    said += [f"  ... and {len(moves) - SHOWN_MOVES} smaller ones (--json has all)"] if len(moves) > SHOWN_MOVES else []
    said += [f"Left as it is: {program.where(at)}, {why}" for at, why in lost[:SHOWN]]
    said += [f"... and {len(left) - SHOWN} more (--json has all)"] if len(left) > SHOWN else []
    said += [f"No move goes to {shortened(program.unused)}: left as they are"] if program.unused else []
    said += [*care, *([corrected.diff] if options.diff else []), f"Written: {', '.join(written)}"]
    answer(options, {**found, "verdict": arms[0].verdict, "notes": care, "written": written}, *said)
    return FAILED if left else DONE


SHOWN_MOVES = 10  # largest corrections that are told one by one

"""`casacal predict`: predict poses of the calibrated arm."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from casacal.cli.common import DONE, FAILED, FORCE, INSTRUMENT, JSON, RESULT, add, add_frame, read_arm
from casacal.cli.programs import PROGRAM, PROGRAM_OPTIONS, add_program, read_program_of
from casacal.cli.terminal import answer
from casacal.errors import CasacalError
from casacal.wording import counted, listed

if TYPE_CHECKING:
    from casacal.deployment.arm import CalibratedArm

HELP = "predict poses of the calibrated arm"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal predict`."""
    parser.description = (
        "Write the pose x_mm,y_mm,z_mm,qw,qx,qy,qz of a calibrated arm at each row of joint values, in the base frame. "
        "The flange is what robot.pose of the problem gives; the tip is where the instrument touches, including tool "
        "and, where JOINTS has that column, the reading. Exit 1, and no file, for a result that must not be "
        f"used, unless --force is given. Of a robot program in place of JOINTS, {PROGRAM}, it says move by move "
        "where the tool in force really goes, how far off that is, and the flange's standard deviation."
    )
    add(parser, *RESULT)
    add(parser, *INSTRUMENT)
    add(
        parser,
        "JOINTS",
        "CSV with the joint columns of a samples file, and those that tell an effect (torques); or a robot program",
    )
    add(parser, "--out FILE", "CSV of poses", required=True)
    add_frame(parser, "poses of the flange or of the tip")
    add(parser, "--std", "add a column std_mm: standard deviation of the position, apart from the pose of the base")
    add_program(parser)
    add(parser, "--nominal", "use the arm as drawn, not as calibrated")
    add(parser, *FORCE)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Predict as the options say; returns 0."""
    from casacal.deployment.arm import FLANGE_UNKNOWN, cautions, column_notes, unit_notes
    from casacal.deployment.compensate import ROUNDED
    from casacal.deployment.predict import joints_from, predict, write_prediction
    from casacal.model.robot import inside_limits
    from casacal.programs.endings import is_program

    result = read_arm(options, options.joints)
    if is_program(options.joints):
        return _run_program(options, result)
    if given := [name for name in PROGRAM_OPTIONS if getattr(options, name)]:
        raise CasacalError(f"--{given[0]} is for a robot program", "Leave it out for a table of joints")
    joints = joints_from(options.joints, result.source)
    nominal = options.nominal
    prediction = predict(result, joints, frame=options.frame, nominal=nominal, std=options.std, force=options.force)
    robot, rows = result.source.problem.robot, joints.joints
    said = unit_notes(robot, rows)
    if beyond := (~inside_limits(robot, rows, slack=ROUNDED)).nonzero()[0].tolist():
        where = f"{len(beyond)} of {counted(len(rows), 'posture')} outside the joint limits, the first in line"
        said.append(f"warning: {where} {joints.lines[beyond[0]]}: are unit and zeros those of the problem?")
    said += [] if nominal else column_notes(result, prediction.missing, prediction.beyond)
    care = [] if nominal else cautions(result)
    if options.std and options.frame == "flange" and not result.flange_known:
        care.append(FLANGE_UNKNOWN)
    write_prediction(
        options.out, prediction, ["Of the arm as drawn, not as calibrated."] if nominal else [*care, *said]
    )
    if prediction.unseen:
        said.append(
            f"warning: the calibration saw no session {listed(prediction.unseen)}, so where the dial's zero then "
            "stood is known by its prior alone (--std shows it)"
        )
    if result.denial is not None and not nominal:
        said.append(result.denial)
    said += care
    found = {
        "unseen": list(prediction.unseen),
        "missing": {words: list(names) for words, names in prediction.missing.items()},
        "beyond": list(prediction.beyond),
        "poses": len(prediction),
        "frame": options.frame,
        "nominal": nominal,
        "verdict": result.verdict,
        "written": [options.out],
        "notes": said,
    }
    answer(options, found, f"Written: {options.out} ({counted(len(prediction), 'pose')} of the {options.frame})", *said)
    return DONE


def _run_program(options: argparse.Namespace, result: CalibratedArm) -> int:
    """Predict the moves of a program; returns 1 where some are not understood or not reached, else 0."""
    from casacal.deployment.arm import FLANGE_UNKNOWN, cautions, column_notes
    from casacal.programs.correct import predict_program, write_program_prediction

    if options.nominal or options.frame != "flange":
        raise CasacalError("--nominal and --frame are for tables of joints", "A program's own tools are predicted")
    program, begin = read_program_of(options, options.joints)
    run, prediction = predict_program(result, program, begin=begin, force=options.force)
    care = [*cautions(result), *column_notes(result, prediction.missing, prediction.beyond)]
    care += [] if result.flange_known or result.denial is not None else [FLANGE_UNKNOWN.partition(":")[0]]
    write_program_prediction(options.out, run, prediction, care)
    lost = [f"{program.where(each)}: {each.what}" for each in program.puzzles]
    lost += [f"{program.where(program.targets[i])}: '{program.targets[i].name}': {why}" for i, why in run.why.items()]
    said = [f"No pose: {each}" for each in lost[:5]]
    said += [f"... and {len(lost) - 5} more"] if len(lost) > 5 else []
    notes = [*([] if result.denial is None else [result.denial]), *care]
    moves = sum(move.target not in run.why for move in program.moves)
    found = {"poses": moves, "left": lost, "verdict": result.verdict, "written": [options.out], "notes": notes}
    answer(options, found, f"Written: {options.out} ({counted(moves, 'move')})", *said, *notes)
    return FAILED if lost else DONE

"""`casacal compensate`: correct joint targets for the calibrated arm, with their proof."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from casacal.cli.common import DONE, FAILED, add, add_force, add_instrument, add_json, add_result, made_from, spare
from casacal.cli.terminal import say_json, say_paragraph

if TYPE_CHECKING:
    from casacal.compensation.targets import Compensation

HELP = "correct joint targets for the calibrated arm"
SHOWN = 5
"""Targets not reached that are named one by one."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal compensate` takes."""
    parser.description = (
        "Write joint targets that bring the calibrated robot to the poses meant for the nominal one. Joint targets "
        "keep their branch. Pose targets (with a column qw) take the branch of the joint columns beside them; without "
        "such columns each takes the posture nearest to that of the row before, and the first the one nearest to the "
        "middle of the joints' ranges. Exit 1 if a target is not reached; every row is written."
    )
    add_result(parser)
    add_instrument(parser, "instrument whose tip is meant; default: the first")
    add(parser, "TARGETS", "CSV of joints (q1_deg,...) or of poses x_mm,y_mm,z_mm,qw,qx,qy,qz")
    add(parser, "--out FILE", "file for the corrected targets", required=True)
    add(parser, "--format", "default: csv", default="csv", choices=("csv", "rapid", "krl", "urscript"))
    add(
        parser,
        "--frame",
        "pose targets are of the flange, or of the tip that touches; default: flange",
        default="flange",
        choices=("flange", "tip"),
    )
    add(
        parser,
        "--largest DEG",
        "joint correction above which a target counts as a jump, degrees; default: 10",
        kind=float,
        default=10.0,
    )
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Compensate as the options say; returns 0, or 1 when a target is not reached."""
    from casacal.compensation.compensate import compensate
    from casacal.compensation.programs import notes, rounding_of, text_of
    from casacal.compensation.result_file import read_result, verdict_part
    from casacal.compensation.seen_by import seen_by
    from casacal.compensation.targets import Outcome, read_targets
    from casacal.errors import CasacalError
    from casacal.files import write_text

    if not 0 < options.largest < math.inf:
        raise CasacalError(
            f"--largest {options.largest:g} is not a joint motion", "Give degrees above zero, such as 10"
        )
    spare([options.out], options.result, options.targets)
    result = seen_by(read_result(options.result), options.instrument)
    spare([options.out], *made_from(result))
    rounding = rounding_of(options.format, result.source.problem.robot)
    targets = read_targets(options.targets, result.source)
    compensation = compensate(
        result,
        targets,
        frame=options.frame,
        largest=math.radians(options.largest),
        rounding=rounding,
        force=options.force,
    )
    write_text(options.out, text_of(compensation, options.format, result))
    missed = [i for i, outcome in enumerate(compensation.outcomes) if outcome is not Outcome.REACHED]
    lost = [_lost(compensation, i) for i in missed]
    said = [f"{note[0].upper()}{note[1:]}" for note in notes(compensation, result)]
    if options.json:
        verdict = verdict_part(result)
        say_json({"targets": len(targets), "missed": lost, "verdict": verdict, "notes": said, "written": [options.out]})
        return FAILED if missed else DONE
    said += [
        f"Not reached: line {one['line']}, {one['outcome']}: {one['meaning']}; {one['residual_mm']:.3f} mm and "
        f"{one['residual_mrad']:.3f} mrad remain at the {compensation.frame}"
        for one in lost[:SHOWN]
    ]
    if len(missed) > SHOWN:
        said.append(f"... and {len(missed) - SHOWN} more; the file's column status names them all")
    for sentence in (*said, f"Written: {options.out}"):
        say_paragraph(sentence)
    return FAILED if missed else DONE


def _lost(compensation: Compensation, i: int) -> dict[str, Any]:
    """A target that is not reached."""
    outcome = compensation.outcomes[i]
    return {
        "line": compensation.targets.lines[i],
        "outcome": outcome.value,
        "meaning": outcome.meaning,
        "residual_mm": float(compensation.residual_mm[i]),
        "residual_mrad": 1e3 * float(compensation.residual_rad[i]),
    }

"""`casacal compensate`: correct joint targets for the calibrated arm, with their proof."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from casacal.cli.common import DONE, FAILED, FORCE, INSTRUMENT, JSON, RESULT, add, add_frame, read_arm
from casacal.cli.terminal import say_json, say_paragraphs

if TYPE_CHECKING:
    from casacal.compensation.targets import Compensation
    from casacal.robots.robot import Robot

HELP = "correct joint targets for the calibrated arm"
SHOWN = 5  # targets not reached that are named one by one


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal compensate` takes."""
    parser.description = (
        "Write joint targets that bring the calibrated robot to the poses meant for the nominal one. Joint targets "
        "keep their branch. Pose targets (with a column qw) take the branch of the joint columns beside them; without "
        "such columns each takes the posture nearest to that of the row before, and the first the one nearest to the "
        "middle of the joints' ranges. Exit 1 if a target is not reached; every row is written."
    )
    add(parser, *RESULT)
    add(parser, *INSTRUMENT)
    add(parser, "TARGETS", "CSV of joints (q1_deg,...) or of poses x_mm,y_mm,z_mm,qw,qx,qy,qz")
    add(parser, "--out FILE", "file for the corrected targets", required=True)
    add(parser, "--format", "default: csv", default="csv", choices=("csv", "rapid", "krl", "urscript"))
    add_frame(parser, "what goes where it was meant to go: the flange, or the tip that touches")
    words = "joint correction above which a target counts as a jump, degrees; default: 10"
    add(parser, "--largest DEG", words, kind=float, default=10.0)
    add(parser, *FORCE)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Compensate as the options say; returns 0, or 1 when a target is not reached."""
    from casacal.compensation.compensate import compensate
    from casacal.compensation.programs import notes, rounding_of, text_of
    from casacal.compensation.targets import Outcome, read_targets
    from casacal.errors import CasacalError
    from casacal.files import write_text

    if not 0 < options.largest < math.inf:
        fix = "Give degrees above zero, such as 10"
        raise CasacalError(f"--largest {options.largest:g} is not a joint motion", fix)
    result = read_arm(options, options.targets)
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
    lost = [_lost(compensation, i, result.source.problem.robot) for i in missed]
    said = [f"{note[0].upper()}{note[1:]}" for note in notes(compensation, result)]
    if options.json:
        counts = {"targets": len(targets), "missed": lost, "verdict": result.verdict}
        say_json({**counts, "notes": said, "written": [options.out]})
        return FAILED if missed else DONE
    said += [
        f"Not reached: line {one['line']}, {one['outcome']}: {one['meaning']}{compensation.left(i)}"
        for i, one in zip(missed[:SHOWN], lost, strict=False)
    ]
    if len(missed) > SHOWN:
        said.append(f"... and {len(missed) - SHOWN} more; the file's column status names them all")
    say_paragraphs(*(*said, f"Written: {options.out}"))
    return FAILED if missed else DONE


def _lost(compensation: Compensation, i: int, robot: Robot) -> dict[str, Any]:
    """A target that is not reached."""
    from casacal.compensation.compensate import ROUNDED
    from casacal.compensation.targets import Outcome

    outcome, which = compensation.outcomes[i], ""
    if outcome is Outcome.OUTSIDE:
        ends = zip(compensation.start[i].tolist(), *(limit.tolist() for limit in robot.limits), robot.axes, strict=True)
        shown = [
            f"q{k} is {q * unit:g} {name}, its limits {low * unit:g} to {high * unit:g}"
            for k, (q, low, high, axis) in enumerate(ends, 1)
            for unit, name in [(math.degrees(1), "degrees") if axis.turns else (1.0, "mm")]
            if not low - ROUNDED <= q <= high + ROUNDED
        ]
        which = f" ({', '.join(shown)})"
    return {
        "line": compensation.targets.lines[i],
        "outcome": outcome.value,
        "meaning": f"{outcome.meaning}{which}",
        "residual_mm": float(compensation.residual_mm[i]),
        "residual_mrad": 1e3 * float(compensation.residual_rad[i]),
    }

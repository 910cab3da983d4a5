"""`casacal compensate`: joint targets at which the calibrated arm hits the poses, with their proof."""

from __future__ import annotations

import argparse
import math

from casacal.cli.common import DONE, FAILED, add_result

HELP = "joint targets at which the calibrated arm hits the poses"
SHOWN = 5
"""Targets not reached that are named one by one."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal compensate` takes."""
    parser.description = (
        "Write joint targets for which the calibrated robot takes the poses that the nominal one was meant to take. "
        "Joint targets keep their branch. Pose targets (a column qw) take the branch of joint columns beside them; "
        "without, each takes the posture nearest to that of the row before, the first the one nearest to mid-range. "
        "Exit 1 when a target is not reached; all rows are written."
    )
    add_result(parser)
    parser.add_argument(
        "targets", metavar="TARGETS", help="CSV of joints (q1_deg,...) or of poses x_mm,y_mm,z_mm,qw,qx,qy,qz"
    )
    parser.add_argument("--out", required=True, metavar="FILE", help="corrected targets")
    parser.add_argument("--format", choices=("csv", "rapid", "krl", "urscript"), default="csv", help="default: csv")
    parser.add_argument("--frame", choices=("flange", "tip"), default="flange", help="of poses; default: flange")
    parser.add_argument(
        "--largest", type=float, default=10.0, metavar="DEG", help="joint motion above which it is a jump; default: 10"
    )


def run(options: argparse.Namespace) -> int:
    """Compensate as the options say; returns 0, or 1 when a target is not reached."""
    from casacal.compensation.compensate import compensate
    from casacal.compensation.outcome import Outcome
    from casacal.compensation.programs import notes, rounding_of, text_of
    from casacal.compensation.result_file import read_result
    from casacal.compensation.targets import read_targets
    from casacal.errors import CasacalError
    from casacal.files import write_text

    if not 0 < options.largest < math.inf:
        raise CasacalError(f"--largest {options.largest:g} is no joint motion", "Give degrees above zero, such as 10")
    result = read_result(options.result)
    rounding = rounding_of(options.format, result.source.problem.robot)
    targets = read_targets(options.targets, result.source)
    compensation = compensate(
        result, targets, frame=options.frame, largest=math.radians(options.largest), rounding=rounding
    )
    write_text(options.out, text_of(compensation, options.format, result))
    for note in notes(compensation, result):
        print(f"{note[0].upper()}{note[1:]}")
    missed = [i for i, outcome in enumerate(compensation.outcomes) if outcome is not Outcome.REACHED]
    for i in missed[:SHOWN]:
        outcome = compensation.outcomes[i]
        print(
            f"Not reached: line {targets.lines[i]}, {outcome.value}: {outcome.meaning}; "
            f"{compensation.residual_mm[i]:.3f} mm and {1e3 * compensation.residual_rad[i]:.3f} mrad remain"
        )
    if len(missed) > SHOWN:
        print(f"... and {len(missed) - SHOWN} more; the file's column status names them all")
    print(f"Written: {options.out}")
    return FAILED if missed else DONE

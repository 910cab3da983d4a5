"""`casacal compensate`: correct joint targets for the calibrated arm, with their proof."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from casacal.cli.common import DONE, FAILED, FORCE, INSTRUMENT, JSON, RESULT, add, add_frame, read_arm
from casacal.cli.terminal import answer
from casacal.errors import CasacalError
from casacal.wording import capital

if TYPE_CHECKING:
    from casacal.model.robot import Robot
    from casacal.values import Array

HELP = "correct joint targets for the calibrated arm"
SHOWN = 5  # targets not reached that are named one by one


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal compensate`."""
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
    from casacal.deployment.compensate import Outcome, compensate, read_targets
    from casacal.deployment.programs import notes, rounding_of, text_of
    from casacal.files import write_text

    if not 0 < options.largest < math.inf:
        raise CasacalError(
            f"--largest {options.largest:g} is not a joint motion", "Give degrees above zero, such as 10"
        )
    result = read_arm(options, options.targets)
    rounding = rounding_of(options.format, result.source.problem.robot)
    targets = read_targets(options.targets, result.source)
    largest = math.radians(options.largest)
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

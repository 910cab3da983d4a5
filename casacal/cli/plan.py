"""`casacal plan`: which touches to make, and what they will bring."""

from __future__ import annotations

import argparse
from pathlib import Path

from casacal.cli.common import DONE, add_json, add_problem, box_of, spare, whole_number
from casacal.cli.terminal import say_json, say_paragraph
from casacal.errors import CasacalError

HELP = "which touches to make, and what they will bring"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal plan` takes."""
    parser.description = (
        "Choose the touches that leave the least error of the tip, among many that the arm as drawn can make in the "
        "problem's cell, and write them in the order of a short way. Some repeat others, some are kept to verify."
    )
    add_problem(parser)
    parser.add_argument("--out", required=True, metavar="FILE", help="plan to write, such as plan.csv")
    parser.add_argument("--touches", type=whole_number, metavar="N", help="how many in all; default: 60")
    parser.add_argument(
        "--tolerance",
        type=float,
        metavar="MM",
        help="in place of --touches: as many as it takes to expect this tip error",
    )
    parser.add_argument("--box", metavar="X0:X1,Y0:Y1,Z0:Z1", help="where the tip is wanted, mm, base frame")
    parser.add_argument("--targets", metavar="FILE", help="joint values at which it is wanted, in place of a box")
    parser.add_argument(
        "--pool", type=whole_number, default=3000, metavar="N", help="among how many is chosen; default: 3000"
    )
    parser.add_argument("--check", type=float, default=0.15, metavar="F", help="part kept to verify; default: 0.15")
    parser.add_argument("--again", type=float, default=0.05, metavar="F", help="part that repeats; default: 0.05")
    parser.add_argument("--seed", type=whole_number, default=0, metavar="K", help="of all that is drawn; default: 0")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Plan as the options say; returns 0."""
    from casacal.compensation.predict import read_joints
    from casacal.planning.plan import plan, touches_for
    from casacal.planning.written import write_plan
    from casacal.problem.problem_file import load_problem

    if options.touches is not None and options.tolerance is not None:
        raise CasacalError("--touches and --tolerance came", "Give one of them")
    source = load_problem(options.problem)
    if len(source.problem.instruments) == 1:
        spare([options.out], *(file.path for file in source.files), source.samples, options.targets)
    box = None if options.box is None else box_of(options.box)
    targets = None if options.targets is None else read_joints(options.targets, source).joints
    touches = 60 if options.touches is None else options.touches
    if options.tolerance is not None:
        fitted = touches_for(source.problem, source.cell, options.tolerance, box=box, targets=targets)
        touches = round(fitted / max(1 - options.check - options.again, 0.1))
    found = plan(
        source.problem,
        source.cell,
        touches=touches,
        pool=options.pool,
        again=options.again,
        check=options.check,
        box=box,
        targets=targets,
        seed=options.seed,
    )
    write_plan(options.out, found, source.problem.layout(), source.name)
    place = Path(options.out).as_posix()
    if options.json:
        counts = {purpose: found.purposes.count(purpose) for purpose in dict.fromkeys(found.purposes)}
        errors = {"expected": found.error, "at_random": found.at_random, "before": found.before, "of_all": found.best}
        curve = [{"touches": count, "expected_mm": error} for count, error in found.curve.items()]
        say_json({"touches": counts, "tip_rms_mm": errors, "curve": curve, "written": [place]})
        return DONE
    fitted, check, again = (found.purposes.count(purpose) for purpose in ("fit", "check", "again"))
    say_paragraph(f"{len(found)} touches: {fitted} to fit, {again} of them once more, {check} kept to verify")
    say_paragraph(
        f"Expect a tip error of {found.error:.3g} mm RMS {_where(options)}, apart from where the base stands, if "
        f"stated noise and priors are right. Priors alone: {found.before:.3g} mm; as many at random: "
        f"{found.at_random:.3g} mm; all {options.pool} that were looked at: {found.best:.3g} mm"
    )
    left = ", ".join(f"{count} {error:.3g}" for count, error in found.curve.items())
    say_paragraph(f"Fitted touches and what they leave, mm: {left}")
    say_paragraph(f"Written: {place}")
    return DONE


def _where(options: argparse.Namespace) -> str:
    if options.box is not None:
        return "inside the box"
    return "over the workspace" if options.targets is None else "at the targets"

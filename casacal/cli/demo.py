"""`casacal demo`: the whole way on a simulated arm, from a data sheet to corrected targets, by the other commands."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from casacal.cli.common import DONE, add, whole_number
from casacal.cli.terminal import say, say_paragraphs
from casacal.errors import CasacalError

HELP = "run the full workflow on a simulated arm"

SHEET = """# written by casacal demo
# name: UR5
# convention: standard
joint,alpha_deg,a_mm,d_mm,theta_deg,lower_deg,upper_deg
1,90,0,89.159,0,-180,180
2,0,-425,0,0,-180,0
3,0,-392.25,0,0,-150,150
4,90,0,109.15,0,-180,180
5,-90,0,94.65,0,-180,180
6,0,0,82.3,0,-180,180
"""
"""DH table of the UR5, as Universal Robots publish it."""

TARGETS = """# written by casacal demo
q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg
30,-70,80,-100,-90,0
45,-80,95,-105,-90,15
"""

STEPS = {
    "A problem from the data sheet": (
        "new ur5 --dh {0}/ur5.csv --tool 0,0,120 --sign -1 --travel 10 --accuracy 1 --out {0}"
    ),
    "What to touch, and what that will be worth": "plan {0}/ur5 --touches 80 --out {0}/plan.csv",
    "Touches, here by a simulated arm": "simulate {0}/ur5 --plan {0}/plan.csv --seed {1} --out {0}/ur5/samples.csv",
    "Mistakes in the samples": "check {0}/ur5",
    "The calibration": "calibrate {0}/ur5 --out {0}/fit",
    "Was the promise kept, by touches that were not fitted": (
        "verify {0}/fit/result.json {0}/ur5/samples_check.csv --into-report"
    ),
    "Targets for the true arm": (
        "compensate {0}/fit/result.json {0}/targets.csv --format urscript --out {0}/ur5.script"
    ),
}
"""Purpose of each command, and the command with {0} for the folder and {1} for the seed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal demo`."""
    parser.description = (
        "Make a problem from a data sheet, plan touches, simulate some, calibrate, and correct targets. Every step is "
        "a command that is shown, so that you can repeat it with your own arm."
    )
    add(parser, "--out DIR", "folder to make; default: casacal_demo", default="casacal_demo")
    add(parser, "--seed K", "seed of the arm and its touches; default: 0", kind=whole_number, default=0)


def run(options: argparse.Namespace) -> int:
    """Run the steps one after the other; returns 0, or the code of the first that fails."""
    from casacal.files import writable

    out = Path(options.out)
    folder = f"./{out.as_posix()}" if options.out.startswith("-") else out.as_posix()  # which is no option
    if out.exists():
        raise CasacalError(f"'{options.out}' exists already", "Name another folder with --out, or remove it first")
    with writable(out):
        out.mkdir(parents=True)
        (out / "ur5.csv").write_text(SHEET, encoding="utf-8")
        (out / "targets.csv").write_text(TARGETS, encoding="utf-8")
    for purpose, step in STEPS.items():
        typed = [part.format(folder, options.seed) for part in step.split()]
        say(f"\n# {purpose}\n$ {shlex.join(['casacal', *typed])}")
        below = options.whole().parse_args(typed)
        below.typed, below.whole = shlex.join(["casacal", *typed]), options.whole
        if code := int(below.run(below)):
            return code
    say()
    say_paragraphs(f"Look at {(out / 'fit' / 'report.html').as_posix()} in a browser")
    return DONE

"""`casacal calibrate`: fit the arm's parameters to samples, and say how far to trust them."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.cli.common import DONE, FAILED, add_problem, add_samples, samples_of
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.problem.problem import Problem
    from casacal.uncertainty.expectation import Box

HELP = "fit the arm's parameters to samples"
METHOD_NAMES = ("lm", "sckf", "sckf-lm", "ekf", "annealing", "swarm", "evolution", "ipopt", "plane-only")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal calibrate` takes."""
    parser.description = "Fit the arm's parameters to samples, and cross-check the minimum with IPOPT."
    add_problem(parser)
    add_samples(parser)
    parser.add_argument("--method", choices=METHOD_NAMES, default="sckf-lm", help="default: sckf-lm")
    parser.add_argument("--holdout", type=float, default=0.0, metavar="F", help="part of each plane's rows to hold out")
    parser.add_argument("--seed", type=int, default=0, metavar="K", help="of held-out rows and of random methods")
    parser.add_argument("--fix", action="append", default=[], metavar="NAMES", help="hold at nominal: alpha,a3,...")
    parser.add_argument(
        "--prior", action="append", default=[], metavar="NAME=STD", help="prior standard deviation, mm or rad, or inf"
    )
    parser.add_argument("--accuracy", type=float, metavar="MM", help="maker's accuracy: scale the arm's priors to it")
    parser.add_argument("--loss", choices=("huber", "tukey"), help="robust against gross rows; with --method lm")
    parser.add_argument(
        "--box", metavar="X0:X1,Y0:Y1,Z0:Z1", help="also say what tip error to expect inside this box, mm, base frame"
    )
    parser.add_argument("--no-reference", action="store_true", help="skip the cross-check")
    parser.add_argument(
        "--backend", choices=("auto", "c", "blocks"), help="what evaluates rows; default: CASACAL_BACKEND, else auto"
    )
    parser.add_argument(
        "--out", metavar="DIR", help="write report.html, result.json, parameters.csv and pictures there"
    )


def run(options: argparse.Namespace) -> int:
    """Calibrate as the options say; returns 0, or 1 when the result fails."""
    from casacal.calibration.calibrate import calibrate
    from casacal.calibration.summary import summary
    from casacal.least_squares.losses import huber, tukey
    from casacal.problem.problem_file import load_problem
    from casacal.uncertainty.expectation import accuracy_in_box

    source = load_problem(options.problem)
    problem = _adjusted(source.problem, options.fix, options.prior, options.accuracy)
    samples = problem.read(samples_of(source, options.samples), readings=options.readings, key=options.id)
    box = None if options.box is None else _box(options.box)
    with _Progress(options.method) as progress:
        calibration = calibrate(
            problem,
            samples,
            method=options.method,
            holdout=options.holdout,
            seed=options.seed,
            reference=not options.no_reference,
            loss={"huber": huber(), "tukey": tukey()}.get(options.loss),
            backend=options.backend,
            progress=progress,
        )
    print(summary(calibration, source.name), end="")
    if box is not None:
        rms, worst = accuracy_in_box(calibration.fit, calibration.result.x, box)
        print(f"\nExpected tip error inside {options.box} mm: {rms:.3f} mm RMS, {worst:.3f} mm at worst.")
    if options.out is not None:
        from casacal.calibration.result_json import write_calibration

        paths = write_calibration(calibration, Path(options.out), command=options.typed, box=box)
        print(f"\nWritten: {', '.join(path.as_posix() for path in paths)}")
    return DONE if calibration.passed else FAILED


def _box(text: str) -> Box:
    try:
        ranges = [tuple(float(value) for value in part.split(":")) for part in text.split(",")]
        (x0, x1), (y0, y1), (z0, z1) = ranges
    except ValueError:
        raise CasacalError(f"--box {text} is not X0:X1,Y0:Y1,Z0:Z1", "Give three ranges in mm") from None
    return (x0, x1), (y0, y1), (z0, z1)


def _adjusted(problem: Problem, fixed: Sequence[str], priors: Sequence[str], accuracy: float | None) -> Problem:
    if accuracy is not None:
        from casacal.uncertainty.priors import scaled_to_accuracy

        problem = scaled_to_accuracy(problem, accuracy)
    stds = {}
    for setting in priors:
        name, equals, number = setting.partition("=")
        try:
            stds[name.strip()] = float(number)
        except ValueError:
            equals = ""
        if not equals or math.isnan(stds.get(name.strip(), math.nan)):
            raise CasacalError(f"--prior {setting} is not NAME=STD", "Give mm or rad, such as a3=0.5 or alpha=0.001")
    problem = problem.with_prior(stds)
    names = [name.strip() for group in fixed for name in group.split(",") if name.strip()]
    return problem.fix(*names)


class _Progress:
    """A line on standard error, from the second second on, and only where someone looks."""

    def __init__(self, method: str) -> None:
        self.method, self.began, self.shown = method, time.monotonic(), 0.0

    def __enter__(self) -> _Progress:
        return self

    def __call__(self, step: int, value: float) -> None:
        now = time.monotonic()
        if now - self.began > 1.0 and now - self.shown > 0.5 and sys.stderr.isatty():
            self.shown = now
            print(f"\r{self.method}: step {step}, {value:.6g}   ", end="", file=sys.stderr, flush=True)

    def __exit__(self, *_: object) -> None:
        if self.shown:
            print(file=sys.stderr)

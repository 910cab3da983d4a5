"""The command line. Modules are imported by the command that needs them, so that --help answers at once."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.cells import Cell
    from casacal.files import ProblemFile
    from casacal.problem import Problem

DONE, FAILED, BAD_INPUT = 0, 1, 2
METHOD_NAMES = ("lm", "sckf", "sckf-lm", "ekf", "ipopt", "plane-only")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 done, 1 not converged or a check failed, 2 bad input."""
    try:
        options = _parser().parse_args(arguments)
        return int(options.command(options))
    except CasacalError as error:
        print(f"casacal: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        sys.stderr.close()
        return FAILED


class _Parser(argparse.ArgumentParser):
    """Refuses in one line, as every other refusal of casacal."""

    def error(self, message: str) -> NoReturn:
        raise CasacalError(f"{self.prog}: {message}", f"See {self.prog} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="casacal", description="Calibrate a robot arm with a dial indicator and a flat face.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    _add_calibrate(commands.add_parser("calibrate", help="fit the arm's parameters to samples"))
    _add_simulate(commands.add_parser("simulate", help="samples of a simulated cell, with the truth behind them"))
    _add_check(commands.add_parser("check", help="what is wrong with samples, before anyone trusts a fit"))
    _add_predict(commands.add_parser("predict", help="poses of a calibrated arm at joint values"))
    return parser


def _add_calibrate(parser: argparse.ArgumentParser) -> None:
    parser.description = "Fit the arm's parameters to samples, and cross-check the minimum with IPOPT."
    parser.add_argument("problem", metavar="PROBLEM", help="a folder with a problem.py, or such a file")
    parser.add_argument("samples", metavar="SAMPLES", nargs="?", help="CSV; default: samples.csv beside the problem")
    parser.add_argument("--method", choices=METHOD_NAMES, default="sckf-lm", help="default: sckf-lm")
    parser.add_argument("--holdout", type=float, default=0.0, metavar="F", help="part of each plane's rows to hold out")
    parser.add_argument("--seed", type=int, default=0, metavar="K", help="of the choice of held-out rows")
    parser.add_argument("--fix", action="append", default=[], metavar="NAMES", help="hold at nominal: alpha,a3,...")
    parser.add_argument(
        "--prior", action="append", default=[], metavar="NAME=STD", help="prior standard deviation, mm or rad, or inf"
    )
    parser.add_argument("--no-reference", action="store_true", help="skip the cross-check")
    parser.add_argument("--out", metavar="DIR", help="write result.json, parameters.csv and pictures there")
    parser.set_defaults(command=_calibrate)


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    parser.description = "Let a simulated arm, drawn from the problem's prior, touch the faces of a cell."
    parser.add_argument("problem", metavar="PROBLEM", help="a folder with a problem.py, or such a file")
    parser.add_argument("--out", required=True, metavar="FILE", help="samples CSV; the truth goes to FILE.truth.json")
    parser.add_argument("--samples", type=int, default=120, metavar="N", help="default: 120")
    parser.add_argument("--seed", type=int, default=0, metavar="K")
    numbers = {
        "tilt": ("DEG", "largest angle between plunger and face normal"),
        "travel": ("MM", "range of the dial"),
        "repeatability": ("MM", "standard deviation of the reading, or of the touch without a dial"),
        "resolution": ("MM", "step of the dial's display, 0 for none"),
        "joint-std": ("RAD", "standard deviation of joint repeatability"),
        "flatness": ("MM", "peak-to-valley form error of the faces"),
        "compliance": ("MM", "sag of the tip under gravity, RMS"),
        "outliers": ("F", "fraction of gross rows"),
        "outlier-size": ("MM", "their size"),
        "error-scale": ("X", "size of the true errors in prior standard deviations"),
    }
    for name, (unit, words) in numbers.items():
        parser.add_argument(f"--{name}", type=float, metavar=unit, help=words)
    parser.set_defaults(command=_simulate)


def _add_check(parser: argparse.ArgumentParser) -> None:
    parser.description = "Say what is wrong, weak or worth knowing about samples; exit 1 when a result would be wrong."
    parser.add_argument("problem", metavar="PROBLEM", help="a folder with a problem.py, or such a file")
    parser.add_argument("samples", metavar="SAMPLES", nargs="?", help="CSV; default: samples.csv beside the problem")
    parser.set_defaults(command=_check)


def _add_predict(parser: argparse.ArgumentParser) -> None:
    parser.description = "Write the pose x_mm,y_mm,z_mm,qw,qx,qy,qz of a calibrated arm at each row of joint values."
    parser.add_argument("result", metavar="RESULT", help="result.json of calibrate, or truth.json of simulate")
    parser.add_argument("joints", metavar="JOINTS", help="CSV with the joint columns of a samples file")
    parser.add_argument("--out", required=True, metavar="FILE", help="CSV of poses")
    parser.add_argument("--frame", choices=("flange", "tip"), default="flange", help="default: flange")
    parser.add_argument("--nominal", action="store_true", help="the arm as drawn, not as calibrated")
    parser.set_defaults(command=_predict)


def _calibrate(options: argparse.Namespace) -> int:
    from casacal.calibration import calibrate
    from casacal.files import load_problem
    from casacal.report import summary

    source = load_problem(options.problem)
    problem = _adjusted(source.problem, options.fix, options.prior)
    samples = problem.read(_samples_of(source, options.samples))
    with _Progress(options.method) as progress:
        calibration = calibrate(
            problem,
            samples,
            method=options.method,
            holdout=options.holdout,
            seed=options.seed,
            reference=not options.no_reference,
            progress=progress,
        )
    print(summary(calibration, source.name), end="")
    if options.out is not None:
        from casacal.documents import write_calibration

        paths = write_calibration(calibration, source, Path(options.out))
        print(f"\nWritten: {', '.join(path.as_posix() for path in paths)}")
    return DONE if calibration.passed else FAILED


def _simulate(options: argparse.Namespace) -> int:
    from casacal.documents import write_simulation
    from casacal.files import load_problem
    from casacal.simulation import simulate

    source = load_problem(options.problem)
    cell = _cell(source, options)
    simulation = simulate(source.problem, cell, samples=options.samples, seed=options.seed)
    paths = write_simulation(simulation, source, Path(options.out))
    faces = ", ".join(face.label for face in cell.faces)
    print(
        f"Simulated, not measured: {options.samples} samples on {faces} at tilts up to {math.degrees(cell.tilt):g} deg"
    )
    print(f"Written: {', '.join(path.as_posix() for path in paths)}")
    return DONE


def _cell(source: ProblemFile, options: argparse.Namespace) -> Cell:
    from dataclasses import replace

    from casacal.simulation import default_cell

    cell = source.cell if source.cell is not None else default_cell(source.problem)
    names = (
        "travel",
        "repeatability",
        "resolution",
        "joint_std",
        "flatness",
        "compliance",
        "outliers",
        "outlier_size",
        "error_scale",
    )
    given = {name: value for name in names if (value := getattr(options, name)) is not None}
    if options.tilt is not None:
        given["tilt"] = math.radians(options.tilt)
    return replace(cell, **given)


def _check(options: argparse.Namespace) -> int:
    from casacal.doctor import check
    from casacal.files import load_problem

    source = load_problem(options.problem)
    samples = source.problem.read(_samples_of(source, options.samples), absurd=True)
    findings = check(source.problem, samples)
    for finding in findings:
        print(finding)
    counts = {word: sum(f.severity == word for f in findings) for word in ("error", "warning", "remark")}
    said = ", ".join(f"{count} {word}{'s' if count != 1 else ''}" for word, count in counts.items())
    print(f"{len(samples)} samples of {samples.file}: {said}")
    return FAILED if counts["error"] else DONE


def _samples_of(source: ProblemFile, given: str | None) -> str:
    if given is None and not source.samples.is_file():
        raise CasacalError(f"{source.path} has no samples.csv beside it", "Name a samples file")
    return given or source.samples.as_posix()


def _predict(options: argparse.Namespace) -> int:
    from casacal.prediction import predict, read_joints, read_result, write_prediction

    result = read_result(options.result)
    prediction = predict(
        result, read_joints(options.joints, result.source), frame=options.frame, nominal=options.nominal
    )
    write_prediction(options.out, prediction)
    print(f"Written: {options.out} ({len(prediction.positions)} poses of the {options.frame})")
    return DONE


def _adjusted(problem: Problem, fixed: Sequence[str], priors: Sequence[str]) -> Problem:
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


if __name__ == "__main__":
    sys.exit(main())

"""The command line. Modules are imported by the command that needs them, so that --help answers at once."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.arguments import build_parser
from casacal.compensation_cli import compensate_command
from casacal.doctor_cli import doctor_command
from casacal.errors import CasacalError
from casacal.threads import one_thread_each

if TYPE_CHECKING:
    from casacal.files import ProblemFile
    from casacal.problem.cell import Cell
    from casacal.problem.problem import Problem
    from casacal.uncertainty.expectation import Box

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 done, 1 not converged or a check failed, 2 bad input."""
    one_thread_each()
    try:
        typed = sys.argv[1:] if arguments is None else list(arguments)
        options = build_parser(COMMANDS).parse_args(typed)
        options.typed = shlex.join(["casacal", *typed])
        return int(options.command(options))
    except CasacalError as error:
        print(f"casacal: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("casacal: Interrupted. Nothing was written half.", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        return FAILED


def _calibrate(options: argparse.Namespace) -> int:
    from casacal.calibration.calibrate import calibrate
    from casacal.calibration.summary import summary
    from casacal.files import load_problem
    from casacal.least_squares.losses import huber, tukey
    from casacal.uncertainty.expectation import accuracy_in_box

    source = load_problem(options.problem)
    problem = _adjusted(source.problem, options.fix, options.prior, options.accuracy)
    samples = problem.read(_samples_of(source, options.samples), readings=options.readings, key=options.id)
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

        paths = write_calibration(calibration, source, Path(options.out), command=options.typed, box=box)
        print(f"\nWritten: {', '.join(path.as_posix() for path in paths)}")
    return DONE if calibration.passed else FAILED


def _box(text: str) -> Box:
    try:
        ranges = [tuple(float(value) for value in part.split(":")) for part in text.split(",")]
        (x0, x1), (y0, y1), (z0, z1) = ranges
    except ValueError:
        raise CasacalError(f"--box {text} is not X0:X1,Y0:Y1,Z0:Z1", "Give three ranges in mm") from None
    return (x0, x1), (y0, y1), (z0, z1)


def _simulate(options: argparse.Namespace) -> int:
    from casacal.binding.bound_problem import bind
    from casacal.calibration.result_json import write_simulation
    from casacal.files import load_problem
    from casacal.simulation.simulate import simulate
    from casacal.uncertainty.expectation import planned_accuracy

    source = load_problem(options.problem)
    cell = _cell(source, options)
    simulation = simulate(source.problem, cell, samples=options.samples, seed=options.seed)
    paths = write_simulation(simulation, source, Path(options.out))
    before, after = planned_accuracy(bind(source.problem, simulation.samples))
    faces = ", ".join(face.label for face in cell.faces)
    print(
        f"Simulated, not measured: {options.samples} samples on {faces} at tilts up to {math.degrees(cell.tilt):g} deg"
    )
    print(
        f"Such touches can bring the tip error, over the workspace and up to the base frame, from {before:.2f} to "
        f"{after:.2f} mm RMS, if the stated noise and priors are right"
    )
    print(f"Written: {', '.join(path.as_posix() for path in paths)}")
    return DONE


def _cell(source: ProblemFile, options: argparse.Namespace) -> Cell:
    from dataclasses import replace

    from casacal.problem.cell import AMOUNTS
    from casacal.simulation.simulate import default_cell

    cell = source.cell if source.cell is not None else default_cell(source.problem)
    given = {
        name: value for name in (*AMOUNTS, "outliers", "outlier_size") if (value := getattr(options, name)) is not None
    }
    if options.tilt is not None:
        given["tilt"] = math.radians(options.tilt)
    return replace(cell, **given)


def _check(options: argparse.Namespace) -> int:
    from casacal.checks import check
    from casacal.files import load_problem

    source = load_problem(options.problem)
    place = _samples_of(source, options.samples)
    samples = source.problem.read(place, readings=options.readings, key=options.id, absurd=True)
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
    from casacal.compensation.predict import predict, read_joints, read_result, write_prediction

    result = read_result(options.result)
    joints = read_joints(options.joints, result.source)
    prediction = predict(result, joints, frame=options.frame, nominal=options.nominal, std=options.std)
    write_prediction(options.out, prediction)
    print(f"Written: {options.out} ({len(prediction.positions)} poses of the {options.frame})")
    return DONE


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


def _study(options: argparse.Namespace) -> int:
    from casacal.study_cli import study_command

    return study_command(options)


def _new(options: argparse.Namespace) -> int:
    from casacal.robot_cli import new_command

    return new_command(options)


def _export(options: argparse.Namespace) -> int:
    from casacal.robot_cli import export_command

    return export_command(options)


COMMANDS = {
    "calibrate": _calibrate,
    "simulate": _simulate,
    "check": _check,
    "doctor": doctor_command,
    "predict": _predict,
    "compensate": compensate_command,
    "study": _study,
    "new": _new,
    "export": _export,
}


if __name__ == "__main__":
    sys.exit(main())

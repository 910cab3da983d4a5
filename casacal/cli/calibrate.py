"""`casacal calibrate`: calibrate the arm from samples, and say how far to trust them."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casacal.cli import common
from casacal.cli.common import DONE, FAILED, JSON, PROBLEM, add, whole_number
from casacal.cli.terminal import on_stderr, say, say_json, say_lines, width, wrapped, write_progress
from casacal.errors import CasacalError
from casacal.fit.methods import METHODS
from casacal.wording import mm

if TYPE_CHECKING:
    from casacal.calibration.calibrated import Calibrated
    from casacal.deployment.arm import CalibratedArm
    from casacal.model.problem_file import ProblemFile
    from casacal.values import Box

HELP = "calibrate the arm from samples"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal calibrate`."""
    parser.description = (
        "Fit the arm's parameters to samples, cross-check the minimum with another solver, and say how far the "
        "result can be trusted. Exit 1 if it must not be used."
    )
    add(parser, *PROBLEM)
    common.add_samples(parser)
    add(parser, "--method", "default: sckf-lm; with --loss, lm", choices=tuple(METHODS))
    add(parser, "--holdout F", "fraction of the rows to hold out", kind=float, default=0.0)
    words = "rows (default: some of each face), region (neighbouring postures), face, or a column, such as session"
    add(parser, "--holdout-by WHAT", words)
    add(parser, "--seed K", "for held-out rows and random methods", kind=whole_number, default=0)
    common.add_adjustments(parser)
    words = "keep gross rows from pulling the fit; not with sckf, ekf, plane-only"
    add(parser, "--loss", words, choices=("huber", "tukey"))
    add(parser, "--box X0:X1,Y0:Y1,Z0:Z1", "also give the tip error expected inside this box, mm, base frame")
    add(parser, "--noise", "found (default): from the rows, but at least as stated", choices=("found", "stated"))
    add(parser, "--keep-outliers", "fit all rows, including outliers")
    words = "kit (default): allow for errors beside the geometry, such as gravity sag and backlash, and correct "
    words += "those that improve held-out rows; none: geometry alone"
    add(parser, "--discrepancy", words, default="kit", choices=("kit", "none"))
    words = "solver of the cross-check: ipopt (default), fatrop, sqpmethod or another nlpsol plug-in of CasADi"
    add(parser, "--reference NAME", words)
    add(parser, "--no-reference", "skip the cross-check")
    words = "result.json, or its folder, of an earlier calibration of this arm: what is known before these rows"
    add(parser, "--prior-from RESULT", words)
    words = "with --prior-from: what may have changed since: joint3,theta=2e-5,... (rad, mm; else anywhere)"
    add(parser, "--loosen NAMES ...", words)
    add(parser, "--standing NAMES ...", "with --prior-from: faces that have not been moved since")
    words = "what evaluates the rows; default: CASACAL_BACKEND, or auto"
    add(parser, "--backend", words, choices=("auto", "c", "blocks"))
    add(parser, "--out DIR", "write report.html, result.json, parameters.csv and pictures there")
    add(parser, "--verbose", "print parameters, weak directions and the reference as well")
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Calibrate as the options say; returns 0, or 1 when the result must not be used."""
    from casacal.calibration.calibrate import calibrate
    from casacal.calibration.calibrated import FILES
    from casacal.files import check_writable
    from casacal.kernels.losses import huber, tukey
    from casacal.model.problem_file import load_problem

    if options.out is not None:
        if Path(options.out).exists() and not Path(options.out).is_dir():
            raise CasacalError(f"--out '{options.out}' is no folder", "Name a folder, or one that does not exist yet")
        check_writable(Path(options.out))
    if options.holdout_by is not None and not options.holdout_by.strip():
        raise CasacalError("--holdout-by is empty", "Give rows, region, face or a column, or leave it out")
    if options.holdout_by is not None and not options.holdout:
        raise CasacalError(f"Got --holdout-by {options.holdout_by} without --holdout", "Say which part: --holdout 0.3")
    if options.reference is not None and options.no_reference:
        raise CasacalError(f"Got --reference {options.reference} with --no-reference", "Leave one of them out")
    source = load_problem(options.problem)
    problem = common.adjusted(source.problem, options)
    files = common.sample_files(source, options)
    loosen, standing, prior = _since(options)
    if options.out is not None:
        places = [Path(options.out) / name for name in FILES]
        read: list[str | Path] = [] if prior is None else [prior.file, *common.made_from(prior)]
        common.spare(places, *files.values(), options.readings, *(file.path for file in source.files), *read)
    samples = common.read_samples(source, options)
    box = None if options.box is None else common.box_of(options.box)
    method = options.method or ("sckf-lm" if options.loss is None else "lm")
    with _progress(method) as progress, nullcontext() if options.reference is None else on_stderr():
        calibration = calibrate(
            replace(source, problem=problem),
            samples,
            method=method,
            holdout=options.holdout,
            holdout_by=options.holdout_by or "rows",
            seed=options.seed,
            reference=False if options.no_reference else options.reference or True,
            noise=options.noise or "found",
            outliers="keep" if options.keep_outliers else "set aside",
            discrepancy=options.discrepancy,
            prior=prior,
            loosen=loosen,
            standing=standing,
            loss={"huber": huber(), "tukey": tukey()}.get(options.loss),
            backend=options.backend,
            progress=progress,
        )
    return _report(calibration, source, box, options)


def _since(options: argparse.Namespace) -> tuple[dict[str, float | None], list[str], CalibratedArm | None]:
    """Stds by name of --loosen, names of --standing, and the result of --prior-from; None where there is none."""
    names = common.names_of("--loosen", options.loosen)
    stds: dict[str, float | None] = dict.fromkeys(name for name in names if "=" not in name)
    stds |= common.stds_of("--loosen", [name for name in names if "=" in name], "theta=2e-5")
    standing = common.names_of("--standing", options.standing)
    if options.prior_from is None and not stds and not standing:
        return {}, [], None
    if options.prior_from is None:
        what = "Got --loosen or --standing without --prior-from"
        raise CasacalError(what, "Name the earlier result: --prior-from RESULT")
    if options.prior or options.accuracy is not None:
        what = "Got --prior or --accuracy, which say how good the drawing is, with --prior-from"
        raise CasacalError(what, "Say with --loosen NAME=STD what may have changed since the earlier result")
    from casacal.deployment.result_file import read_result

    return stds, standing, read_result(options.prior_from)


def _report(calibration: Calibrated, source: ProblemFile, box: Box | None, options: argparse.Namespace) -> int:
    """Print the answer in the requested form and write the files; returns 0 or 1."""
    from casacal.calibration.brief import MOST_LINES, brief, corrected_words
    from casacal.calibration.result_json import calibration_document

    verdict, denied = calibration.verdict, calibration.denied
    expected, found = list[str](), dict[str, Any]()
    if box is not None and not denied:
        try:
            error, worst = calibration.unjudged.tip_std_in(box)
        except CasacalError as why:  # the calibration stands all the same
            box, expected = None, [str(why)]
    if box is not None and not denied:
        expected = [f"Inside {options.box} mm: a tip error of {mm(error)} RMS, {mm(worst)} at worst."]
        found["box"] = {"range_mm": box, "expected_rms_mm": error, "worst_mm": worst}
    if source.assumed:
        expected.append(f"{source.assumed}.")
    if not denied and calibration.corrected:
        expected.append(" ".join(corrected_words(calibration)))
    folder = None if options.out is None else Path(options.out).as_posix()
    last = "--verbose: parameters and unobservable directions"
    if folder is not None:
        last = f"Written: {folder}/report.html and result.json"
    if options.json:
        say_json({**calibration_document(calibration), **found})
    elif options.verbose:
        say_lines("\n\n".join([calibration.summary().rstrip(), *expected]))
    else:
        again = {"--samples": options.sets, "--fix": options.fix, "--free": options.free, "--set": options.set}
        again |= {"--prior": options.prior, "--readings": [] if options.readings is None else [options.readings]}
        again |= {"--id": [] if options.readings is None or options.id == "pose" else [options.id]}
        again |= {"--accuracy": [] if options.accuracy is None else [f"{options.accuracy:g}"]}
        words = [word for name, each in again.items() for one in each for word in (name, one)]
        about = shlex.join([options.problem, *([options.samples] if options.samples else []), *words])
        room = MOST_LINES - len(wrapped(last))
        say_lines(brief(calibration, verdict, about=about, out=folder, expected=expected, width=width(), room=room))
    if folder is not None:
        calibration.save(folder, command=options.typed, box=box)
    if not options.json and (folder is not None or not options.verbose):
        say("\n".join(wrapped(last)))
    return FAILED if denied else DONE


@contextmanager
def _progress(method: str) -> Iterator[Callable[[int, float], None]]:
    """A line on standard error, after the first second, and only on a terminal."""
    began, shown = time.monotonic(), 0.0

    def say_step(step: int, value: float) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - began > 1.0 and now - shown > 0.5 and sys.stderr.isatty():
            shown = now
            write_progress(f"\r{method}: step {step}, {value:.6g}   ")

    try:
        yield say_step
    finally:
        if shown:
            write_progress("\n")

"""`casacal verify`: whether a calibration keeps its promise on fresh rows."""

from __future__ import annotations

import argparse

from casacal.cli.adjust import names_of
from casacal.cli.common import DONE, FAILED, add_instrument, add_json, add_result
from casacal.cli.terminal import say_json, say_paragraph
from casacal.errors import CasacalError

HELP = "whether a calibration keeps its promise on fresh rows"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal verify` takes."""
    parser.description = (
        "Judge a calibration by rows that it has not seen, without fitting the arm again: only where the faces stand, "
        "or the tracker and its reflector, is estimated from them. Exit 1 when the residuals are larger than the "
        "calibration promised, or than the tolerance."
    )
    add_result(parser)
    add_instrument(parser, "which one took these rows; default: the one whose columns they have")
    parser.add_argument("samples", metavar="SAMPLES", help="fresh rows: CSV, .xlsx, .npy or .npz")
    parser.add_argument("--readings", metavar="FILE", help="CSV or .xlsx with the readings, when SAMPLES has none")
    parser.add_argument(
        "--id", default="pose", metavar="COLUMN", help="column that joins readings to their poses; default: pose"
    )
    parser.add_argument(
        "--tolerance", type=float, metavar="MM", help="largest residual that 95 %% of the rows may have"
    )
    parser.add_argument(
        "--problem",
        metavar="PROBLEM",
        help="the same arm with the instrument of these rows, such as a tracker; default: that of the calibration",
    )
    parser.add_argument(
        "--standing",
        action="append",
        default=[],
        metavar="NAMES",
        help="faces that still stand where they were calibrated, and are not fitted again: floor,wall,...",
    )
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Verify as the options say; returns 0, or 1 when the promise was not kept or the tolerance is exceeded."""
    from casacal.compensation.result_file import read_result
    from casacal.compensation.seen_by import seen_by
    from casacal.problem.problem_file import load_problem
    from casacal.verification.verify import measured_by, verify

    if not options.samples.strip():
        raise CasacalError("SAMPLES is empty", "Name a file of fresh rows")
    result = read_result(options.result)
    other = None if options.problem is None else load_problem(options.problem)
    named = options.instrument
    if other is None:
        named = measured_by(result, options.samples, named)
    problem = seen_by(result, named).source.problem if other is None else other.problem
    found = verify(
        result,
        problem.read(options.samples, readings=options.readings, key=options.id),
        problem=other,
        instrument=named,
        standing=names_of("--standing", options.standing),
        tolerance=options.tolerance,
    )
    if options.json:
        say_json(found.to_dict())
    else:
        for line in found.summary().split("\n"):
            say_paragraph(line)
    return DONE if found.passed else FAILED

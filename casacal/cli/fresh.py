"""Options of commands that hold fresh rows against a result, and what they name."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from casacal.cli.common import OF_SEVERAL, RESULT, add, add_readings, of_instrument, program_table
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.data.samples import Samples
    from casacal.data.text import Table
    from casacal.deployment.arm import CalibratedArm
    from casacal.model.problem_file import ProblemFile


def add_fresh_rows(parser: argparse.ArgumentParser, standing: str) -> None:
    """Add RESULT and fresh rows, of its own instrument or another; `standing`: help of --standing."""
    add(parser, *RESULT)
    words = f"instrument that took these rows; default: the one with these columns, {OF_SEVERAL}"
    add(parser, "--instrument NAME", words)
    add(parser, "SAMPLES", "fresh rows: CSV, .xlsx, .npy or .npz; or a robot program")
    add_readings(parser)
    words = "the same arm with the instrument of these rows, such as a tracker; default: that of the calibration"
    add(parser, "--problem PROBLEM", words)
    add(parser, "--standing NAMES ...", f"{standing}: floor,wall,...")


def fresh_rows(options: argparse.Namespace) -> tuple[CalibratedArm, ProblemFile | None, str | None, Samples]:
    """The result that `add_fresh_rows` names, a problem of another instrument, which instrument it is, and its rows."""
    from casacal.calibration.fresh import measured_by
    from casacal.data.samples import Samples, read_any_table
    from casacal.data.text import joined_tables
    from casacal.deployment.arm import for_instrument
    from casacal.deployment.result_file import read_result
    from casacal.model.problem_file import load_problem
    from casacal.programs.endings import is_program

    if not options.samples.strip():
        raise CasacalError("SAMPLES is empty", "Name a file of fresh rows")
    result = read_result(options.result)
    other = None if options.problem is None else of_instrument(load_problem(options.problem), options.instrument)
    taken: str | Table = options.samples
    if is_program(options.samples):
        taken = program_table(options.samples, options)
    elif options.readings is not None:
        taken = joined_tables(read_any_table(options.samples), read_any_table(options.readings), key=options.id)
    named = None if other is not None else measured_by(result, taken, options.instrument)
    problem = for_instrument(result, named).source.problem if other is None else other.problem
    rows = problem.read(taken) if isinstance(taken, str) else Samples.from_table(taken, problem.layout())
    return result, other, named, rows

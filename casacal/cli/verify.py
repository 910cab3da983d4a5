"""`casacal verify`: test a calibration on fresh rows."""

from __future__ import annotations

import argparse
from pathlib import Path

from casacal.cli.common import DONE, FAILED, JSON, add, made_from, names_of, spare
from casacal.cli.fresh import add_fresh_rows, fresh_rows
from casacal.cli.terminal import answer
from casacal.errors import CasacalError

HELP = "test a calibration on fresh rows"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal verify`."""
    parser.description = (
        "Judge a calibration by rows that it has not seen, without fitting the arm again: only the positions of "
        "faces, or of tracker and reflector, are estimated from them. Exit 1 if the residuals are larger than the "
        "calibration promised, or if the arm is not accepted by the tolerance."
    )
    add_fresh_rows(parser, "faces that have not been moved since the calibration and are not fitted again")
    words = "largest acceptable RMS error as these rows see it: accept, reject or undecided (JCGM 106)"
    add(parser, "--tolerance MM", words, kind=float)
    add(parser, "--risk P", "chance of a wrong decision for an arm at the tolerance; default: 0.05", kind=float)
    add(parser, "--report FILE", "write a self-contained HTML page")
    add(parser, "--into-report", "add it to the report.html beside RESULT, in place of an earlier one")
    add(parser, "--verbose", "faces, regions of the workspace and statistics as well")
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Verify as the options say; returns 0, or 1 when the promise was not kept or the arm not accepted."""
    from casacal.files import LOOKED_AT, write_text
    from casacal.verification.arm_error import RISK
    from casacal.verification.verification import REPORT, verify, with_section

    if options.risk is not None and options.tolerance is None:
        raise CasacalError("Got --risk without --tolerance", "Give the tolerance as well")
    result, other, named, rows = fresh_rows(options)
    if options.report is not None:
        files = [*made_from(result), *(() if other is None else (file.path for file in other.files))]
        spare([options.report], result.file, options.samples, options.readings, *files, option="--report")
        if not options.report.strip():
            raise CasacalError("--report is empty", "Name a file, such as verified.html")
        if Path(options.report).is_file():
            with Path(options.report).open(encoding="utf-8", errors="replace") as file:
                if "<title>Calibration of" in file.read(LOOKED_AT):
                    raise CasacalError(f"'{options.report}' is the report of a calibration", "Name another --report")
    if options.into_report:  # a report that is not there is said before anything is judged
        with_section(Path(result.file).with_name(REPORT), result, "")
    standing, risk = names_of("--standing", options.standing), RISK if options.risk is None else options.risk
    found = verify(
        result, rows, problem=other, instrument=named, standing=standing, tolerance=options.tolerance, risk=risk
    )
    if options.report is not None:
        write_text(options.report, found.page())
    if options.into_report:
        report = Path(result.file).with_name(REPORT)
        write_text(report, with_section(report, result, found.section()))
    said = found.summary(whole=options.verbose).split("\n")
    answer(options, found.to_dict(), *said, *([] if options.verbose else ["Faces, regions and statistics: --verbose"]))
    return DONE if found.passed else FAILED

"""`casacal bench`: compare methods on public data sets, on rows they have not seen."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.cli.common import DONE
from casacal.cli.terminal import say_paragraph
from casacal.errors import CasacalError, UnknownNameError

if TYPE_CHECKING:
    from casacal.bench.methods import Way

HELP = "compare methods on public data sets, on rows they have not seen"
WHERE = "CASACAL_DATA"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal bench` takes."""
    parser.description = (
        "Fit every method to part of every data set and judge it by the rest: split as the set's page says, at "
        "random, and in blocks. The measurements are not part of casacal. A run that was interrupted can be resumed."
    )
    parser.add_argument("sets", metavar="SETS", help="a folder of sets, such as studies/bench, or one set's own folder")
    parser.add_argument("--data", metavar="DIR", help=f"where the measurements are; default: {WHERE}")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="this set; may be repeated")
    parser.add_argument(
        "--methods",
        metavar="FILE",
        help="a Python file with `methods`, functions (problem, fitted, unseen) by name, to compare as well",
    )
    parser.add_argument("--method", action="append", default=[], metavar="NAME", help="this method; may be repeated")
    parser.add_argument("--quick", action="store_true", help="few rows, one block of each set: less than a minute")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="local processes; default: 1")
    parser.add_argument("--resume", action="store_true", help="keep the records in DIR and run only what is missing")
    parser.add_argument("--out", metavar="DIR", default="out/bench", help="folder for records and report")


def run(options: argparse.Namespace) -> int:
    """Run the benchmark as the options say; returns 0."""
    from casacal.bench.benchmark import bench_lines, benchmark
    from casacal.bench.benchmark_set import DESCRIPTION, read_set, read_sets
    from casacal.bench.methods import WAYS
    from casacal.files import write_text
    from casacal.study import runs

    data = options.data or os.environ.get(WHERE, "")
    if not data or not Path(data).is_dir():
        raise CasacalError(f"'{data}' is no folder of measurements", f"Name theirs with --data, or in {WHERE}")
    one = (Path(options.sets) / DESCRIPTION).is_file()
    sets = (read_set(options.sets),) if one else read_sets(options.sets)
    if options.only:
        lost = [name for name in options.only if name not in {each.name for each in sets}]
        if lost:
            known = ", ".join(each.name for each in sets)
            raise CasacalError(f"There is no set '{lost[0]}' in '{options.sets}'", f"There are: {known}")
        sets = tuple(each for each in sets if each.name in options.only)
    ways = {**WAYS, **_own(options.methods)}
    for name in options.method:
        if name not in ways:
            raise UnknownNameError("method of the benchmark", name, list(ways))
    ways = {name: way for name, way in ways.items() if not options.method or name in options.method}
    study, out = benchmark(sets, data, ways, quick=options.quick), Path(options.out)
    made = runs.run(study, out, quick=options.quick, workers=options.workers, resume=options.resume)
    path = out / "report.md"
    write_text(path, "\n".join(bench_lines(made, sets)) + "\n")
    say_paragraph(f"{len(made.records)} records, SHA-256 without timings {made.digest}. Written: {path.as_posix()}")
    return DONE


def _own(file: str | None) -> dict[str, Way]:
    """The methods that a user's file defines; raises CasacalError where it defines none."""
    from casacal.user_code import run_file

    if file is None:
        return {}
    if not Path(file).is_file():
        raise CasacalError(f"There is no file '{file}'", "Name a Python file that defines `methods`")
    try:
        found = vars(run_file(file)).get("methods")
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        said = " ".join(str(error).split())
        raise CasacalError(f"{file}: {type(error).__name__}: {said}", "Mend the file") from error
    if not isinstance(found, dict) or not found or not all(callable(way) for way in found.values()):
        raise CasacalError(f"{file} defines no `methods`", 'Add methods = {"mine": mine}, functions by name')
    return {str(name): way for name, way in found.items()}

"""`casacal bench`: compare methods on public data sets, on rows they have not seen."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.cli.common import DONE, add
from casacal.cli.study import Progress
from casacal.cli.terminal import complain, say_paragraphs
from casacal.errors import CasacalError, refuse_unknown, said

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
    add(parser, "SETS", "a folder of sets, such as studies/bench, or one set's own folder")
    add(parser, "--data DIR", f"where the measurements are; default: {WHERE}")
    add(parser, "--only NAME ...", "this set; may be repeated")
    words = "a Python file with `methods`, functions (problem, fitted, unseen) by name, to compare as well"
    add(parser, "--methods FILE", words)
    add(parser, "--method NAME ...", "this method, or package; may be repeated")
    add(parser, "--packages", "also pybotics, robotkinecal and figaroh, where they are installed")
    add(parser, "--quick", "few rows, one block of each set: a minute or two")
    add(parser, "--workers N", "local processes; default: 1", kind=int, default=1)
    add(parser, "--resume", "keep the records in DIR and run only what is missing")
    add(parser, "--out DIR", "folder for records and report", default="out/bench")


def run(options: argparse.Namespace) -> int:
    """Run the benchmark as the options say; returns 0."""
    from casacal.bench.benchmark import bench_lines, benchmark
    from casacal.bench.benchmark_set import DESCRIPTION, read_set, read_sets
    from casacal.bench.methods import WAYS
    from casacal.files import write_text
    from casacal.study import runs

    data = options.data or os.environ.get(WHERE, "")
    if not data or not Path(data).is_dir():
        came = f"'{data}' is no folder of measurements" if data else "No folder of measurements was named"
        raise CasacalError(came, f"Name theirs with --data, or in {WHERE}; the sets say where to get them")
    one = (Path(options.sets) / DESCRIPTION).is_file()
    sets = (read_set(options.sets),) if one else read_sets(options.sets)
    if options.only:
        lost = [name for name in options.only if name not in {each.name for each in sets}]
        if lost:
            known = ", ".join(each.name for each in sets)
            raise CasacalError(f"There is no set '{lost[0]}' in '{options.sets}'", f"There are: {known}")
        sets = tuple(each for each in sets if each.name in options.only)
    ways = _asked({**WAYS, **_own(options.methods)}, options)
    study, out = benchmark(sets, data, ways, quick=options.quick), Path(options.out)
    with Progress("bench", lambda: None) as progress:
        made = runs.run(
            study, out, quick=options.quick, workers=options.workers, resume=options.resume, progress=progress
        )
    path = out / "report.md"
    write_text(path, "\n".join([*bench_lines(made, sets), "", "<!-- written by casacal bench -->"]) + "\n")
    say_paragraphs(f"{len(made.records)} records, SHA-256 without timings {made.digest}. Written: {path.as_posix()}")
    return DONE


def _asked(ways: dict[str, Way], options: argparse.Namespace) -> dict[str, Way]:
    """The methods that are asked for; of packages those that are installed, of the others a word."""
    from casacal.bench.rivals import PACKAGES, absent

    known = ways | {name: way for name, way in PACKAGES.items() if name not in ways}
    refuse_unknown("method of the benchmark", options.method, known)
    asked = options.method or list(ways)
    asked += [name for name in PACKAGES if options.packages and name not in asked]
    lost = {name: absent(name) for name in asked if name in PACKAGES and name not in ways}
    found = {name: way for name, way in known.items() if name in asked and not lost.get(name)}
    for words in filter(None, lost.values()):
        if not found:
            raise CasacalError(words.partition(", and")[0], words.partition(". ")[2])
        complain(words)
    return found


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
        raise CasacalError(f"{file}: {said(error)}", "Mend the file") from error
    if not isinstance(found, dict) or not found or not all(callable(way) for way in found.values()):
        raise CasacalError(f"{file} defines no `methods`", 'Add methods = {"mine": mine}, functions by name')
    return {str(name): way for name, way in found.items()}

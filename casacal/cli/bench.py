"""`casacal bench`: a study of public data sets, and of methods that are judged on rows they have not seen."""

from __future__ import annotations

import argparse
import os
import shlex
from pathlib import Path

from casacal.cli.common import add
from casacal.cli.study import add_running, run_source
from casacal.errors import CasacalError, refuse_unknown

HELP = "compare methods on public data sets, on rows they have not seen"
WHERE = "CASACAL_DATA"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal bench`."""
    parser.description = (
        "Fit every method to part of every data set and judge it by the rest: split as the set's page says, at "
        "random, and in blocks. The measurements are not part of casacal. A run that was interrupted can be resumed."
    )
    add(parser, "SETS", "a folder of sets, such as studies/bench, or one set's own folder")
    add(parser, "--data DIR", f"where the measurements are; default: {WHERE}")
    add(parser, "--only NAME ...", "this set; may be repeated")
    words = "a Python file with `methods`, functions (problem, fitted, unseen) by name, to compare besides those of "
    add(parser, "--methods FILE ...", f"{words}the methods.py among the sets; may be repeated")
    add(parser, "--method NAME ...", "this method; may be repeated")
    add(parser, "--quick", "few rows, one block of each set: a minute or two")
    add_running(parser)
    parser.set_defaults(trials=None)


def run(options: argparse.Namespace) -> int:
    """Run the study of the sets as the options say; returns 0, or 130."""
    from casacal.study.benchmark import METHODS, bench_lines, benchmark, read_sets, read_ways
    from casacal.study.study_file import StudyFile

    data = options.data or os.environ.get(WHERE, "")
    if not data or not Path(data).is_dir():
        came = f"'{data}' is no folder of measurements" if data else "No folder of measurements was named"
        raise CasacalError(came, f"Name theirs with --data, or in {WHERE}; the sets say where to get them")
    sets = read_sets(options.sets)
    if options.only:
        refuse_unknown(f"set in '{options.sets}'", options.only, [each.name for each in sets])
        sets = tuple(each for each in sets if each.name in options.only)
    own = Path(sets[0].folder).resolve().parent / METHODS
    ways = read_ways([*([own] if own.is_file() or not options.methods else []), *options.methods])
    refuse_unknown("method of the benchmark", options.method, ways)
    ways = {name: way for name, way in ways.items() if name in (options.method or ways)}
    study = benchmark(sets, data, ways, quick=options.quick)
    chosen = [f"--{key} {shlex.quote(value)}" for key in ("only", "methods", "method") for value in vars(options)[key]]
    command = " ".join(["casacal bench", options.sets, *chosen])
    source = StudyFile("bench", (command,), None, study, study, lambda made: bench_lines(made, sets), None)
    return run_source(source, options)

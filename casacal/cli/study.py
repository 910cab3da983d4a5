"""`casacal study`: many trials of many methods: run, resume, share out, merge, report."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.cli.common import DONE, INTERRUPTED, add
from casacal.cli.terminal import complain, say_paragraphs, write_progress
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.study.description import Run, Study
    from casacal.study.study_file import StudyFile

HELP = "run a study of many trials and methods"
SAID_EVERY = {True: 0.5, False: 20.0}
"""Seconds between progress lines, on a terminal (they overwrite one another) and in a log."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal study`."""
    parser.description = (
        "Run a study file and write its report. Trials are recorded one by one, so a run can be resumed."
    )
    add(parser, "STUDY", "a Python file such as studies/paper.py")
    add(parser, "--quick", "the short form of the study, less than a minute")
    add(parser, "--trials N", "trials per setting; default: the study's own", kind=int)
    add_running(parser)


def add_running(parser: argparse.ArgumentParser) -> None:
    """Add the options of how a study is run and where its records go."""
    add(parser, "--workers N", "local processes; default: 1", kind=int, default=1)
    add(parser, "--scheduler ADDRESS", "a Dask scheduler, such as tcp://host:8786")
    add(parser, "--shard I/N", "run only the I-th of N parts of the trials, to be merged later")
    add(parser, "--merge DIR+", "run nothing; merge the records of shards")
    words = "run each trial in its own process with this time limit; a method that takes longer or crashes is "
    words += "recorded as a failure, and --resume with a longer time tries it again"
    add(parser, "--timeout SECONDS", words, kind=float)
    add(parser, "--resume", "keep the records in DIR and run only the missing trials")
    add(parser, "--report", "run nothing; write the report from the records in DIR")
    add(parser, "--out DIR", "folder for records and report; default: out/NAME")


def run(options: argparse.Namespace) -> int:
    """Run a study file as the options say; returns 0, also where it says why it is skipped, or 130."""
    from casacal.study.study_file import load_study

    return run_source(load_study(options.study), options)


def run_source(source: StudyFile, options: argparse.Namespace) -> int:
    """Run a study and write its report as the options say; returns as `run` does."""
    from casacal.study.description import Run
    from casacal.study.study_file import machine, note_machines, write_report

    one = [name for name in ("report", "merge", "shard") if getattr(options, name)]
    if len(one) > 1:
        raise CasacalError(f"Got --{one[0]} and --{one[1]}", "Give one of them")
    if source.skipped and not options.report:
        say_paragraphs(f"Skipped: {source.skipped}")
        return DONE
    try:
        study = source.form(quick=options.quick, trials=options.trials)
        out = Path(options.out or f"out/{source.name}{'-quick' if options.quick else ''}")
        if study is None:
            run = Run(None, (), out, options.quick)
            note_machines(out, [machine()])
        else:
            run = _made(source, study, out, options)
            say_paragraphs(f"{len(run.records)} records in {out.as_posix()}, SHA-256 without timings {run.digest}")
            if options.shard is not None:
                again = f"{source.commands[0]} --merge DIR DIR ... --out DIR"
                say_paragraphs(f"Shard {options.shard}. When all are done: {again}")
                return DONE
        said = " --quick" if options.quick else ""
        said += f" --trials {options.trials}" if options.trials is not None else ""
        say_paragraphs(f"Written: {write_report(source, run, said).as_posix()}")
    except KeyboardInterrupt:
        complain("Interrupted. The records so far are kept; --resume continues from there.")
        return INTERRUPTED
    return DONE


def _made(source: StudyFile, study: Study, out: Path, options: argparse.Namespace) -> Run:
    """Records that exist, that others made, or that are made now."""
    from casacal.study import runs
    from casacal.study.study_file import machine, note_machines, read_machines

    if options.report:
        return runs.open_run(study, out, quick=options.quick)
    if options.merge:
        parts = [Path(part) for part in options.merge]
        found = runs.merge(study, parts, out, quick=options.quick, resume=options.resume)
        note_machines(out, [made for part in parts for made in read_machines(part)])
        if runs.missing(study, found):
            complain(f"{runs.missing(study, found)} records are missing; --resume makes them")
        return found
    shard = 1, 1
    if options.shard is not None:
        part, _, parts_in_all = options.shard.partition("/")
        shard = (int(part), int(parts_in_all)) if part.isdecimal() and parts_in_all.isdecimal() else (0, 0)
        if not 1 <= shard[0] <= shard[1]:
            raise CasacalError(f"--shard {options.shard} is not I/N", "Give part/parts, such as 2/3")
    made_here = machine(options.workers, cluster=options.scheduler is not None)
    with _progress(source.name, lambda: note_machines(out, [made_here])) as progress:
        return runs.run(
            study,
            out,
            file=source.path,
            quick=options.quick,
            workers=options.workers,
            scheduler=options.scheduler,
            shard=shard,
            resume=options.resume,
            timeout=options.timeout,
            progress=progress,
        )


@contextmanager
def _progress(name: str, started: Callable[[], None]) -> Iterator[Callable[[int, int], None]]:
    """Records done, rate and time left on standard error; calls `started` once the run is accepted."""
    began, shown, at_first = 0.0, 0.0, 0

    def say_records(done: int, total: int) -> None:
        nonlocal began, shown, at_first
        now, looked_at = time.monotonic(), sys.stderr.isatty()
        if not shown:
            began, shown, at_first = now, now, done
            started()  # the run is accepted; who makes it is known even if it is killed
            if done:
                write_progress(f"{name}: {done} of {total} records exist\n")
        elif now - shown >= SAID_EVERY[looked_at] or done >= total:
            shown, rate = now, (done - at_first) / max(now - began, 1e-9)
            left = f"{(total - done) / rate:.0f} s left" if rate > 0 else ""
            line = f"{name}: {done} of {total} records, {rate:.1f} per second, {left}"
            write_progress(f"\r{line}   " if looked_at else f"{line}\n")

    try:
        yield say_records
    finally:
        if shown and sys.stderr.isatty():
            write_progress("\n")

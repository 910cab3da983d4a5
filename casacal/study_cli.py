"""The command `casacal study`: run, resume, share out, merge, report."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.study import Run, Study
    from casacal.study.study_file import StudyFile

INTERRUPTED = 130
SAID_EVERY = {True: 0.5, False: 20.0}
"""Seconds between progress lines, where someone looks (they overwrite one another) and in a log."""


def study_command(options: argparse.Namespace) -> int:
    """Run a study file as the options say; returns 0, also where it says why it is skipped, or 130."""
    try:
        return _study(options)
    except KeyboardInterrupt:
        print("casacal: Interrupted. What is recorded stays; --resume goes on from there.", file=sys.stderr)
        return INTERRUPTED


def _study(options: argparse.Namespace) -> int:
    from casacal.study.report import machine, note_machines, write_report
    from casacal.study import Run
    from casacal.study.study_file import load_study

    source = load_study(options.study)
    if source.skipped:
        print(f"Skipped: {source.skipped}")
        return 0
    study = source.form(quick=options.quick, trials=options.trials)
    out = Path(options.out or Path("out") / (source.name + ("-quick" if options.quick else "")))
    if study is None:
        run = Run(None, (), out, options.quick)
        note_machines(out, [machine()])
    else:
        run = _made(source, study, out, options)
        print(f"{len(run.records)} records in {out.as_posix()}, SHA-256 without timings {run.digest}")
        if options.shard is not None:
            print(
                f"Shard {options.shard}. When all are done: casacal study {source.path} --merge DIR DIR ... --out DIR"
            )
            return 0
    print(f"Written: {write_report(source, run, _options(options)).as_posix()}")
    return 0


def _made(source: StudyFile, study: Study, out: Path, options: argparse.Namespace) -> Run:
    """Records that exist, that others made, or that are made now."""
    from casacal.study.report import machine, note_machines, read_machines
    from casacal.study import merge, missing, open_run, run

    if options.report:
        return open_run(study, out, quick=options.quick)
    if options.merge:
        parts = [Path(part) for part in options.merge]
        found = merge(study, parts, out, quick=options.quick)
        note_machines(out, [made for part in parts for made in read_machines(part)])
        if missing(study, found):
            print(f"{missing(study, found)} records are missing; --resume makes them", file=sys.stderr)
        return found
    made_here = machine(options.workers, cluster=options.scheduler is not None)
    with _Progress(source.name, lambda: note_machines(out, [made_here])) as progress:
        return run(
            study,
            out,
            file=source.path,
            quick=options.quick,
            workers=options.workers,
            scheduler=options.scheduler,
            shard=_shard(options.shard),
            resume=options.resume,
            progress=progress,
        )


def _shard(text: str | None) -> tuple[int, int]:
    if text is None:
        return 1, 1
    part, _, parts = text.partition("/")
    try:
        number, count = int(part), int(parts)
    except ValueError:
        number = count = 0
    if not 1 <= number <= count:
        raise CasacalError(f"--shard {text} is not I/N", "Give the part and their number, such as 2/3")
    return number, count


def _options(options: argparse.Namespace) -> str:
    """The options that decide what is in the report."""
    return (" --quick" if options.quick else "") + (f" --trials {options.trials}" if options.trials is not None else "")


class _Progress:
    """Records done, rate and time left on standard error; calls `started` once the run is accepted."""

    def __init__(self, name: str, started: Callable[[], None]) -> None:
        self.name, self.started = name, started
        self.began, self.shown, self.at_first = time.monotonic(), 0.0, 0

    def __enter__(self) -> _Progress:
        return self

    def __call__(self, done: int, total: int) -> None:
        now, looked_at = time.monotonic(), sys.stderr.isatty()
        if not self.shown:
            self.began, self.shown, self.at_first = now, now, done
            self.started()  # the run is accepted; who makes it is known even if it is killed
            if done:
                print(f"{self.name}: {done} of {total} records exist", file=sys.stderr)
            return
        if now - self.shown < SAID_EVERY[looked_at] and done < total:
            return
        self.shown = now
        rate = (done - self.at_first) / max(now - self.began, 1e-9)
        left = f"{(total - done) / rate:.0f} s left" if rate > 0 else ""
        line = f"{self.name}: {done} of {total} records, {rate:.1f} a second, {left}"
        print(f"\r{line}   " if looked_at else line, end="" if looked_at else "\n", file=sys.stderr, flush=True)

    def __exit__(self, *_: object) -> None:
        if self.shown and sys.stderr.isatty():
            print(file=sys.stderr)

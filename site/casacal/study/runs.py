"""A study, run: what is not yet recorded is made, here, in processes or on a cluster; records stay in order."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from casacal.errors import StudyError
from casacal.study import executors, records
from casacal.study.description import Run, Study
from casacal.study.records import Key, Record
from casacal.study.supervised import supervised
from casacal.study.trial import Task, perform

Progress = Callable[[int, int], None]

RECORDS = "records.jsonl"


def run(
    study: Study,
    out: Path,
    *,
    file: str | Path | None = None,
    quick: bool = False,
    workers: int = 1,
    scheduler: str | None = None,
    shard: tuple[int, int] = (1, 1),
    resume: bool = False,
    timeout: float | None = None,
    progress: Progress | None = None,
) -> Run:
    """Run what is not yet recorded in `out`.

    Args:
        study: what to run.
        out: folder of records.jsonl, appended to trial by trial, and put in order at the end.
        file: the study's file, which workers read themselves; without one they are given the study, pickled.
        quick: whether `study` is the file's quick form.
        workers: local processes; 1 runs here.
        scheduler: address of a Dask scheduler, in place of local processes.
        shard: (i, n), the i-th of n parts of the trials.
        resume: keep the records that exist, and make only those that are missing; else there must be none.
        timeout: seconds that each method of a trial may take, and the making of the trial; each trial then has a
            process of its own, and a method that takes longer, ends its process or crashes is recorded as a failure.
            With `resume`, what a shorter limit ended is tried again; what another failure ended is kept.
        progress: called with (records done, of how many) at first and after each trial.

    Returns:
        All records of `out`, in the study's order.

    Raises StudyError when records exist and `resume` is not set, when they were made by another version of the study
    or of casacal, or when workers cannot do as asked.

    """
    if workers < 1 or not 1 <= shard[0] <= shard[1]:
        raise StudyError(f"{workers} workers and shard {shard[0]}/{shard[1]} were asked for", "Count both from one")
    if timeout is not None and not (0 < timeout < math.inf and scheduler is None):
        what = f"A time limit of {timeout:g} s was asked for{'' if scheduler is None else ', and a cluster'}"
        raise StudyError(what, "Give seconds above zero, and let local processes do the work")
    path, everything = (out / RECORDS).absolute(), tasks_of(study)
    mine = everything[shard[0] - 1 :: shard[1]]
    with records.appending(path) as appender:
        found = records.read_records(path)
        done = _kept(study, out, everything, found, resume)
        if timeout is not None:
            done -= {records.key_of(r) for r in found if r.get(records.LIMIT, timeout) < timeout}
        missing = [task for task in (task.without(done) for task in mine) if task.methods]
        total = sum(len(task.methods) for task in mine)
        count = total - sum(len(task.methods) for task in missing)
        if progress is not None:
            progress(count, total)
        for made in _performed(study, missing, file, quick, workers, scheduler, timeout):
            appender.append(made)
            count += len(made)
            if progress is not None:
                progress(count, total)
        ordered = _ordered(everything, records.read_records(path))
        appender.rewrite(ordered)
    asked = {key for task in everything for key in task.keys}
    return Run(study, tuple(r for r in ordered if records.key_of(r) in asked), out, quick)


def open_run(study: Study, out: Path, *, quick: bool = False) -> Run:
    """The records of a folder, without running anything; raises StudyError when there are none.

    Which version of casacal made them does not matter here: a report can be written again long after.
    """
    names = {(s, m, k) for s in study.settings for m in study.methods for k in range(study.trials_of(m))}
    found = [r for r in records.read_records(out / RECORDS) if (r["setting"], r["method"], r["trial"]) in names]
    if not found:
        raise StudyError(f"'{out}' holds no record of the study '{study.name}'", "Run it first")
    return Run(study, tuple(found), out, quick)


def merge(study: Study, parts: Sequence[Path], out: Path, *, quick: bool = False) -> Run:
    """Put the records of several folders together in `out`, in the study's order.

    Raises StudyError when a folder has none, when two disagree, or when `out` has records already.
    """
    for part in parts:
        if not (part / RECORDS).is_file():
            raise StudyError(f"'{part}' holds no records", "Name folders that `casacal study` wrote")
    everything = tasks_of(study)
    with records.appending(out / RECORDS) as appender:
        _kept(study, out, everything, records.read_records(out / RECORDS), False)
        found = records.merged([records.read_records(part / RECORDS) for part in parts])
        _kept(study, out, everything, found, True)
        ordered = _ordered(everything, found)
        appender.rewrite(ordered)
    return Run(study, tuple(ordered), out, quick)


def missing(study: Study, made: Run) -> int:
    """How many records of a study a run does not have."""
    return sum(len(task.methods) for task in tasks_of(study)) - len(made.records)


def _performed(
    study: Study,
    tasks: Sequence[Task],
    file: str | Path | None,
    quick: bool,
    workers: int,
    scheduler: str | None,
    timeout: float | None,
) -> Iterator[list[Record]]:
    if workers == 1 and scheduler is None and timeout is None:
        return (perform(study, task) for task in tasks)
    asked = executors.errands(study, tasks, file, quick)
    if timeout is not None:
        return supervised(study.name, asked, timeout, workers)
    if scheduler is not None:
        return executors.on_cluster(executors.perform_errand, asked, scheduler)
    return executors.in_processes(executors.perform_errand, asked, workers)


def tasks_of(study: Study) -> list[Task]:
    """All tasks of a study, trial by trial, so that what is recorded early covers every setting."""
    keys = {(setting, name): study.fingerprint(setting, name) for setting in study.settings for name in study.methods}
    found = []
    for trial in range(study.trials):
        methods = tuple(name for name in study.methods if trial < study.trials_of(name))
        for setting in study.settings:
            if methods:
                found.append(Task(setting, trial, methods, tuple(keys[setting, name] for name in methods)))
    return found


def _kept(study: Study, out: Path, tasks: Iterable[Task], found: Sequence[Record], resume: bool) -> set[Key]:
    """Keys of records that may stay."""
    if found and not resume:
        raise StudyError(f"'{out}' holds {len(found)} records already", "Add --resume, or choose another folder")
    known = {fingerprint for task in tasks for fingerprint in task.fingerprints}
    strange = [record for record in found if record["fingerprint"] not in known]
    if strange:
        raise StudyError(
            f"{len(strange)} of {len(found)} records were made by another version of the study '{study.name}', of "
            "casacal, Python, casadi, numpy or scipy",
            "Choose another folder",
        )
    return {records.key_of(record) for record in found}


def _ordered(tasks: Iterable[Task], found: Iterable[Record]) -> list[Record]:
    """Each record once, in the order of the tasks; records of further trials, from a longer run, after them."""
    by_key = {records.key_of(record): record for record in found}
    listed = [by_key.pop(key) for task in tasks for key in task.keys if key in by_key]
    return [*listed, *(by_key[key] for key in sorted(by_key))]

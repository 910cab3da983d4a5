"""A study, run: what is not yet recorded is made, here, in processes or on a cluster; each trial within its time."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TypeVar

from casacal.errors import CasacalError, StudyError, said
from casacal.study.description import LIMIT, Key, Record, Run, Study, appending, key_of, merged, read_records
from casacal.study.study_file import load_study
from casacal.study.trial import Task, failed, heads, perform, trial_records
from casacal.threads import VARIABLE as THREADS
from casacal.threads import one_thread_each

Item = TypeVar("Item")
Made = TypeVar("Made")

CONNECT_SECONDS, CLOSE_SECONDS = 10, 5

_ONE_AT_A_TIME = threading.Lock()  # compiled functions keep buffers; and clocks then measure one method alone


@dataclass(frozen=True)
class Errand:
    """A task for a worker, and how the worker comes by its study."""

    task: Task
    study: Callable[[], Study]


def errands(study: Study, tasks: Sequence[Task], file: str | Path | None, quick: bool) -> list[Errand]:
    """Tasks for workers that read the study's file themselves, or get a study of values pickled where there is none.

    Raises StudyError for one that only this process understands.
    """
    if file is not None:
        return [Errand(task, partial(_read, str(Path(file).resolve()), quick, study.trials, task)) for task in tasks]
    try:
        luggage = pickle.dumps(study)
    except Exception as error:  # closures and whatever else a user's methods hold
        what = f"The study '{study.name}' cannot be given to workers: {' '.join(str(error).split())}"
        raise StudyError(what, "Write it to a file, or run it here") from error
    return [Errand(task, partial(_loaded, luggage)) for task in tasks]


def perform_errand(errand: Errand) -> list[Record]:
    """Records of a task, in a worker; raises StudyError when its casacal or its study file is another one."""
    with _ONE_AT_A_TIME:
        return perform(errand.study(), errand.task)


@lru_cache(maxsize=4)
def _loaded(luggage: bytes) -> Study:
    try:
        found = pickle.loads(luggage)
    except Exception as error:  # what its methods import need not be here
        fix = "Put its functions into a package that both can import, or run it here"
        raise StudyError(f"A worker cannot unpack the study: {said(error)}", fix) from error
    assert isinstance(found, Study)
    return found


def _read(path: str, quick: bool, trials: int, task: Task) -> Study:
    """The study of a file; raises StudyError when it, or what is beneath it, is not that of the task."""
    if tuple(_key(path, quick, trials, task.setting, method) for method in task.methods) != task.fingerprints:
        what = "A worker has another study file, casacal, Python, casadi, numpy or scipy than the one that asks"
        raise StudyError(what, "Give all of them the same")
    return _study(path, quick, trials)


@cache
def _study(path: str, quick: bool, trials: int) -> Study:
    study = load_study(path).form(quick=quick, trials=trials)
    if study is None:
        raise StudyError(f"'{path}' defines no study", "Give the file that the run was started with")
    return study


@cache
def _key(path: str, quick: bool, trials: int, setting: str, method: str) -> str:
    return _study(path, quick, trials).fingerprint(setting, method)


def in_processes(function: Callable[[Item], Made], tasks: Sequence[Item], workers: int) -> Iterator[Made]:
    """Results of a function, task by task, from `workers` fresh processes; function and tasks must be picklable.

    Raises StudyError when a process dies.
    """
    one_thread_each()
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), begin_worker)
    try:
        for future in as_completed([pool.submit(function, task) for task in tasks]):
            yield future.result()
    except BrokenProcessPool:
        raise StudyError(
            "A worker process died",
            "Run again with --resume; fewer workers need less memory, and with --timeout SECONDS a method that ends "
            "its process is recorded as a failure",
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def begin_worker(*, shared: bool = True) -> None:
    """Leave keyboard interrupts to the parent process, and end with it, also when it is killed.

    shared: whether others run beside it, so that one thread must do.
    """

    def follow() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)  # a worker whose parent is gone waits for tasks for ever

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=follow, daemon=True).start()
    if shared:
        os.environ.setdefault(THREADS, "1")


def on_cluster(function: Callable[[Item], Made], tasks: Sequence[Item], address: str) -> Iterator[Made]:
    """Results of a function, task by task, from the Dask cluster whose scheduler listens at `address` (tcp://host:8786).

    Its workers need casacal and the study's file at the same path. Raises StudyError where Dask is not there or lost.
    """
    try:
        from dask.distributed import Client, as_completed
        from distributed import KilledWorker
    except ImportError:
        raise StudyError("Dask is not installed", "Install it with pip install distributed") from None
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise StudyError(f"No Dask scheduler answers at '{address}' ({said})", "Start one: dask scheduler") from None
    futures = client.map(function, list(tasks), pure=False)
    log = logging.getLogger("distributed.client")  # tells in tracebacks what is said here in a sentence
    silent, log.disabled = log.disabled, True
    try:
        for _, outcome in as_completed(futures, loop=client.loop, with_results=True):
            if isinstance(outcome, BaseException):  # what a client gives for futures whose scheduler is gone
                what = f"The scheduler at '{address}' was lost"
                raise StudyError(what, "Start it and its workers again, and run again with --resume")
            yield outcome
    except KilledWorker as error:
        raise StudyError(f"The cluster lost its workers ({error})", "Run again with --resume") from None
    finally:
        with suppress(Exception):  # a scheduler that is gone cannot be told
            client.cancel(futures)
            client.close(timeout=CLOSE_SECONDS)
        log.disabled = silent


BEGIN_SECONDS = 300.0  # how long a process may take to import what it needs and to read the study
LEEWAY = 30.0  # seconds beyond its limit after which a process whose parent is gone is ended by the system
_CHILDREN = threading.Lock()  # to start one, Python asks all others whether they have ended; one thread may hear it


def supervised(name: str, errands: Sequence[Errand], seconds: float, workers: int) -> Iterator[list[Record]]:
    """Records of tasks, each made in a process of its own, `workers` at a time.

    A method, or the making of its trial, that takes longer than `seconds` or ends its process is a failure with that
    message; the other methods of the trial go on in another process. name: of the study.

    Raises StudyError when a process cannot begin.
    """
    one_thread_each()
    stopped, stop = multiprocessing.get_context("spawn").Pipe(duplex=False)
    with ThreadPoolExecutor(workers) as pool:
        running = [pool.submit(_records, name, errand, seconds, workers, stopped) for errand in errands]
        try:
            for future in as_completed(running):
                yield future.result()
        finally:
            stop.close()
            pool.shutdown(wait=True, cancel_futures=True)
            stopped.close()


def _records(name: str, errand: Errand, seconds: float, workers: int, stopped: Connection) -> list[Record]:
    """Records of one task, from as many processes as its methods bring to an end."""
    found: list[Record] = []
    left = heads(name, errand.task)
    while left:
        remaining = errand.task.without([key_of(record) for record in found])
        heard, ended = _heard(replace(errand, task=remaining), seconds, workers, stopped)
        made = [record for record in heard if record is not None]
        found += made
        left = left[len(made) :]
        if ended is None:
            break
        if not heard:
            fix = "Where a script runs the study, let it do so under if __name__ == '__main__'"
            raise StudyError(f"The process of a trial did not begin ({ended['error']})", fix)
        blamed = left[:1] if len(heard) > 1 else left  # a trial that cannot be made fails every method
        found += [{**head, **ended} for head in blamed]
        left = left[len(blamed) :]
    return found


def _heard(
    errand: Errand, seconds: float, workers: int, stopped: Connection
) -> tuple[list[Record | None], Record | None]:
    """Messages of a worker on a task: None after reading the study, None after making a trial, then the records.

    And how it ended where it did not say all; no end when the run is stopped.
    """
    context, heard, missing = multiprocessing.get_context("spawn"), list[Record | None](), len(errand.task.methods)
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(send, errand, seconds, workers > 1))
    with _CHILDREN:
        process.start()
    send.close()
    try:
        while missing:
            limit = seconds if heard else BEGIN_SECONDS
            ready = wait([receive, stopped], limit)
            if stopped in ready:
                break
            if not ready:
                return heard, {**failed(f"TimeLimit: no answer within {limit:g} s"), LIMIT: limit}
            try:
                said = receive.recv()
            except (EOFError, OSError, pickle.UnpicklingError):
                return heard, failed(_words(process))
            if isinstance(said, CasacalError):
                raise said
            heard.append(said)
            missing -= said is not None
        return heard, None
    finally:  # end it, and what it started
        if hasattr(os, "killpg") and process.pid is not None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
        with _CHILDREN:
            process.kill()
            process.join()
            process.close()
        receive.close()


def _words(process: BaseProcess) -> str:
    """Failure message for the way a process ended."""
    code = None
    if wait([process.sentinel], LEEWAY):
        with _CHILDREN:
            process.join()
            code = process.exitcode
    if code is None:
        return "Ended: the process of the trial says no more"
    if code >= 0:
        return f"Ended: the process of the trial came to an end with exit code {code}"
    known = {each.value: each.name for each in signal.Signals}
    return f"Ended: the process of the trial was killed by {known.get(-code, f'signal {-code}')}"


def _serve(send: Connection, errand: Errand, seconds: float, shared: bool) -> None:
    """Make the records of a task in this process, and say so step by step; shared as for `begin_worker`."""
    if hasattr(os, "setsid"):
        os.setsid()  # a group of its own: what a method starts ends with it
    begin_worker(shared=shared)
    _at_most(BEGIN_SECONDS)
    try:
        study = errand.study()
    except CasacalError as error:
        send.send(error)
        return
    send.send(None)
    _at_most(seconds)
    for record in trial_records(study, errand.task):
        send.send(record)
        _at_most(seconds)


def _at_most(seconds: float) -> None:
    """Have the system end this process in time even if its parent is gone and a method never lets go of Python."""
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, seconds + LEEWAY)


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
    progress: Callable[[int, int], None] | None = None,
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
    with appending(path) as appender:
        found = read_records(path)
        done = _kept(study, out, everything, found, resume)
        if timeout is not None:
            done -= {key_of(r) for r in found if r.get(LIMIT, timeout) < timeout}
        missing = [task for task in (task.without(done) for task in mine) if task.methods]
        total = sum(len(task.methods) for task in mine)
        count = total - sum(len(task.methods) for task in missing)
        if progress is not None:
            progress(count, total)
        if workers == 1 and scheduler is None and timeout is None:
            all_made: Iterator[list[Record]] = (perform(study, task) for task in missing)
        else:
            work = errands(study, missing, file, quick)
            if timeout is not None:
                all_made = supervised(study.name, work, timeout, workers)
            elif scheduler is not None:
                all_made = on_cluster(perform_errand, work, scheduler)
            else:
                all_made = in_processes(perform_errand, work, workers)
        for made in all_made:
            appender.append(made)
            count += len(made)
            if progress is not None:
                progress(count, total)
        ordered = _ordered(everything, read_records(path))
        appender.rewrite(ordered)
    known = {key for task in everything for key in task.keys}
    return Run(study, tuple(r for r in ordered if key_of(r) in known), out, quick)


def open_run(study: Study, out: Path, *, quick: bool = False) -> Run:
    """The records of a folder, without running anything; raises StudyError when there are none.

    Which version of casacal made them does not matter here: a report can be written again long after.
    """
    names = {(s, m, k) for s in study.settings for m in study.methods for k in range(study.trials_of(m))}
    found = [r for r in read_records(out / RECORDS) if (r["setting"], r["method"], r["trial"]) in names]
    if not found:
        raise StudyError(f"'{out}' holds no record of the study '{study.name}'", "Run it first")
    settings, methods = [*study.settings], [*study.methods]  # a run that was killed has not put them in order
    found.sort(key=lambda r: (r["trial"], settings.index(r["setting"]), methods.index(r["method"])))
    return Run(study, tuple(found), out, quick)


def merge(study: Study, parts: Sequence[Path], out: Path, *, quick: bool = False, resume: bool = False) -> Run:
    """Put the records of several folders together in `out`, in the study's order; with those of `out` to `resume`.

    Raises StudyError when a folder has none, when two disagree, or when `out` has records already, unless to resume.
    """
    for part in parts:
        if not (part / RECORDS).is_file():
            raise StudyError(f"'{part}' holds no records", "Name folders that `casacal study` wrote")
    everything = tasks_of(study)
    with appending(out / RECORDS) as appender:
        there = read_records(out / RECORDS)
        _kept(study, out, everything, there, resume)
        found = merged([there, *(read_records(part / RECORDS) for part in parts)])
        _kept(study, out, everything, found, True)
        ordered = _ordered(everything, found)
        appender.rewrite(ordered)
    return Run(study, tuple(ordered), out, quick)


def missing(study: Study, made: Run) -> int:
    """Number of a study's records that a run lacks."""
    return sum(len(task.methods) for task in tasks_of(study)) - len(made.records)


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
    return {key_of(record) for record in found}


def _ordered(tasks: Iterable[Task], found: Iterable[Record]) -> list[Record]:
    """Each record once, in the order of the tasks; records of further trials, from a longer run, after them."""
    by_key = {key_of(record): record for record in found}
    listed = [by_key.pop(key) for task in tasks for key in task.keys if key in by_key]
    return [*listed, *(by_key[key] for key in sorted(by_key))]

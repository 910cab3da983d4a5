"""Where tasks run beside here, in local processes or on a Dask cluster, and what they take along."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TypeVar

from casacal.errors import StudyError, said
from casacal.study.description import Study
from casacal.study.records import Record
from casacal.study.study_file import load_study
from casacal.study.trial import Task, perform
from casacal.threads import VARIABLE as THREADS
from casacal.threads import one_thread_each

Asked = TypeVar("Asked")
Answered = TypeVar("Answered")

CONNECT_SECONDS, CLOSE_SECONDS = 10, 5


_ONE_AT_A_TIME = threading.Lock()
"""Compiled functions keep buffers, so threads of one process take turns; clocks then measure one method alone."""


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


def in_processes(function: Callable[[Asked], Answered], tasks: Sequence[Asked], workers: int) -> Iterator[Answered]:
    """In `workers` fresh processes of this machine; the function and its tasks must be importable and picklable.

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
    """Leave interruptions from the keyboard to the process that asks, and end with it, also when it is killed.

    shared: whether others run beside it, so that one thread must do.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if shared:
        os.environ.setdefault(THREADS, "1")


def _end_with_parent() -> None:
    """Wait for the process that started this one to be gone, and follow it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # a worker whose parent is gone waits for tasks for ever


def on_cluster(function: Callable[[Asked], Answered], tasks: Sequence[Asked], address: str) -> Iterator[Answered]:
    """On the Dask cluster whose scheduler listens at `address`, such as tcp://host:8786.

    Its workers need casacal and the study's file at the same path. Raises StudyError without the extra `cluster`,
    when no scheduler answers, or when its workers are lost.
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

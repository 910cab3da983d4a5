"""Where tasks run: here, in local processes, or on an existing Dask cluster; results come as they finish."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from casacal.errors import StudyError
from casacal.threads import VARIABLE as THREADS
from casacal.threads import one_thread_each

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

AHEAD = 4  # tasks a process has waiting; more would only delay the end of an interrupted run
CONNECT_SECONDS = 10


def here(function: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[Outcome]:
    """One task after the other, in this process."""
    return map(function, tasks)


def in_processes(function: Callable[[Task], Outcome], tasks: Sequence[Task], workers: int) -> Iterator[Outcome]:
    """In `workers` fresh processes of this machine; the function and its tasks must be importable and picklable.

    Raises StudyError when a process dies.
    """
    one_thread_each()
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin_worker)
    waiting, running = list(reversed(tasks)), set[Future[Outcome]]()
    try:
        while waiting or running:
            while waiting and len(running) < AHEAD * workers:
                running.add(pool.submit(function, waiting.pop()))
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                yield future.result()
    except BrokenProcessPool:
        raise StudyError(
            "A worker process died",
            "Run again with --resume; fewer workers need less memory, and with --timeout SECONDS a method that ends "
            "its process is recorded as a failure",
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    """Leave interruptions from the keyboard to the process that asks, and end with it, also when it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault(THREADS, "1")  # the processors are shared out already
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Wait for the process that started this one to be gone, and follow it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # a worker whose parent is gone waits for tasks for ever


def on_cluster(function: Callable[[Task], Outcome], tasks: Sequence[Task], address: str) -> Iterator[Outcome]:
    """On the Dask cluster whose scheduler listens at `address`, such as tcp://host:8786.

    Its workers need casacal and the study's file at the same path. Raises StudyError without the extra `cluster`,
    when no scheduler answers, or when its workers are lost.
    """
    try:
        from dask.distributed import Client, as_completed
        from distributed import KilledWorker
    except ImportError:
        raise StudyError("Dask is not installed", 'Install the extra: pip install "casacal[cluster]"') from None
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise StudyError(f"No Dask scheduler answers at '{address}' ({said})", "Start one: dask scheduler") from None
    with client:
        futures = client.map(function, list(tasks), pure=False)
        try:
            for _, outcome in as_completed(futures, loop=client.loop, with_results=True):
                yield outcome
        except KilledWorker as error:
            raise StudyError(f"The cluster lost its workers ({error})", "Run again with --resume") from None
        finally:
            client.cancel(futures)

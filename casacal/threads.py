"""Number of threads for rows and for linear algebra: thousands of rows are worth several, an arm's matrices one."""

from __future__ import annotations

import functools
import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

from casacal.errors import ProblemError

Item = TypeVar("Item")
Made = TypeVar("Made")

VARIABLE = "CASACAL_THREADS"
ALGEBRA = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def one_thread_each() -> None:
    """Let linear algebra of processes started from here, and of this one where NumPy is not yet loaded, use one thread.

    Threads that share a matrix of thirty unknowns mostly wait for one another. A user's own setting stands.
    """
    for name in ALGEBRA:
        os.environ.setdefault(name, "1")


def thread_count(requested: int | None = None) -> int:
    """Number of threads that share rows: as requested, else CASACAL_THREADS, else the processors available.

    Raises ProblemError for less than one, or what is not a number.
    """
    text = os.environ.get(VARIABLE) if requested is None else str(requested)
    if not text:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not text.isdecimal() or int(text) < 1:
        raise ProblemError(f"{text!r} threads were asked for", "Give one or more")
    return int(text)


def shared_out(task: Callable[[Item], Made], items: Iterable[Item], threads: int) -> list[Made]:
    """Results of a task for each item, in the order of the items; the calling thread takes its share.

    A thread that has finished an item takes the next one, for processors are seldom equally fast.
    """
    waiting = list(items)
    count = min(threads, len(waiting))
    if count <= 1:
        return [task(item) for item in waiting]
    made: dict[int, Made] = {}
    remaining = deque(enumerate(waiting))

    def work() -> None:
        while True:
            try:
                k, item = remaining.popleft()
            except IndexError:
                return
            made[k] = task(item)

    others = [_pool(count - 1).submit(work) for _ in range(1, count)]
    try:
        work()
    finally:  # whatever happened, no thread goes on with what the caller may change
        remaining.clear()
        begun = [other for other in others if not other.cancel()]  # what has not begun may wait for this very thread
        wait(begun)
    for other in begun:
        other.result()
    return [made[k] for k in range(len(waiting))]


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="casacal")


if hasattr(os, "register_at_fork"):  # a process that is forked has the pools, and none of their threads
    os.register_at_fork(after_in_child=_pool.cache_clear)

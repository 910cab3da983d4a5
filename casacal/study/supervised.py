"""A process for each trial, with a time limit: a method that hangs, ends its process or crashes becomes a record."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from casacal.errors import CasacalError, StudyError
from casacal.study.executors import Errand, begin_worker
from casacal.study.records import LIMIT, Record, key_of
from casacal.study.trial import failed, heads, trial_records
from casacal.threads import one_thread_each

BEGIN_SECONDS = 300.0  # how long a process may take to import what it needs and to read the study
LEEWAY = 30.0  # seconds beyond its limit after which a process whose parent is gone is ended by the system
_CHILDREN = threading.Lock()
"""To start a process, Python asks all others whether they have ended; only one thread may hear it."""


@dataclass
class _Heard:
    """What a process said: `begun` once it has read the study, `made` once its trial is, then the records."""

    begun: bool = False
    made: bool = False
    records: list[Record] = field(default_factory=list)


def supervised(name: str, errands: Sequence[Errand], seconds: float, workers: int) -> Iterator[list[Record]]:
    """Records of tasks, each made in a process of its own, `workers` at a time.

    A method, or the making of its trial, that takes longer than `seconds` or ends its process is a failure with that
    message; the other methods of the trial go on in another process. name: of the study.

    Raises StudyError when a process cannot begin.
    """
    one_thread_each()
    stopped, stop = multiprocessing.get_context("spawn").Pipe(duplex=False)
    with ThreadPoolExecutor(workers) as pool:
        asked = [pool.submit(_records, name, errand, seconds, workers, stopped) for errand in errands]
        try:
            for future in as_completed(asked):
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
        found += heard.records
        left = left[len(heard.records) :]
        if ended is None:
            break
        if not heard.begun:
            fix = "Where a script runs the study, let it do so under if __name__ == '__main__'"
            raise StudyError(f"The process of a trial did not begin ({ended['error']})", fix)
        blamed = left[:1] if heard.made else left  # a trial that cannot be made fails every method
        found += [{**head, **ended} for head in blamed]
        left = left[len(blamed) :]
    return found


def _heard(errand: Errand, seconds: float, workers: int, stopped: Connection) -> tuple[_Heard, Record | None]:
    """What a process says of a task, and how it ended where it did not say all; no end when the run is stopped."""
    context, heard = multiprocessing.get_context("spawn"), _Heard()
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(send, errand, seconds, workers > 1))
    with _CHILDREN:
        process.start()
    send.close()
    try:
        while len(heard.records) < len(errand.task.methods):
            limit = seconds if heard.begun else BEGIN_SECONDS
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
            if isinstance(said, dict):
                heard.records.append(said)
            heard.made |= heard.begun
            heard.begun = True
        return heard, None
    finally:
        _end(process)
        receive.close()


def _words(process: BaseProcess) -> str:
    """How a process ended, as the message of a failure."""
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


def _end(process: BaseProcess) -> None:
    """End a process, and those that it started."""
    if hasattr(os, "killpg") and process.pid is not None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    with _CHILDREN:
        process.kill()
        process.join()
        process.close()


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
    for said in trial_records(study, errand.task):
        send.send(said)
        _at_most(seconds)


def _at_most(seconds: float) -> None:
    """Have the system end this process in time even if its parent is gone and a method never lets go of Python."""
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, seconds + LEEWAY)

"""Interrupts that are heard: libraries below swallow one that comes while they ask Python something, as CasADi does."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from typing import Any, NoReturn

from casacal.cli.common import INTERRUPTED

AGAIN = 0.1  # seconds after which an interrupt that ended nothing is raised once more


def heard(run: Callable[[], int]) -> int:
    """Run a command; an interrupt is raised again until it ends that, but not in what tidies up after it.

    Raises KeyboardInterrupt, also where the command went on to its end: what it says then may be wrong. Where there
    are no alarms (Windows), in a thread, and where others handle or ignore interrupts, all stays as it is.
    """
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        return run()
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return run()
    came = over = False

    def interrupt(*_: Any) -> NoReturn:
        nonlocal came
        came = True
        signal.signal(signal.SIGALRM, remind)
        signal.setitimer(signal.ITIMER_REAL, AGAIN, AGAIN)
        raise KeyboardInterrupt

    def remind(*_: Any) -> None:
        if not (over or _tidying_up()):  # an alarm that was due as the run ended comes once it is over
            signal.raise_signal(signal.SIGINT)  # to whoever handles it now: it waits while files take their places

    before = signal.getsignal(signal.SIGALRM)
    signal.signal(signal.SIGINT, interrupt)
    try:
        code = run()
    finally:
        over = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if came:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
    if came and code != INTERRUPTED:
        raise KeyboardInterrupt
    return code


def _tidying_up() -> bool:
    """Whether what runs now is a `finally`, `except` or `with` that an interrupt passes."""
    error = sys.exception()
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None

"""Several files that belong together: written elsewhere first, then placed, all of one run or none."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from casacal.errors import CasacalError
from casacal.files import mark_of_this_run, sweep

PREFIX = ".casacal-"


@contextmanager
def together(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """A place for files that all take their places in a folder at the end, or none of them.

    Files of the same names from an earlier run go first, so that the folder never holds files of two runs; the last
    name comes last, so that where it stands all stand. Signals wait meanwhile.

    Args:
        folder: made where it does not exist; removed again if it was made and nothing came of it.
        names: files that may be made, in the order in which they are placed.

    Raises CasacalError when the folder cannot be written, or another run is writing into it.

    """
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder):
            sweep(folder, PREFIX)
            place = Path(tempfile.mkdtemp(dir=folder, prefix=f"{PREFIX}{mark_of_this_run()}-"))
            try:
                yield place
                _place([(place / name, folder / name) for name in names])
            finally:
                shutil.rmtree(place, ignore_errors=True)
    except OSError as error:
        raise CasacalError(f"'{folder}' cannot be written ({error.strerror})", "Choose another place") from error
    finally:
        if made:  # and still empty: another run may have come in between
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def side_by_side(targets: Sequence[Path]) -> Iterator[list[Path]]:
    """Places for files that go to targets in one folder, as `together` does; yields where to write each."""
    folder = targets[0].parent
    with together(folder, [target.name for target in targets]) as place:
        yield [place / target.name for target in targets]


def _place(moves: Sequence[tuple[Path, Path]]) -> None:
    """Put files where they belong, after those of before are gone; a link's target is written, not the link."""
    ends = [(source, Path(os.path.realpath(target))) for source, target in moves]
    for _, target in ends:
        if target.exists() and not target.is_file():
            raise CasacalError(f"'{target}' is no file", "Name another folder for the answer, or remove it")
    with _undisturbed():
        for _, target in reversed(ends):
            target.unlink(missing_ok=True)
        for source, target in ends:
            if source.exists():
                shutil.move(source, target)  # which copies where a link leads to another disk


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder against other runs; where the system has no such locks, against none."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CasacalError(
                f"Another run is writing into '{folder}'", "Wait until it is done, or name another folder"
            ) from None
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(handle)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Let signals that end a program wait until the block is done."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    names = ["SIGINT", "SIGTERM"] + ([] if sys.platform == "win32" else ["SIGHUP"])
    before: dict[int, Any] = {}
    for number in (getattr(signal, name) for name in names):
        if signal.getsignal(number) is not None:  # else something outside Python handles it
            before[number] = signal.signal(number, lambda one, _: came.append(one))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])

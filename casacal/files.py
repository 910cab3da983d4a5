"""Files out: written whole or not at all, also several that belong together."""

from __future__ import annotations

import glob
import hashlib
import json
import math
import os
import platform
import secrets
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from casacal.errors import CasacalError


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file completely, then put it in place; raises CasacalError when it cannot."""
    # names of files may hold bytes that are no text: escaped, as JSON has them
    place_whole(path, lambda place: place.write_bytes(text.encode("utf-8", errors="backslashreplace")))


def place_whole(path: str | Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it; raises CasacalError when it cannot.

    Where `path` is a link, what it leads to is written; what exists and is no file, such as a device, is written into.
    """
    target = Path(path)
    if target.is_dir():
        raise CasacalError(f"'{target}' is a folder", "Name a file")
    if target.exists() and not target.is_file():  # /dev/stdout may lead to a pipe, which has no path of its own
        with writable(target), tempfile.TemporaryDirectory() as place, target.open("wb") as out:
            write(Path(place) / "whole")
            out.write((Path(place) / "whole").read_bytes())
        return
    if target.is_symlink():
        target = Path(os.path.realpath(target))
    with writable(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        prefix = f".{target.name}."
        sweep(target.parent, prefix)
        temporary = target.with_name(f"{prefix}{mark_of_this_run()}-{secrets.token_hex(4)}{target.suffix}")
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # less what the umask takes away
        try:
            if target.exists():
                shutil.copymode(target, temporary)
            write(temporary)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def writable(place: Path) -> Iterator[None]:
    """Say in a CasacalError what the system has against writing a place, if it refuses what the block does there."""
    try:
        yield
    except OSError as error:
        raise CasacalError(f"'{place}' cannot be written ({error.strerror})", "Choose another place") from error


def check_writable(folder: Path) -> None:
    """Raise CasacalError where a folder cannot be written or made; nothing of the trial stays."""
    above = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    with writable(folder), tempfile.TemporaryDirectory(dir=above, prefix=PREFIX):
        pass


def mark_of_this_run() -> str:
    """What names of temporary files say of who made them: machine and process."""
    return f"{_machine()}-{os.getpid()}"


def sweep(folder: Path, prefix: str) -> None:
    """Remove temporary files and folders of runs on this machine that ended without doing so."""
    for left in folder.glob(f"{glob.escape(prefix)}{_machine()}-*"):
        process = left.name.removeprefix(f"{prefix}{_machine()}-").partition("-")[0]
        if process.isdecimal() and not _runs(int(process)):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)


def _machine() -> str:
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _runs(process: int) -> bool:
    """Whether a process with this number runs; where that cannot be asked, it is taken to."""
    if os.name == "nt":  # there, asking would end it
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def write_json(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a document as JSON; numbers that are not finite become null, as JSON has none."""
    write_text(path, json_text(document))


def json_text(document: Mapping[str, Any], *, ascii_only: bool = False) -> str:
    """The same as text; `ascii_only` escapes every other letter."""
    return json.dumps(jsonable(document), indent=1, ensure_ascii=ascii_only, allow_nan=False) + "\n"


def jsonable(value: Any) -> Any:
    """The value in JSON's own types; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [jsonable(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


PREFIX = ".casacal-"


@contextmanager
def together(folder: Path, names: Sequence[str], *, asked: Path | None = None) -> Iterator[Path]:
    """A place for files that all take their places in a folder at the end, or none of them.

    Files of the same names from an earlier run go first, so that the folder never holds files of two runs; the last
    name comes last, so that where it stands all stand. Signals wait meanwhile.

    Args:
        folder: made where it does not exist; removed again if it was made and nothing came of it.
        names: files that may be made, in the order in which they are placed.
        asked: what a refusal names; by default the folder.

    Raises CasacalError when the folder cannot be written, or another run is writing into it.

    """
    made = not folder.exists()
    try:
        with writable(asked or folder):
            folder.mkdir(parents=True, exist_ok=True)
            with _locked(folder):
                sweep(folder, PREFIX)
                place = Path(tempfile.mkdtemp(dir=folder, prefix=f"{PREFIX}{mark_of_this_run()}-"))
                try:
                    yield place
                    _place([(place / name, folder / name) for name in names])
                finally:
                    shutil.rmtree(place, ignore_errors=True)
    finally:
        if made:  # and still empty: another run may have come in between
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def side_by_side(targets: Sequence[Path]) -> Iterator[list[Path]]:
    """Places for files that go to targets in one folder, as `together` does, the last one named where it refuses."""
    folder = targets[0].parent
    with together(folder, [target.name for target in targets], asked=targets[-1]) as place:
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

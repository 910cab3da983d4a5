"""Files out: written whole or not at all, also several that belong together; never over what others wrote."""

from __future__ import annotations

import glob
import hashlib
import json
import math
import os
import platform
import re
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
from casacal.public import __version__

MADE = f"written by casacal {__version__}"
"""Mark of a file that casacal wrote: in a comment near its beginning or at its end, or as a JSON key (`BY`)."""

BY, LOOKED_AT = "written_by", 8192
UNSEALED = ("seal", "seconds", BY)  # keys of a sealed document that may change
MARKS = re.compile(
    rb"(?m)^[ \t]*(?:#|[!;*]|//|<!--) ?(?:[^\n]*[ (])?written by casacal (?:\d|compensate:|demo|study|bench|for )"
    rb'|\A"""[^\n]*; written by casacal \d'
    rb"|^[ \t]*[#!;] (?:planned|simulated) by casacal "
    rb'|\A\s*\{\s*"written_by": "(?:written by )?casacal |<meta name="generator" content="written by casacal">'
    rb"|\A\x89PNG[^\n]*\n[\s\S]*Software\x00casacal "
)
MEASURED_HEAD = b"# measured by casacal"
MEASURED = re.compile(rb"# measured by casacal|(?m:^[^#\n]*order,touch,purpose,kept)")
FILLED_IN = re.compile(rb"(?m)^(?:[^#\n]*[,;\t])?reading_")  # a plan into which somebody wrote readings


def refuse_others(path: str | Path, *, option: str = "--out") -> None:
    """Raise CasacalError where a path is a file that casacal did not write, or that holds measured rows."""
    target = Path(path)
    if not target.is_file():
        return
    try:
        with target.open("rb") as file:
            head = file.read(LOOKED_AT)
            file.seek(max(target.stat().st_size - LOOKED_AT, 0))
            ends = head + b"\n" + file.read()
    except OSError as error:
        what = f"'{target}' exists and cannot be read ({error.strerror})"
        raise CasacalError(what, f"Name another {option}") from error
    measured = MEASURED.search(head) or (b" planned by casacal " in head and FILLED_IN.search(head))
    if measured or (head and not MARKS.search(ends)):
        what = "holds measured rows" if measured else "was not written by casacal"
        raise CasacalError(f"'{target}' exists and {what}", f"Name another {option}, or remove it first")


def write_text(path: str | Path, text: str, *, own: bool = False) -> None:
    """Write a UTF-8 text file completely, then put it in place; raises CasacalError when it cannot.

    own: whether the caller knows a file that stands there for its own; else it must bear a mark of casacal.
    """
    # names of files may hold bytes that are no text: escaped, as JSON has them
    place_whole(path, lambda place: place.write_bytes(text.encode("utf-8", errors="backslashreplace")), own=own)


def place_whole(path: str | Path, write: Callable[[Path], object], *, own: bool = False) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it; raises CasacalError when it cannot.

    Where `path` is a link, what it leads to is written; what exists and is no file, such as a device, is written into.
    own: as for `write_text`.
    """
    target = Path(path)
    if target.is_dir():
        raise CasacalError(f"'{target}' is a folder", "Name a file")
    if not own:
        refuse_others(target)
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
        if place.parent.name.startswith(PREFIX):  # written aside, where nobody asked for it
            place = place.parent.parent / place.name
        fix = "Make room or give the right to write there, or choose another place"
        raise CasacalError(f"'{place}' cannot be written ({error.strerror})", fix) from error


def check_writable(folder: Path) -> None:
    """Raise CasacalError where a folder cannot be written or made; nothing of the trial stays."""
    above = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    with writable(folder), tempfile.TemporaryDirectory(dir=above, prefix=PREFIX):
        pass


def mark_of_this_run() -> str:
    """Machine and process, as names of temporary files carry them."""
    return f"{hashlib.sha256(platform.node().encode()).hexdigest()[:8]}-{os.getpid()}"


def sweep(folder: Path, prefix: str) -> None:
    """Remove temporary files and folders of runs on this machine that ended without doing so."""
    machine = mark_of_this_run().partition("-")[0]
    for left in folder.glob(f"{glob.escape(prefix)}{machine}-*"):
        process = left.name.removeprefix(f"{prefix}{machine}-").partition("-")[0]
        if process.isdecimal() and not _runs(int(process)):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)


def _runs(process: int) -> bool:
    """Whether a process with this number runs; True where the system cannot tell."""
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
    """Write a document as JSON, marked; numbers that are not finite become null, as JSON has none."""
    write_text(path, json_text({BY: f"casacal {__version__}", **document}))


def json_text(document: Mapping[str, Any], *, ascii_only: bool = False) -> str:
    """A document as JSON text; `ascii_only` escapes every other letter."""
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


def sealed(document: Mapping[str, Any]) -> dict[str, Any]:
    """The document with its seal, made anew where it has one."""
    keys = sorted(key for key in document if key not in UNSEALED)
    kept = {key: item for key, item in document.items() if key != "seal"}
    return {**kept, "seal": {"of": keys, "sha256": seal_of(jsonable(kept), keys)}}


def seal_of(document: Mapping[str, Any], keys: Sequence[str]) -> str:
    """SHA-256 of some keys of a document in JSON's own types."""
    guarded = [list(keys), {key: document[key] for key in keys if key in document}]
    return hashlib.sha256(json.dumps(guarded, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


@contextmanager
def together(folder: Path, names: Sequence[str], *, named: Path | None = None, own: bool = False) -> Iterator[Path]:
    """Temporary folder whose files are moved into `folder` at the end: all of them, or none.

    Files of the same names from an earlier run that are not made again go, so that the folder never holds files of two
    runs; the last name comes last, so that where it stands all stand. Signals wait meanwhile. What a kill interrupts
    there, `recover` brings to its end. The folder is made where it does not exist, and removed if nothing came of it.

    names: files that may be made, in the order in which they are placed. named: what a refusal names; by default the
    folder. own: as for `write_text`. Raises CasacalError when the folder cannot be written, or another run is writing
    into it, or a file there was not written by casacal.
    """
    made = not folder.exists()
    try:
        with writable(named or folder):
            folder.mkdir(parents=True, exist_ok=True)
            with _locked(folder):
                sweep(folder, PREFIX)
                _finish(folder)
                for name in names:
                    _refuse(folder / name, own=own)  # before anything is made ready that would have to be placed
                place = Path(tempfile.mkdtemp(dir=folder, prefix=f"{PREFIX}{mark_of_this_run()}-"))
                try:
                    yield place
                    _place(folder, place, names, own)
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
    with together(folder, [target.name for target in targets], named=targets[-1]) as place:
        yield [place / target.name for target in targets]


READY, LIST = ".casacal.ready-", ".list"
"""Prefix of a folder of finished files that are being moved to their places, and the suffix of the list of them."""


def _place(folder: Path, place: Path, names: Sequence[str], own: bool) -> None:
    """Put files where they belong; a link's target is written, not the link."""
    for name in names:
        if (folder / name).exists() and not (folder / name).is_file():
            raise CasacalError(f"'{folder / name}' is no file", "Name another folder for the answer, or remove it")
    rows = [(name, (place / name).exists()) for name in names]
    (place / LIST).write_text(json.dumps({"files": rows, "own": own}), encoding="utf-8")
    with _undisturbed():
        os.rename(place, folder / f"{READY}{secrets.token_hex(4)}")  # from here on the new files are those that count
        _finish(folder)


def _finish(folder: Path) -> None:
    """Put files that are ready in their places, never over what somebody put there meanwhile (CasacalError)."""
    for ready in folder.glob(f"{READY}*"):
        if not (ready / LIST).exists():  # all are placed, and it was being removed
            with suppress(OSError):
                ready.rmdir()
            continue
        try:
            listed = json.loads((ready / LIST).read_text(encoding="utf-8"))
            own, rows = listed["own"] is True, [(str(name), made is True) for name, made in listed["files"]]
            sound = bool(rows) and all(Path(name).name == name for name, _ in rows)
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            sound = False
        if not sound:  # somebody else's folder
            continue
        ends = {name: Path(os.path.realpath(folder / name)) for name, _ in rows}
        for target in ends.values():
            _refuse(target, own=own, fix=f"Move it away, or remove '{ready}', which holds what should be there")
        last = rows[-1][0]
        if (ready / last).exists() and len(rows) > 1 and not own:
            ends[last].unlink(missing_ok=True)
        for name, made in rows:
            if not made:
                ends[name].unlink(missing_ok=True)
            elif (ready / name).exists():
                shutil.move(ready / name, ends[name])  # which copies where a link leads to another disk
        shutil.rmtree(ready, ignore_errors=True)


def _refuse(target: Path, *, own: bool, fix: str = "Move it away") -> None:
    """Raise CasacalError where a set of files must not be put in a place: `own` ones are measured rows."""
    if not own:
        refuse_others(target)
    elif target.is_file() and not (target.read_bytes() or MEASURED_HEAD).startswith(MEASURED_HEAD):
        raise CasacalError(f"'{target}' was put in the place of measured rows", fix)


def recover(folder: Path) -> None:
    """Put a set of files in their places whose run was killed on the way, if there is one in a folder."""
    with suppress(OSError, CasacalError):  # not ours to write, another run is at it, or somebody was there meanwhile
        if any(folder.glob(f"{READY}*")):
            with _locked(folder), _undisturbed():
                _finish(folder)


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
            fix = "Wait until it is done, or name another folder"
            raise CasacalError(f"Another run is writing into '{folder}'", fix) from None
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

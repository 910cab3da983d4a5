"""Records of trials: one line of JSON each, appended whole, safe against being killed at any moment."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import json
import math
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from casacal.errors import StudyError
from casacal.files import place_whole, write_text

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Record: TypeAlias = dict[str, Any]
Key: TypeAlias = tuple[str, int]

DIGITS = 10
"""Significant digits that a record keeps of a number."""
TIMING_DIGITS = 4
TIMINGS = "seconds"
"""The one entry of a record that may differ when the trial is run again."""


def key_of(record: Mapping[str, Any]) -> Key:
    """What determines a record: the fingerprint of setting, method, seed and code; and the trial."""
    return str(record["fingerprint"]), int(record["trial"])


def to_line(record: Mapping[str, Any]) -> str:
    """A record as one line of JSON with sorted keys; numbers to ten digits, timings to four, null where not finite."""
    plain = {key: _rounded(value, TIMING_DIGITS if key == TIMINGS else DIGITS) for key, value in record.items()}
    return json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False) + "\n"


def read_records(path: Path) -> list[Record]:
    """Records of a file, or of the same file gzipped, without the last line where a kill cut it short.

    None when there is no file. Raises StudyError for a line that is no record.
    """
    content = _content_of(path)
    records = []
    for number, line in enumerate(content[: content.rfind(b"\n") + 1].splitlines(), start=1):
        try:
            record = json.loads(line)
            key_of(record)
        except (ValueError, KeyError, TypeError):
            raise StudyError(
                f"Line {number} of '{path}' is not a record", "Restore the file, or remove that line and resume"
            ) from None
        records.append(record)
    return records


@contextlib.contextmanager
def appending(path: Path) -> Iterator[Appender]:
    """Open a record file for appending, repairing a last line cut short; raises StudyError when another run has it.

    A gzipped file is unpacked beside itself.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() and _packed(path).is_file():
            place_whole(path, lambda place: place.write_bytes(_content_of(path)))
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
    except OSError as error:
        raise StudyError(f"'{path}' cannot be written ({error.strerror})", "Choose another folder") from error
    try:
        try:
            _lock(handle)
        except OSError:
            raise StudyError(f"Another run is writing '{path}'", "Wait for it, or choose another folder") from None
        os.ftruncate(handle, path.read_bytes().rfind(b"\n") + 1)
        yield Appender(handle, path)
    finally:
        os.close(handle)


def _lock(handle: int) -> None:
    """Let one process write a file; raises OSError where another one does. The lock ends with the process."""
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:  # Windows: a byte far beyond the end, so that all others can be read
        import msvcrt

        os.lseek(handle, 1 << 40, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)


class Appender:
    """Appends records to an open file, some at a time in one write."""

    def __init__(self, handle: int, path: Path) -> None:
        self._handle, self._path = handle, path

    def rewrite(self, records: Iterable[Record]) -> None:
        """Put other records in place of all, at once; where an open file cannot be replaced, over them."""
        data = "".join(to_line(record) for record in records)
        if os.name != "nt":
            write_text(self._path, data)
            return
        os.ftruncate(self._handle, 0)
        os.write(self._handle, data.encode())
        os.fsync(self._handle)

    def append(self, records: Iterable[Record]) -> None:
        """Write whole lines and wait until they are on the disk."""
        data = "".join(to_line(record) for record in records).encode()
        while data:
            data = data[os.write(self._handle, data) :]
        os.fsync(self._handle)


def merged(parts: Sequence[Iterable[Record]]) -> list[Record]:
    """All records of several runs, each key once.

    Raises StudyError when two records of one key differ in more than their timings.
    """
    found: dict[Key, Record] = {}
    for record in (record for part in parts for record in part):
        other = found.setdefault(key_of(record), record)
        if _content(other) != _content(record):
            raise StudyError(
                f"Two records of setting '{record['setting']}', method '{record['method']}', trial {record['trial']} "
                "differ",
                "They come from machines or packages that compute differently; run these parts on one kind of machine",
            )
    return list(found.values())


def records_digest(records: Iterable[Record]) -> str:
    """SHA-256 of records in their order, timings and fingerprints aside.

    Equal numbers have equal digests, also from a later version that computes the same.
    """
    return hashlib.sha256("".join(_content(record) for record in records).encode()).hexdigest()


def _packed(path: Path) -> Path:
    return path.with_name(path.name + ".gz")


def _content_of(path: Path) -> bytes:
    try:
        if path.is_file():
            return path.read_bytes()
        return gzip.decompress(_packed(path).read_bytes()) if _packed(path).is_file() else b""
    except (OSError, EOFError, zlib.error) as error:
        said = getattr(error, "strerror", None) or str(error)
        raise StudyError(f"'{path}' cannot be read ({said})", "Check the folder, or restore the file") from error


def _content(record: Mapping[str, Any]) -> str:
    return to_line({name: value for name, value in record.items() if name not in (TIMINGS, "fingerprint")})


def _rounded(value: Any, digits: int) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _rounded(item, digits) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item, digits) for item in value]
    return value

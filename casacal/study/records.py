"""Records of trials: one line of JSON each, appended whole, safe against being killed at any moment."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import json
import math
import os
import re
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

DIGITS = 10  # significant digits that a record keeps of a number
TIMING_DIGITS = 4
TIMINGS = "seconds"  # the one entry of a record that may differ when the trial is run again
LIMIT = "limit"  # what a record has besides where a time limit ended its method: that limit in seconds
_CHECKED = re.compile(rb',"check":"([0-9a-f]{16})"}$')
"""How a line ends: with the first half of the SHA-256 of the line without this end."""


def key_of(record: Mapping[str, Any]) -> Key:
    """What determines a record: the fingerprint of setting, method, seed and code; and the trial."""
    return str(record["fingerprint"]), int(record["trial"])


def to_line(record: Mapping[str, Any]) -> str:
    """A record as one line of JSON with sorted keys, and a checksum of it at the end.

    Numbers have ten digits, timings four, and are null where not finite.
    """
    text = _text(record)
    return f'{text[:-1]},"check":"{_checksum(text.encode())}"}}\n'


def _text(record: Mapping[str, Any]) -> str:
    plain = {key: _rounded(value, TIMING_DIGITS if key == TIMINGS else DIGITS) for key, value in record.items()}
    return json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _checksum(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()[:16]


def read_records(path: Path) -> list[Record]:
    """Records of a file, or of the same file gzipped, without the last line where a kill cut it short.

    None when there is no file. Raises StudyError for a line that is no record or is not as it was written, and for two
    records of one trial and method that differ. Only where no line has a checksum, as in files of versions before there
    were any, none is asked for.
    """
    content = _content_of(path)
    lines = content[: content.rfind(b"\n") + 1].splitlines()
    checked = any(_CHECKED.search(line) for line in lines)
    return merged([[_record(line, path, number, checked) for number, line in enumerate(lines, start=1)]])


def _record(line: bytes, path: Path, number: int, checked: bool) -> Record:
    """The record of a line; raises StudyError when it is none, or `checked` and not as it was written."""
    end = _CHECKED.search(line)
    whole = end is not None and end[1] == _checksum(line[: end.start()] + b"}").encode()
    try:
        record = json.loads(line)
        key_of(record)
    except (ValueError, KeyError, TypeError, RecursionError):
        record = None
    if not isinstance(record, dict) or (checked and not whole):
        of = ""
        if isinstance(record, dict):
            of = ", ".join(f" {k} {record[k]!r}" for k in ("setting", "method", "trial") if k in record)
        what = f"is damaged: its checksum is not that of what it says ({of.strip()})" if of else "is not a record"
        raise StudyError(f"Line {number} of '{path}' {what}", "Restore the file, or remove that line and resume")
    record.pop("check", None)
    return record


@contextlib.contextmanager
def appending(path: Path) -> Iterator[Appender]:
    """Open a record file for appending, repairing a last line cut short; raises StudyError when another run has it.

    A gzipped file is unpacked beside itself.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() and _packed(path).is_file():
            place_whole(path, lambda place: place.write_bytes(_content_of(path)), own=True)
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
            write_text(self._path, data, own=True)
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
    """All records of several runs, each key once; what a time limit ended gives way to what had more time.

    Raises StudyError when two records of one key differ in more than their timings.
    """
    found: dict[Key, Record] = {}
    for record in (record for part in parts for record in part):
        other = found.setdefault(key_of(record), record)
        if other is record:
            continue
        if had_less_time(other, record):
            found[key_of(record)] = record
        elif not had_less_time(record, other) and _content(other) != _content(record):
            raise StudyError(
                f"Two records of setting '{record['setting']}', method '{record['method']}', trial {record['trial']} "
                "differ",
                "They come from machines or packages that compute differently, or one was edited; run these parts on "
                "one kind of machine",
            )
    return list(found.values())


def had_less_time(one: Record, other: Record) -> bool:
    """Whether a time limit ended one record's method that the other's did not have, or had longer."""
    return LIMIT in one and float(one[LIMIT]) < float(other.get(LIMIT, math.inf))


def records_digest(records: Iterable[Record]) -> str:
    """SHA-256 of records in their order, timings and fingerprints aside.

    Equal numbers have equal digests, also from a later version that computes the same.
    """
    return hashlib.sha256("".join(f"{_content(record)}\n" for record in records).encode()).hexdigest()


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
    return _text({name: value for name, value in record.items() if name not in (TIMINGS, "fingerprint")})


def _rounded(value: Any, digits: int) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _rounded(item, digits) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item, digits) for item in value]
    return value

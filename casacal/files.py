"""Files out: written whole or not at all."""

from __future__ import annotations

import glob
import hashlib
import json
import math
import os
import platform
import secrets
import shutil
import tempfile
from collections.abc import Callable, Mapping
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
    if target.is_symlink():
        target = Path(os.path.realpath(target))
    if target.is_dir():
        raise CasacalError(f"'{target}' is a folder", "Name a file")
    if target.exists() and not target.is_file():
        _into(target, write)
        return
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        prefix = f".{target.name}."
        sweep(target.parent, prefix)
        temporary = target.with_name(f"{prefix}{mark_of_this_run()}-{secrets.token_hex(4)}{target.suffix}")
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # less what the umask takes away
    except OSError as error:
        raise CasacalError(f"'{target}' cannot be written ({error.strerror})", "Choose another place") from error
    try:
        if target.exists():
            shutil.copymode(target, temporary)
        write(temporary)
        os.replace(temporary, target)
    except OSError as error:
        raise CasacalError(f"'{target}' cannot be written ({error.strerror})", "Choose another place") from error
    finally:
        temporary.unlink(missing_ok=True)


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


def _into(device: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a file elsewhere, and copy it into a device or pipe; raises CasacalError when it cannot."""
    try:
        with tempfile.TemporaryDirectory() as place, device.open("wb") as out:
            write(Path(place) / "whole")
            out.write((Path(place) / "whole").read_bytes())
    except OSError as error:
        raise CasacalError(f"'{device}' cannot be written ({error.strerror})", "Choose another place") from error


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

"""Shared libraries from C source, kept in the user's cache folder and never trusted blindly.

A library is named by the hash of what it was made from (source, compiler, flags, processor) and by a keyed hash of that
name and of its content. The key is 32 random bytes in a file that only this user can read, in the user's own cache
folder, also where CASACAL_CACHE moves the libraries elsewhere. So a file that was damaged, renamed, copied from
elsewhere or planted by somebody who does not have the key is not loaded; who can read the user's files can do worse.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import hmac
import os
import platform
import secrets
import shutil
import stat
import tempfile
from collections.abc import Sequence
from pathlib import Path

from casacal.kernels.compiler import FLAGS, MACOS, SUFFIX, TUNING, WINDOWS, Compiler, CompilerError, compiler

KEY, KEY_BYTES = "libraries.key", 32


def load_library(source: str, functions: Sequence[str]) -> ctypes.CDLL:
    """The library of a C source with some functions, compiled now or before; raises CompilerError.

    What is in the cache is loaded when it is what was compiled, and compiled anew when it is not.
    """
    chosen, folder = compiler(), cache_folder()
    told = "\n".join([source, *chosen.command, chosen.version, *FLAGS, str(TUNING), _processor()])
    name = hashlib.sha256(told.encode()).hexdigest()[:32]
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not _ours(folder):
            raise CompilerError(f"the cache folder {folder} can be written by others")
        key = _key(folder)
        for found in sorted(folder.glob(f"{name}-*{SUFFIX}")):
            if _whole(found, name, key):
                with contextlib.suppress(CompilerError):
                    return _loaded(found, functions, chosen)
            _remove(found)
        made = _made(source, chosen, folder, name, key)
        try:
            return _loaded(made, functions, chosen)
        except CompilerError:
            _remove(made)
            raise
    except OSError as error:
        raise CompilerError(f"the cache folder {folder} cannot be used ({error.strerror or error})") from error


def cache_folder() -> Path:
    """CASACAL_CACHE, else casacal/ in the user's cache folder; raises CompilerError where there is none."""
    given = os.environ.get("CASACAL_CACHE")
    return Path(given) if given else _users_folder()


def _users_folder() -> Path:
    base = os.environ.get("LOCALAPPDATA" if WINDOWS else "XDG_CACHE_HOME")
    if base:
        return Path(base) / "casacal"
    try:
        home = Path.home()
    except RuntimeError as error:
        raise CompilerError("this user has no home folder for a cache") from error
    return home / ("Library/Caches" if MACOS else ".cache") / "casacal"


def _made(source: str, chosen: Compiler, folder: Path, name: str, key: bytes) -> Path:
    """Compile beside its place and rename, so that processes that race see a whole file or none."""
    with tempfile.TemporaryDirectory(dir=folder, prefix=".", ignore_cleanup_errors=True) as place:
        made = chosen.build(source, Path(place))
        made.chmod(0o700)
        target = folder / f"{name}-{_seal(made, name, key)}{SUFFIX}"
        if not target.exists():  # while it is in use, Windows refuses to replace it
            os.replace(made, target)
        return target


def _loaded(path: Path, functions: Sequence[str], chosen: Compiler) -> ctypes.CDLL:
    """A library, once it is sure to have the functions; raises CompilerError."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise CompilerError(f"what {chosen} made cannot be loaded ({error})") from error
    lacking = [function for function in functions if not hasattr(library, function)]
    if lacking:
        raise CompilerError(f"what {chosen} made has no function {lacking[0]}")
    return library


def _seal(path: Path, name: str, key: bytes) -> str:
    """Keyed hash of a library's content and of what it was made from."""
    with path.open("rb") as file:
        content = hashlib.file_digest(file, "sha256").digest()
    return hmac.digest(key, name.encode() + content, "sha256").hex()[:32]


def _whole(path: Path, name: str, key: bytes) -> bool:
    """Whether a file of the cache is the user's alone and what was compiled under this name."""
    if not stat.S_ISREG(path.lstat().st_mode) or not _ours(path):
        return False
    return hmac.compare_digest(path.stem.partition("-")[2], _seal(path, name, key))


def _remove(path: Path) -> None:
    """Remove what is not what it should be, as far as the system lets go of it."""
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _key(folder: Path) -> bytes:
    """The user's key, from the user's own cache folder, else from beside the libraries; made where there is none."""
    places = [folder]
    with contextlib.suppress(CompilerError):
        places.insert(0, _users_folder())
    for place in places:
        with contextlib.suppress(OSError):
            place.mkdir(parents=True, exist_ok=True, mode=0o700)
            if _ours(place):
                return _key_in(place)
    raise CompilerError(f"no key can be kept in the cache folder {folder}")


def _key_in(folder: Path) -> bytes:
    """The key of a folder, made where there is none that is this user's alone."""
    path = folder / KEY
    if (found := _read_key(path)) is not None:
        return found
    handle, temporary = tempfile.mkstemp(dir=folder, prefix=".")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(secrets.token_bytes(KEY_BYTES))
        try:
            os.link(temporary, path)  # of processes that race, one makes it
        except OSError:
            if _read_key(path) is None:  # what is there is no key, or the file system knows no links
                _remove(path)
                os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)
    made = _read_key(path)
    if made is None:
        raise OSError(f"{path} cannot be read")
    return made


def _read_key(path: Path) -> bytes | None:
    """A key that nobody else can read or write; None where there is no such file."""
    try:
        about = path.lstat()
        if not stat.S_ISREG(about.st_mode) or not _ours(path) or (hasattr(os, "getuid") and about.st_mode & 0o077):
            return None
        found = path.read_bytes()
    except OSError:
        return None
    return found if len(found) == KEY_BYTES else None


def _ours(path: Path) -> bool:
    """Whether a path belongs to this user and nobody else can write it; where there are no owners, yes."""
    if not hasattr(os, "getuid"):
        return True
    about = path.stat()
    return about.st_uid == os.getuid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


@functools.cache
def _processor() -> str:
    """What -march=native depends on; where nobody tells, the machine, for home folders may be shared."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()} {platform.node()}"
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())

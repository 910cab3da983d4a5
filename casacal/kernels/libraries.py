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

from casacal.kernels.compiler import FLAGS, MACOS, SUFFIX, TUNING, WINDOWS, CompilerError, compiler

KEY, KEY_BYTES = "libraries.key", 32
WRITABLE, VISIBLE = 0o022, 0o077  # bits of a mode by which others can write, and do anything at all


def load_library(source: str, functions: Sequence[str]) -> ctypes.CDLL:
    """The library of a C source with some functions, compiled now or before; raises CompilerError.

    What is in the cache is loaded when it is what was compiled, and compiled anew when it is not. It is compiled beside
    its place and renamed, so that processes that race see a whole file or none.
    """
    chosen, folder = compiler(), cache_folder()
    told = "\n".join([source, *chosen.command, chosen.version, *FLAGS, str(TUNING), _processor()])
    name = hashlib.sha256(told.encode()).hexdigest()[:32]
    try:
        key = _key(_private(folder))
        for found in sorted(folder.glob(f"{name}-*{SUFFIX}")):
            content = _content(found, WRITABLE)
            if content is not None and found.name == _sealed(name, content, key):
                with contextlib.suppress(CompilerError):
                    return _loaded(found, functions, str(chosen))
            _remove(found)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".", ignore_cleanup_errors=True) as place:
            made = chosen.build(source, Path(place))
            made.chmod(0o700)
            target = folder / _sealed(name, made.read_bytes(), key)
            if not target.exists():  # while it is in use, Windows refuses to replace it
                os.replace(made, target)
        try:
            return _loaded(target, functions, str(chosen))
        except CompilerError:
            _remove(target)
            raise
    except OSError as error:
        raise CompilerError(f"the cache folder {folder} cannot be used ({error.strerror or error})") from error


def cache_folder() -> Path:
    """CASACAL_CACHE, else casacal/ in the user's cache folder; raises CompilerError where there is none."""
    given = os.environ.get("CASACAL_CACHE")
    return Path(given) if given else _users_folder()


def _users_folder() -> Path:
    base = os.environ.get("LOCALAPPDATA" if WINDOWS else "XDG_CACHE_HOME")
    try:
        return Path(base or Path.home() / ("Library/Caches" if MACOS else ".cache")) / "casacal"
    except RuntimeError as error:
        raise CompilerError("this user has no home folder for a cache") from error


def _private(folder: Path) -> Path:
    """A folder, made where there is none; raises CompilerError where somebody else can write it."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    if not _ours(folder.stat(), WRITABLE):
        raise CompilerError(f"the cache folder {folder} can be written by others")
    return folder


def _ours(about: os.stat_result, forbidden: int) -> bool:
    """Whether something belongs to this user and its mode has no forbidden bit; where there are no owners, yes."""
    return not hasattr(os, "getuid") or (about.st_uid == os.getuid() and not about.st_mode & forbidden)


def _content(path: Path, forbidden: int) -> bytes | None:
    """What is in a file of this user; None where it is no file, a link, or its mode has a forbidden bit."""
    with contextlib.suppress(OSError):
        about = path.lstat()
        if stat.S_ISREG(about.st_mode) and _ours(about, forbidden):
            return path.read_bytes()
    return None


def _sealed(name: str, content: bytes, key: bytes) -> str:
    """File name of a library: what it was made from, and a keyed hash of that and of its content."""
    seal = hmac.digest(key, name.encode() + hashlib.sha256(content).digest(), "sha256").hex()[:32]
    return f"{name}-{seal}{SUFFIX}"


def _loaded(path: Path, functions: Sequence[str], made_by: str) -> ctypes.CDLL:
    """A library, once it is sure to have the functions; raises CompilerError."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise CompilerError(f"what {made_by} made cannot be loaded ({error})") from error
    for function in functions:
        if not hasattr(library, function):
            raise CompilerError(f"what {made_by} made has no function {function}")
    return library


def _remove(path: Path) -> None:
    """Remove what is not what it should be, as far as the system lets go of it."""
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _key(folder: Path) -> bytes:
    """The user's key, from the user's own cache folder, else from beside the libraries; made where there is none."""
    with contextlib.suppress(CompilerError, OSError):
        return _key_in(_private(_users_folder()))
    return _key_in(folder)


def _key_in(folder: Path) -> bytes:
    path = folder / KEY
    if _read_key(path) is None:
        with tempfile.TemporaryDirectory(dir=folder, prefix=".") as place:
            made = Path(place) / KEY
            made.touch(0o600)
            made.write_bytes(secrets.token_bytes(KEY_BYTES))
            try:
                os.link(made, path)  # of processes that race, one makes it
            except OSError:
                if _read_key(path) is None:  # what is there is no key, or the file system knows no links
                    _remove(path)
                    os.replace(made, path)
    if (found := _read_key(path)) is None:
        raise OSError(f"{path} cannot be read")
    return found


def _read_key(path: Path) -> bytes | None:
    found = _content(path, VISIBLE)
    return found if found is not None and len(found) == KEY_BYTES else None


@functools.cache
def _processor() -> str:
    """What -march=native depends on; where nobody tells, the machine, for home folders may be shared."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith(("flags", "Features")):
                return line
    return f"{platform.machine()} {platform.processor()} {platform.node()}"

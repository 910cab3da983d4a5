"""Shared libraries from C source, kept in the user's cache folder and never trusted blindly."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from pathlib import Path

WINDOWS, MACOS = os.name == "nt", platform.system() == "Darwin"
FOUND = "-Wl,--export-all-symbols" if WINDOWS else "-fPIC"
FLAGS = ("-O3", "-fno-math-errno", "-fno-trapping-math", "-shared", FOUND, "-std=gnu11")
"""Without -ffast-math: not-a-number and infinity stay what they are. Products may be fused with sums."""
TUNING = (("-march=native", "-fopenmp-simd"), ("-mcpu=native", "-fopenmp-simd"), ("-fopenmp-simd",), ())
"""What compilers are asked in turn until one set is understood: Apple's do not know all of them."""
LIBRARIES = () if WINDOWS else ("-lm",)
SUFFIX = ".dll" if WINDOWS else ".so"
SECONDS = 60


class CompilerError(Exception):
    """There is no working C compiler, the cache cannot be used, or there is nothing to compile."""


@functools.cache
def compiler() -> tuple[str, str]:
    """Path and version line of the C compiler: CC, else gcc, clang or cc (on Windows gcc); raises CompilerError."""
    names = [os.environ["CC"]] if os.environ.get("CC") else ["gcc"] if WINDOWS else ["gcc", "clang", "cc"]
    path = next((found for name in names if (found := shutil.which(name)) and not _is_stub(found)), None)
    if path is None:
        raise CompilerError(f"no C compiler found ({', '.join(names)})")
    try:
        done = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=SECONDS, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        raise CompilerError(f"{path} does not run ({type(error).__name__})") from error
    return path, done.stdout.partition("\n")[0]


def _is_stub(path: str) -> bool:
    """Whether a compiler of macOS only opens a window that offers Xcode."""
    if not MACOS or Path(path).parent != Path("/usr/bin"):
        return False
    try:
        return subprocess.run(["xcode-select", "-p"], capture_output=True, timeout=SECONDS).returncode != 0
    except (OSError, subprocess.SubprocessError):
        return True


def cache_folder() -> Path:
    """CASACAL_CACHE, else casacal/ in the user's cache folder; raises CompilerError where there is none."""
    given = os.environ.get("CASACAL_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("LOCALAPPDATA" if WINDOWS else "XDG_CACHE_HOME")
    if base:
        return Path(base) / "casacal"
    try:
        home = Path.home()
    except RuntimeError as error:
        raise CompilerError("this user has no home folder for a cache") from error
    return home / ("Library/Caches" if MACOS else ".cache") / "casacal"


def load_library(source: str) -> ctypes.CDLL:
    """The library of a C source, compiled now or before; raises CompilerError.

    A cached file is named by the hash of source, compiler, flags and processor, and by its own hash; it is loaded when
    both hold and when it and its folder belong to this user alone.
    """
    path, version = compiler()
    told = "\n".join([source, path, version, *FLAGS, str(TUNING), _processor()])
    key = hashlib.sha256(told.encode()).hexdigest()[:32]
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not _ours(folder):
            raise CompilerError(f"the cache folder {folder} can be written by others")
        for found in sorted(folder.glob(f"{key}-*{SUFFIX}")):
            if _ours(found) and found.stem.partition("-")[2] == _digest(found):
                return ctypes.CDLL(str(found))
            found.unlink(missing_ok=True)
        return ctypes.CDLL(str(_compiled(source, path, folder, key)))
    except OSError as error:
        raise CompilerError(f"the cache folder {folder} cannot be used ({error.strerror or error})") from error


def _compiled(source: str, path: str, folder: Path, key: str) -> Path:
    """Compile beside its place and rename, so that processes that race see a whole file or none."""
    with tempfile.TemporaryDirectory(dir=folder, prefix=".", ignore_cleanup_errors=True) as place:
        code, made = Path(place) / "kernel.c", Path(place) / f"kernel{SUFFIX}"
        code.write_text(source, encoding="utf-8")
        first = None
        for tuning in TUNING:
            refused = _refusal([path, *FLAGS, *tuning, str(code), "-o", str(made), *LIBRARIES])
            if refused is None:
                break
            first = first or refused
        else:
            raise CompilerError(f"{path} failed ({first})")
        made.chmod(0o700)
        target = folder / f"{key}-{_digest(made)}{SUFFIX}"
        if not target.exists():  # while it is in use, Windows refuses to replace it
            os.replace(made, target)
        return target


def _refusal(command: list[str]) -> str | None:
    """What a compiler said when it failed; None when it did not."""
    try:
        subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        said = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        return said[0] if said else type(error).__name__
    return None


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:32]


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

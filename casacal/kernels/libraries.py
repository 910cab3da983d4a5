"""Shared libraries from C source: the machine's compiler, and what it made, kept and never trusted blindly.

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
import shlex
import shutil
import signal
import stat
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

WINDOWS, MACOS = os.name == "nt", platform.system() == "Darwin"
FOUND = "-Wl,--export-all-symbols" if WINDOWS else "-fPIC"
FLAGS = ("-O2", "-fpeel-loops", "-fno-math-errno", "-fno-trapping-math", "-shared", FOUND, "-std=gnu11")
"""Without -ffast-math: not-a-number and infinity stay what they are. Products may be fused with sums. Of -O3 only the
peeling of loops pays; the rest takes a third of the time that a pose of seven joints takes to compile."""
TUNING = (("-march=native", "-fopenmp-simd"), ("-mcpu=native", "-fopenmp-simd"), ("-fopenmp-simd",), ())
"""Sets of compiler options, tried in turn until one is accepted: Apple's compilers do not know all of them."""
LIBRARIES = () if WINDOWS else ("-lm",)
SUFFIX = ".dll" if WINDOWS else ".so"
SECONDS, ANSWERS = 60.0, 15.0  # how long a compiler may take to compile, and to say its version
HEARD = 1 << 16  # bytes that are kept of what a compiler says; who says more than a pipe holds, waits until time is up


class CompilerError(Exception):
    """There is no working C compiler, the cache cannot be used, or there is nothing to compile."""


@dataclass(frozen=True)
class Compiler:
    """Command line of a C compiler, as words, and the first line of its version."""

    command: tuple[str, ...]
    version: str

    def __str__(self) -> str:
        return " ".join(self.command)

    def build(self, source: str, place: Path) -> Path:
        """Compile a source to a library in a folder; raises CompilerError when there is none afterwards."""
        code, made = place / "kernel.c", place / f"kernel{SUFFIX}"
        code.write_text(source, encoding="utf-8")
        reasons = []
        for tuning in TUNING:
            ended, said = _run([*self.command, *FLAGS, *tuning, str(code), "-o", str(made), *LIBRARIES], SECONDS)
            if ended is None:  # whatever it waits for, it would again
                raise CompilerError(f"{self} took longer than {SECONDS:g} s")
            if ended == 0:
                break
            reasons.append(said or f"exit code {ended}")
        else:
            raise CompilerError(f"{self} failed ({reasons[0]})")
        if made.is_symlink() or not made.is_file() or not made.stat().st_size:
            raise CompilerError(f"{self} wrote no library")
        return made


def compiler() -> Compiler:
    """The C compiler: CC, else gcc, clang or cc (on Windows gcc); raises CompilerError."""
    found = _find_compiler(os.environ.get("CC", ""))
    if isinstance(found, str):
        raise CompilerError(found)
    return found


@functools.cache
def _find_compiler(requested: str) -> Compiler | str:
    """The compiler that `requested` (CC) names, or a usual one; else the reason why there is none."""
    names = [requested] if requested.strip() else ["gcc"] if WINDOWS else ["gcc", "clang", "cc"]
    command = next((words for name in names if (words := _command(name))), None)
    if command is None:
        return f"no C compiler found ({', '.join(names)})"
    try:
        ended, said = _run([*command, "--version"], ANSWERS)
    except CompilerError as error:
        return str(error)
    if ended != 0:
        reason = "no answer" if ended is None else said or f"exit code {ended}"
        return f"{' '.join(command)} does not run ({reason})"
    return Compiler(command, said)


def _command(name: str) -> tuple[str, ...] | None:
    """A compiler by path or name, perhaps behind another program, as in "ccache gcc"; None where there is none."""
    ways = [[name]]
    with contextlib.suppress(ValueError):  # a quotation that does not end
        ways.append(shlex.split(name, posix=not WINDOWS))
    for words in ways:
        path = shutil.which(words[0]) if words else None
        if path is not None and not _is_stub(path):
            return path, *words[1:]
    return None


def _run(command: list[str], seconds: float) -> tuple[int | None, str]:
    """Exit code (None after `seconds`) and first line of output; raises CompilerError where nothing starts."""
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            bufsize=0,
            start_new_session=not WINDOWS,
        )
    except (OSError, ValueError) as error:
        raise CompilerError(f"{command[0]} does not run ({type(error).__name__})") from error
    code, heard = None, b""
    try:
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = process.wait(seconds)
    finally:
        if not WINDOWS:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)  # and whatever it started
        process.kill()
        process.wait()
    assert process.stdout is not None
    with process.stdout as pipe, contextlib.suppress(BlockingIOError):
        if not WINDOWS:
            os.set_blocking(pipe.fileno(), False)  # somebody may still hold the other end
        heard = os.read(pipe.fileno(), HEARD)
    lines = heard.decode(errors="replace").strip().splitlines()
    return code, "".join(c if c.isprintable() else "?" for c in lines[0])[:200] if lines else ""


def _is_stub(path: str) -> bool:
    """Whether a compiler of macOS only opens a window that offers Xcode."""
    if not MACOS or Path(path).parent != Path("/usr/bin"):
        return False
    try:
        return subprocess.run(["xcode-select", "-p"], capture_output=True, timeout=SECONDS).returncode != 0
    except (OSError, subprocess.SubprocessError):
        return True


KEY, KEY_BYTES = "libraries.key", 32
WRITABLE, VISIBLE = 0o022, 0o077  # bits of a mode by which others can write, and do anything at all


def load_library(source: str, functions: Sequence[str]) -> ctypes.CDLL:
    """The library of a C source with some functions, compiled now or before; raises CompilerError.

    What is in the cache is loaded when it is what was compiled, and compiled anew when it is not. It is compiled beside
    its place and renamed, so that processes that race see a whole file or none.
    """
    chosen, folder = compiler(), cache_folder()
    recipe = "\n".join([source, *chosen.command, chosen.version, *FLAGS, str(TUNING), _processor()])
    name = hashlib.sha256(recipe.encode()).hexdigest()[:32]
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
    folder = os.environ.get("CASACAL_CACHE")
    return Path(folder) if folder else _users_folder()


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
    """Content of a file of this user; None where it is no file, a link, or its mode has a forbidden bit."""
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
    """Identity of the processor for -march=native, or of the machine where unknown: home folders may be shared."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith(("flags", "Features")):
                return line
    return f"{platform.machine()} {platform.processor()} {platform.node()}"

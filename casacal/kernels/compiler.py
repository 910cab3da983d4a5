"""A C compiler of this machine: which one there is, and what it makes of a source."""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import shlex
import shutil
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path

WINDOWS, MACOS = os.name == "nt", platform.system() == "Darwin"
FOUND = "-Wl,--export-all-symbols" if WINDOWS else "-fPIC"
FLAGS = ("-O2", "-fpeel-loops", "-fno-math-errno", "-fno-trapping-math", "-shared", FOUND, "-std=gnu11")
"""Without -ffast-math: not-a-number and infinity stay what they are. Products may be fused with sums. Of -O3 only the
peeling of loops pays; the rest takes a third of the time that a pose of seven joints takes to compile."""
TUNING = (("-march=native", "-fopenmp-simd"), ("-mcpu=native", "-fopenmp-simd"), ("-fopenmp-simd",), ())
"""What compilers are asked in turn until one set is understood: Apple's do not know all of them."""
LIBRARIES = () if WINDOWS else ("-lm",)
SUFFIX = ".dll" if WINDOWS else ".so"
SECONDS, ANSWERS = 60.0, 15.0  # how long a compiler may take to compile, and to say its version
HEARD = 1 << 16  # bytes that are kept of what a compiler says; who says more than a pipe holds, waits until time is up


class CompilerError(Exception):
    """There is no working C compiler, the cache cannot be used, or there is nothing to compile."""


@dataclass(frozen=True)
class Compiler:
    """How a C compiler is called, as a list of words, and the first line of its version."""

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
            ended, said = _told([*self.command, *FLAGS, *tuning, str(code), "-o", str(made), *LIBRARIES], SECONDS)
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
    found = _asked(os.environ.get("CC", ""))
    if isinstance(found, str):
        raise CompilerError(found)
    return found


@functools.cache
def _asked(given: str) -> Compiler | str:
    """The compiler, asked once in a process, or why there is none."""
    names = [given] if given.strip() else ["gcc"] if WINDOWS else ["gcc", "clang", "cc"]
    command = next((words for name in names if (words := _command(name))), None)
    if command is None:
        return f"no C compiler found ({', '.join(names)})"
    try:
        ended, said = _told([*command, "--version"], ANSWERS)
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


def _told(command: list[str], seconds: float) -> tuple[int | None, str]:
    """Exit code (None: not in time) and first line of what a program says; raises CompilerError when none starts."""
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

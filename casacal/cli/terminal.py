"""Terminal capabilities (width, colour, letters), and output whose reader has gone away."""

from __future__ import annotations

import argparse
import ctypes
import errno
import os
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout, suppress
from typing import Any, TextIO

from casacal.errors import CasacalError

NARROWEST, USUAL, WIDEST = 40, 100, 120

GREEN, YELLOW, RED = "32", "33", "31"
LEVELS: Mapping[str, str] = {
    "calibrated": GREEN,
    "remark": GREEN,
    "use with care": YELLOW,
    "warning": YELLOW,
    "do not use": RED,
    "error": RED,
    "casacal:": RED,
}
"""First words of sentences, and the colours (ECMA-48) in which they are shown."""


def prepare() -> None:
    """Let output that is closed go nowhere, and letters that an encoding lacks be replaced rather than fail."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by whoever started this; opening takes its number, so that no file gets it
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif getattr(stream, "errors", "") in ("strict", "surrogateescape") and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


@contextmanager
def on_stderr() -> Iterator[None]:
    """Send what others print meanwhile, such as CasADi's solvers, to stderr: a program may read the output."""
    with redirect_stdout(sys.stderr):
        kept = os.dup(1)
        os.dup2(2, 1)
        try:
            yield
        finally:
            if os.name == "posix":
                ctypes.CDLL(None).fflush(None)  # what C has not written yet
            os.dup2(kept, 1)
            os.close(kept)


def redirect_words(out: str | None) -> AbstractContextManager[object]:
    """Redirect words to stderr where `out` is standard output itself (/dev/stdout)."""
    with suppress(OSError, ValueError):
        if out is not None and os.path.samestat(os.stat(out), os.fstat(1)):
            return redirect_stdout(sys.stderr)
    return nullcontext()


def width() -> int:
    """Characters in a line of output."""
    return min(max(shutil.get_terminal_size((USUAL, 24)).columns, NARROWEST), WIDEST)


def painted(text: str, stream: TextIO) -> str:
    """Text whose first words are coloured by what they say, where the output is a terminal and colour is wanted."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    if plain or not stream.isatty() or (os.name == "nt" and "WT_SESSION" not in os.environ):
        return text  # older consoles of Windows show the codes themselves
    for words, colour in LEVELS.items():
        if text.lower().startswith(words):
            return f"\x1b[1;{colour}m{text[: len(words)]}\x1b[0m{text[len(words) :]}"
    return text


def say(text: str = "") -> None:
    """Print on standard output; goes on in silence once nobody reads it."""
    _write(f"{text}\n", sys.stdout)


def say_lines(text: str) -> None:
    """Print lines as they are, each painted by what it begins with."""
    for line in text.rstrip("\n").split("\n"):
        say(painted(line, sys.stdout))


def wrapped(text: str) -> list[str]:
    """Lines of a paragraph."""
    return textwrap.wrap(text, width(), subsequent_indent="  ", break_on_hyphens=False, break_long_words=False)


def say_paragraphs(*texts: str) -> None:
    """Print paragraphs: broken into lines on a terminal, each in one piece for another program."""
    for text in texts:
        say(painted("\n".join(wrapped(text)) if sys.stdout.isatty() else text, sys.stdout))


def say_json(document: Mapping[str, Any]) -> None:
    """Print a document as JSON, in letters that every encoding has."""
    from casacal.files import json_text

    _write(json_text(document, ascii_only=True), sys.stdout)


def answer(options: argparse.Namespace, document: Mapping[str, Any], *texts: str) -> None:
    """Print what a command found: as JSON where --json asks for it, else in paragraphs."""
    if options.json:
        say_json(document)
    else:
        say_paragraphs(*texts)


def complain(text: str) -> None:
    """Print one line on standard error."""
    _write(f"{painted('casacal:', sys.stderr)} {text}\n", sys.stderr)


def prompt(text: str) -> None:
    """Write on standard output at once, without ending the line."""
    _write(text, sys.stdout, flush=True)


def write_progress(text: str) -> None:
    """Write on standard error at once, as it is."""
    _write(text, sys.stderr, flush=True)


def finish() -> None:
    """Send out what is still held back; raises CasacalError when it cannot be."""
    for stream in (sys.stdout, sys.stderr):
        _write("", stream, flush=True)


def _write(text: str, stream: TextIO, *, flush: bool = False) -> None:
    try:
        stream.write(text)
        if flush:
            stream.flush()
    except OSError as error:
        with suppress(OSError, ValueError):  # its reader left, or its disk is full: all that is held goes nowhere
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
        left = isinstance(error, BrokenPipeError) or error.errno == errno.EINVAL  # Windows' word for a broken pipe
        if stream is sys.stdout and not left:
            what = f"Standard output cannot be written ({error.strerror})"
            raise CasacalError(what, "Send it elsewhere") from error
    except ValueError:  # closed by someone in this process
        pass

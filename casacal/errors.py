"""Errors of casacal: what came, what exists, what to do."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches

from casacal.wording import numbered_lines

__all__ = ["ProblemError", "RefusedResultError", "SamplesError", "SimulationError", "StudyError"]
LONGEST = 1000  # letters of a refusal that anybody reads


def came(value: object) -> str:
    """Type of a value in words for a sentence: "a list", "an int", "nothing"."""
    if value is None:
        return "nothing"
    name = type(value).__name__
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


def said(error: BaseException) -> str:
    """Text of somebody else's exception on one line: "ValueError: too small"."""
    return f"{type(error).__name__}: {' '.join(str(error).split()).rstrip('.') or 'no message'}"


UNSHOWN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def harmless(text: str) -> str:
    """A text in which what would act on a terminal, or turn its letters round, is a question mark."""
    return UNSHOWN.sub("?", text)


class CasacalError(Exception):
    """A refusal in one sentence or two; the command line prints it on one line and exits with 2."""

    def __init__(self, what: str, fix: str) -> None:
        shown = (harmless(text) for text in (what, fix))  # values in it may be as long as a file
        self.what, self.fix = (text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..." for text in shown)
        super().__init__(f"{self.what}. {self.fix}.")

    def __reduce__(self) -> tuple[type[CasacalError], tuple[str, str]]:
        """Let a refusal travel from a worker process: what it says arrives, as the general kind."""
        return CasacalError, (self.what, self.fix)


class SamplesError(CasacalError):
    """A samples file that cannot be read as declared: names the file and, where known, line and column.

    also: further lines of which the same is true.
    """

    def __init__(
        self, file: str, what: str, fix: str, *, line: int | None = None, column: str | None = None,
        also: Sequence[int] = (),
    ) -> None:  # fmt: skip
        self.file, self.line, self.column = file, line, column
        place = file
        if line is not None:
            place += f", line {line}"
        if column is not None:
            place += f", column '{column}'"
        super().__init__(f"{place}: {what}{f'; {numbered_lines(also)} likewise' if len(also) else ''}", fix)


class ProblemError(CasacalError):
    """A robot, instrument or problem that is not well formed, or a problem file that cannot be loaded."""


class SimulationError(CasacalError):
    """A cell whose faces the robot cannot touch as requested."""


class RefusedResultError(CasacalError):
    """A result whose verdict is not to use it was asked for numbers: they are no calibrated arm."""


class StudyError(CasacalError):
    """A study, its records or its workers that are not as they must be."""


class UnknownNameError(CasacalError):
    """A name that does not exist, with the names that do."""

    def __init__(self, kind: str, name: str, existing: Iterable[str]) -> None:
        known = list(existing)
        close = get_close_matches(name, known, n=1)
        hint = f"Did you mean '{close[0]}'? " if close else ""
        shown = ", ".join(known[:40]) + (", ..." if len(known) > 40 else "")
        super().__init__(f"There is no {kind} named '{name}'", f"{hint}Known: {shown or 'none'}")


def refuse_unknown(kind: str, names: Iterable[object], existing: Iterable[str]) -> None:
    """Raise UnknownNameError for the first of some names that does not exist."""
    known = list(existing)
    for name in names:
        if name not in known:
            raise UnknownNameError(kind, str(name), known)

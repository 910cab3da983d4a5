"""One thing the doctor noticed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "remark"]


@dataclass(frozen=True)
class Finding:
    """Something about samples: how bad, about what, why, and what to do; `lines` where it is about rows.

    `instrument` names whose samples these are where a problem has several instruments.

    An error would make the result wrong; a warning makes it worse than it looks; a remark is good to know.
    """

    severity: Severity
    about: str
    cause: str
    fix: str
    lines: tuple[int, ...] = ()
    instrument: str = ""

    def __str__(self) -> str:
        where = f" (line{'s' if len(self.lines) > 1 else ''} {shown(self.lines)})" if self.lines else ""
        of = f"{self.instrument}: " if self.instrument else ""
        return f"{self.severity}: {of}{self.about}{where}: {self.cause}. {self.fix}."


def counted(number: int, word: str = "row") -> str:
    """Number with its noun: 1 row, 2 rows."""
    return f"{number} {word}{'' if number == 1 else 's'}"


def times(ratio: float) -> str:
    """A ratio as people read it."""
    return f"{ratio:,.0f}" if ratio >= 100 else f"{ratio:.2g}"


def shown(lines: Sequence[int], most: int = 12) -> str:
    """Line numbers in words, the first dozen of them."""
    text = ", ".join(str(line) for line in lines[:most])
    return text + (f" and {len(lines) - most} more" if len(lines) > most else "")

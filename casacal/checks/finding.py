"""One thing the doctor noticed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from casacal.wording import numbered_lines

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
        where = f" ({numbered_lines(self.lines)})" if self.lines else ""
        of = f"{self.instrument}: " if self.instrument else ""
        return f"{self.severity}: {of}{self.about}{where}: {self.cause}. {self.fix}."

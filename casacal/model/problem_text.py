"""The Python of a new problem file: numbers, tables, names, and what is to be filled in."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from casacal.errors import CasacalError
from casacal.model.dh_table import degrees, plain
from casacal.model.instrument import Travel, readings_within
from casacal.model.joints import Conventions, Joint

FINEST = 0.01  # mm; an accuracy below it was given in metres
FILL_IN = "TO FILL IN"  # mark of a line that nobody has checked yet


@dataclass(frozen=True, kw_only=True)
class Answers:
    """A user's answers about a new cell; None for what was not said.

    tool: the tip at reading zero in the flange frame, mm. sign: +1 where a larger reading lengthens the tool, -1 where
    it shortens it. accuracy: absolute accuracy of the arm as its maker states it, mm.

    Raises CasacalError for what cannot be.
    """

    tool: tuple[float, float, float] | None = None
    sign: int | None = None
    travel: Travel | None = None
    accuracy: float | None = None

    def __post_init__(self) -> None:
        if self.tool is not None and (len(self.tool) != 3 or not all(map(math.isfinite, self.tool))):
            raise CasacalError(f"The tool is {self.tool!r}", "Give three numbers of mm, such as 0,0,120")
        if self.sign not in (None, 1, -1):
            raise CasacalError(f"The dial's sign is {self.sign!r}", "Give 1 or -1")
        low, high = readings_within(10.0 if self.travel is None else self.travel)
        if not -math.inf < low < high < math.inf or plain(low) == plain(high):
            raise CasacalError(f"The dial's travel is {self.travel!r}", "Give its range in mm, such as 10 or -5:5")
        if self.accuracy is not None and not FINEST <= self.accuracy < math.inf:
            raise CasacalError(f"The maker's accuracy is {self.accuracy:g} mm", f"Give mm, {FINEST} or more")

    @property
    def names(self) -> list[str]:
        """Names that problem.py imports for it."""
        scaled = [] if self.accuracy is None else ["scaled_to_accuracy"]
        return ["DialOnPlane", "dial_gain", "tool_point", *scaled]

    @property
    def context(self) -> dict[str, object]:
        """Context of templates/problem.py.txt for tool, dial and maker."""
        travel = 10.0 if self.travel is None else self.travel
        return {
            "todo": {name: "" if value is not None else f" {FILL_IN}." for name, value in vars(self).items()},
            "tool": ", ".join(map(plain, self.tool or (0.0, 0.0, 0.0))),
            "sign": "+1" if self.sign == 1 else "-1",
            "travel": f"({', '.join(map(plain, travel))})" if isinstance(travel, tuple) else plain(travel),
            "accuracy": None if self.accuracy is None else plain(self.accuracy),
        }

    @property
    def missing(self) -> list[str]:
        """Values still to fill in, and assumptions made."""
        assumed = {
            "tool": "the tool: the tip is assumed at the flange's origin, pointing along its z axis",
            "sign": "the dial's sign: -1 is assumed, a plunger that is pushed in reads more",
            "travel": "the dial's travel: 0 to 10 mm is assumed",
            "accuracy": "the maker's accuracy: errors of 0.7 mm and 1 mrad are assumed for every parameter",
        }
        return [words for name, words in assumed.items() if getattr(self, name) is None]


WIDTH = 120  # longest line of a problem file


def conventions(said: Conventions, joints: Sequence[Joint]) -> str:
    """The `Conventions(...)` of a table."""
    parts = [f"signs={tuple_of(map(str, said.signs))}"]
    if any(said.offsets):
        pairs = zip(said.offsets, joints, strict=True)
        each = (f"deg({degrees(offset)})" if joint.turns else plain(offset) for offset, joint in pairs)
        parts.append(f"offsets={angles(said.offsets) if all(j.turns for j in joints) else tuple_of(each, 8)}")
    if said.coupling:
        parts.append(f"coupling={tuple_of(f'({i}, {j}, {plain(factor)})' for i, j, factor in said.coupling)}")
    return listed("Conventions(", parts, ")", 4, taken=len("conventions="))


def conventions_line(said: Conventions, joints: Sequence[Joint]) -> str:
    """The argument of a robot that says them, on one line."""
    return f"conventions={' '.join(conventions(said, joints).split())}"


def angles(values: Sequence[float]) -> str:
    """Angles in rad as deg(...); a tuple also where there is one alone."""
    if len(values) == 1:
        return f"(deg({degrees(values[0])}),)"
    return listed("deg(", [degrees(value) for value in values], ")", 4, taken=8)


def tuple_of(items: Iterable[str], indent: int = 4) -> str:
    """Items as a tuple, also where there is one alone."""
    found = list(items)
    return f"({found[0]},)" if len(found) == 1 else listed("(", found, ")", indent, taken=8)


def listed(opening: str, items: list[str], closing: str, indent: int, *, taken: int = 0, wide: bool = False) -> str:
    """Items on one line where they fit behind `taken` characters, else one per line."""
    line = opening + ", ".join(items) + closing
    if not wide and indent + taken + len(line) + 1 <= WIDTH:
        return line
    inner = "".join(f"{' ' * (indent + 4)}{item},\n" for item in items)
    return f"{opening}\n{inner}{' ' * indent}{closing}"


def quoted(text: str) -> str:
    """A Python string, between double quotes unless it holds one."""
    return repr(text) if '"' in text else json.dumps(text, ensure_ascii=False)


def word(text: str) -> str:
    """A name for a sentence: one line, without what would end a docstring, not too long."""
    return " ".join(re.sub(r'["\\]', "", text).split())[:40] or "an arm"


def imported(names: Iterable[str]) -> str:
    """Names in the order of isort: classes before functions."""
    return ", ".join(sorted(names, key=lambda name: (name.islower(), name)))

"""Numbers, tables and names as the Python of a problem file, on lines that are not too long."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence

from casacal.robots.conventions import Conventions
from casacal.robots.files.decimals import degrees, plain
from casacal.robots.joints import Joint

WIDTH = 120
"""Longest line of a problem file."""


def conventions(said: Conventions, joints: Sequence[Joint]) -> str:
    """The `Conventions(...)` of a table."""
    turns = [joint.turns for joint in joints]
    if all(turns):
        offsets = angles(said.offsets)
    else:
        shown = (f"deg({degrees(o)})" if turn else plain(o) for o, turn in zip(said.offsets, turns, strict=True))
        offsets = tuple_of(shown, 8)
    parts = [f"signs={tuple_of(map(str, said.signs))}", f"offsets={offsets}"]
    if said.coupling:
        parts.append(f"coupling={tuple_of(f'({i}, {j}, {plain(factor)})' for i, j, factor in said.coupling)}")
    return listed("Conventions(", parts, ")", 4, taken=len("conventions="))


def angles(values: Sequence[float]) -> str:
    """Angles in rad as deg(...); a tuple also where there is one alone."""
    if len(values) == 1:
        return f"(deg({degrees(values[0])}),)"
    return listed("deg(", [degrees(value) for value in values], ")", 4, taken=8)


def lengths(values: Sequence[float]) -> str:
    """Lengths as a tuple."""
    return tuple_of(plain(value) for value in values)


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

"""What an operator types at a session: a touch, or a word about the one before."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.errors import CasacalError, counted
from casacal.measuring.gauges import Gauge
from casacal.measuring.touch import Touch
from casacal.samples.layout import Layout
from casacal.samples.write import WRITTEN

UNDO, KEEP, CORRECT, SKIP, QUIT, HELP = "undo", "keep", "correct", "skip", "quit", "help"
WORDS = {"u": UNDO, "k": KEEP, "c": CORRECT, "s": SKIP, "q": QUIT, "h": HELP, "?": HELP}
"""Letters for words; the words themselves are understood as well."""

NUMBER = re.compile(r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class Command:
    """A word, and the number after it, if any."""

    word: str
    number: int | None = None


@dataclass(frozen=True, eq=False)
class Typed:
    """A touch as it was typed: joints (n,; rad, mm), readings in the order of the columns, labels in theirs."""

    joints: Array
    readings: tuple[float, ...]
    labels: tuple[str, ...]


def command_of(line: str) -> Command | None:
    """The command that a line is; None where it is none."""
    word, _, rest = line.strip().partition(" ")
    known = WORDS.get(word.lower(), word.lower())
    if known not in WORDS.values():
        return None
    if rest.strip() and not rest.strip().isdecimal():
        raise CasacalError(f"'{rest.strip()}' after '{word}' is no number", "Give one, or nothing")
    return Command(known, int(rest) if rest.strip() else None)


def touch_of(line: str, layout: Layout, planned: Touch | None, gauge: Gauge) -> Typed:
    """The touch that a line says: readings alone where joints are as planned, or joints and readings, then labels.

    Angles in degrees, lengths in mm; numbers are apart by blanks or semicolons, or by commas where they have points.
    A line with a single number is read as the gauge would write it, so that a unit may follow. Raises CasacalError for
    lines that are neither.
    """
    gauge.refuse_error(line)
    joints, readings = len(layout.joints), len(layout.columns)
    if readings == 1 and planned is not None and (alone := _alone(line, gauge)) is not None:
        return Typed(planned.joints, (alone,), _labels((), layout, planned))
    cells = _cells(line)
    numbers = [float(cell.replace(",", ".")) for cell in cells if NUMBER.fullmatch(cell)]
    count = next((k for k, cell in enumerate(cells) if not NUMBER.fullmatch(cell)), len(cells))
    labels = tuple(cells[count:])
    if count == readings and planned is not None:
        return Typed(planned.joints, tuple(numbers[:count]), _labels(labels, layout, planned))
    if count == joints + readings:
        factors = [1 / WRITTEN[kind][1] for kind in layout.joints]
        q = np.array(numbers[:joints]) * factors
        return Typed(q, tuple(numbers[joints:count]), _labels(labels, layout, planned))
    wanted = counted(readings, "reading") if readings else ""
    instead = f"{wanted}, or " if planned is not None and readings else ""
    fix = f"Type {instead}{joints} joint values{f' and {wanted}' if wanted else ''}; h for help"
    raise CasacalError(f"{counted(count, 'number')} came", fix)


def _alone(line: str, gauge: Gauge) -> float | None:
    try:
        return gauge.reading(line)
    except CasacalError:
        if gauge.name != "plain" and NUMBER.fullmatch(line.strip()):
            return float(line.strip().replace(",", "."))
        return None


def _cells(line: str) -> list[str]:
    """Cells of a line; commas part them where numbers have points, else they are decimal commas."""
    apart = r"[\s;,]+" if re.search(r"\d\.\d", line) or not re.search(r"\d,\d", line) else r"[\s;]+|,\s+"
    return [cell for cell in re.split(apart, line.strip()) if cell]


def _labels(typed: Sequence[str], layout: Layout, planned: Touch | None) -> tuple[str, ...]:
    if typed:
        if len(typed) != len(layout.labels):
            raise CasacalError(f"'{' '.join(typed)}' came behind the numbers", "Type h for help")
        return tuple(typed)
    if planned is None and layout.labels:
        raise CasacalError(f"A touch without its {layout.labels[0]} came", "Type it behind the numbers")
    return () if planned is None else tuple(planned.labels[name] for name in layout.labels)

"""What an operator types at a session: commands, and touches with their readings in the units that are shown."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from casacal.array_types import Array
from casacal.errors import CasacalError
from casacal.instruments.description import Dimension
from casacal.measuring.gauges import Gauge
from casacal.measuring.touch import Touch
from casacal.problem.problem import Problem
from casacal.samples.samples import WRITTEN, Layout
from casacal.wording import counted, sentence

UNDO, KEEP, CORRECT, SKIP, QUIT, HELP = "undo", "keep", "correct", "skip", "quit", "help"
WORDS = {"u": UNDO, "k": KEEP, "c": CORRECT, "s": SKIP, "q": QUIT, "h": HELP, "?": HELP}
"""Letters for words; the words themselves are understood as well."""

COMMANDS = (
    "u: take the last touch back, or the one in doubt (u 7: touch 7). k: it is right. c: put it right as the first "
    "explanation has it (c 2: the second). s: leave this touch out. q: end; what was measured is written already."
)

NUMBER = re.compile(r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?")


class Command(NamedTuple):
    """A word, and the number after it, if any."""

    word: str
    number: int | None = None


class Typed(NamedTuple):
    """A touch as it was typed: joints (n,; rad, mm), readings in the order of the columns, labels in theirs."""

    joints: Array
    readings: tuple[float, ...]
    labels: tuple[str, ...]


def help_words(problem: Problem) -> str:
    """What may be typed at a session of a problem with one instrument, and what to see to before."""
    layout, words = problem.layout(), problem.instrument.words
    read = ", ".join(f"{name}{in_unit(kind)}" for name, kind in layout.columns.items())
    reading = "reading" if len(layout.columns) == 1 else "readings"
    said = ["Bring the arm to the posture.", *([sentence(words.approach)] if words.approach else [])]
    said.append(
        "If the controller shows the joint values as planned, "
        f"{f'type the {reading} alone ({read})' if read else 'press Enter'}; otherwise type all joint values "
        f"(degrees, mm){f' and the {reading}' if read else ''}."
    )
    if layout.labels:
        said.append(f"Add the label if it was another {words.group}.")
    return " ".join([*said, COMMANDS])


def in_unit(kind: Dimension) -> str:
    """In which unit a quantity is typed and shown: " in degrees", " in mm"; nothing for a number."""
    return {"angle": " in degrees", "length": " in mm"}.get(kind, "")


def command_of(line: str) -> Command | None:
    """The command that a line is; None where it is none."""
    word, _, rest = (part.strip() for part in line.strip().partition(" "))
    known = WORDS.get(word.lower(), word.lower())
    if known not in WORDS.values():
        return None
    if rest and not rest.isdecimal():
        raise CasacalError(f"'{rest}' after '{word}' is no number", "Give one, or nothing")
    return Command(known, int(rest) if rest else None)


def touch_of(line: str, layout: Layout, planned: Touch | None, gauge: Gauge) -> Typed:
    """The touch that a line says: readings alone where joints are as planned, or joints and readings, then labels.

    Angles are typed in degrees, lengths in mm; numbers are apart by blanks or semicolons, or by commas where they have
    points. A line with a single number is read as the gauge would write it, so that a unit may follow. Raises
    CasacalError for lines that are neither.
    """
    gauge.refuse_error(line)
    joints, readings = len(layout.joints), len(layout.columns)
    kinds = list(layout.columns.values())
    if readings == 1 and planned is not None and (alone := _alone(line, gauge, kinds[0])) is not None:
        return Typed(planned.joints, (alone,), _labels((), layout, planned))
    # commas part cells where numbers have points, else they are decimal commas
    apart = r"[\s;,]+" if re.search(r"\d\.\d", line) or not re.search(r"\d,\d", line) else r"[\s;]+|,\s+"
    cells = [cell for cell in re.split(apart, line.strip()) if cell]
    count = next((k for k, cell in enumerate(cells) if not NUMBER.fullmatch(cell)), len(cells))
    numbers, labels = [_number(cell) for cell in cells[:count]], tuple(cells[count:])
    if count in (readings if planned is not None else -1, joints + readings):
        read = tuple(value / WRITTEN[kind][1] for value, kind in zip(numbers[count - readings :], kinds, strict=True))
        if count == readings and planned is not None:
            return Typed(planned.joints, read, _labels(labels, layout, planned))
        q = np.array(numbers[:joints]) / [WRITTEN[kind][1] for kind in layout.joints]
        return Typed(q, read, _labels(labels, layout, planned))
    wanted = counted(readings, "reading") if readings else ""
    instead = f"{wanted}, or " if planned is not None and readings else ""
    fix = f"Type {instead}{joints} joint values{f' and {wanted}' if wanted else ''}; h for help"
    raise CasacalError(f"{counted(count, 'number')} came", fix)


def read_by(gauge: Gauge, line: str, layout: Layout, planned: Touch | None) -> Typed:
    """The planned touch with what a gauge's line reads; raises CasacalError for a line that is anything else."""
    kinds = list(layout.columns.values())
    if planned is None:
        raise CasacalError("No touch is waited for", "Type the joint values and the reading")
    if len(kinds) == 1:
        return Typed(planned.joints, (gauge.reading(line, kinds[0]),), _labels((), layout, planned))
    cells = [cell for cell in re.split(r"[\s;,]+", gauge.refuse_error(line)) if cell]
    if len(cells) != len(kinds) or not all(NUMBER.fullmatch(cell) for cell in cells):
        raise CasacalError(f"The gauge sent {line.strip()!r}", f"A line of it is {counted(len(kinds), 'number')}")
    read = tuple(_number(cell) / WRITTEN[kind][1] for cell, kind in zip(cells, kinds, strict=True))
    return Typed(planned.joints, read, _labels((), layout, planned))


def _number(text: str) -> float:
    return float(text.strip().replace(",", "."))


def _alone(line: str, gauge: Gauge, kind: Dimension) -> float | None:
    if gauge.reads(line):
        return gauge.reading(line, kind)
    return _number(line) / WRITTEN[kind][1] if NUMBER.fullmatch(line.strip()) else None


def _labels(typed: tuple[str, ...], layout: Layout, planned: Touch | None) -> tuple[str, ...]:
    if typed and len(typed) != len(layout.labels):
        raise CasacalError(f"'{' '.join(typed)}' follows the numbers", "Type h for help")
    if not typed and planned is None and layout.labels:
        raise CasacalError(f"The touch has no {layout.labels[0]}", "Type it after the numbers")
    return typed if typed or planned is None else tuple(planned.labels[name] for name in layout.labels)

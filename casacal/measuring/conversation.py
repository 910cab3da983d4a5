"""What an operator types at a session, and the session's answer."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from casacal.array_types import Array
from casacal.errors import CasacalError
from casacal.measuring.examine import Suspected
from casacal.measuring.gauges import Gauge
from casacal.measuring.session import Session
from casacal.measuring.spoken import HELP_WORDS, doubt, told
from casacal.measuring.touch import Touch
from casacal.samples.layout import Layout
from casacal.samples.samples import WRITTEN
from casacal.wording import counted

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
            raise CasacalError(f"'{' '.join(typed)}' follows the numbers", "Type h for help")
        return tuple(typed)
    if planned is None and layout.labels:
        raise CasacalError(f"The touch has no {layout.labels[0]}", "Type it after the numbers")
    return () if planned is None else tuple(planned.labels[name] for name in layout.labels)


Change = Literal["none", "added", "changed"]


@dataclass(frozen=True)
class Answer:
    """The session after a line, sentences, whether touches were added or changed, whether that was the end."""

    session: Session
    said: tuple[str, ...]
    change: Change = "none"
    ended: bool = False


def answered(session: Session, proposed: Touch | None, line: str, gauge: Gauge) -> Answer:
    """Answer a line; what cannot be understood or done is said, and changes nothing."""
    try:
        command = command_of(line)
        if command is not None:
            return _obeyed(session, proposed, command)
        if session.alarm is not None:
            return Answer(session, ("Answer first, by u, c or k", *doubt(session)))
        layout = session.problem.layout()
        typed = touch_of(line, layout, proposed, gauge)
        after = session.take(
            typed.joints,
            dict(zip(layout.columns, typed.readings, strict=True)),
            dict(zip(layout.labels, typed.labels, strict=True)),
            number=None if proposed is None else proposed.number,
        )
    except CasacalError as error:
        return Answer(session, (str(error),))
    return Answer(after, (told(after), *doubt(after)), "added")


def _obeyed(session: Session, proposed: Touch | None, command: Command) -> Answer:
    if command.word == HELP:
        return Answer(session, (HELP_WORDS,))
    if command.word == QUIT:
        return Answer(session, (), ended=True)
    if command.word == SKIP:
        if session.alarm is not None:
            return Answer(session, (*doubt(session),))
        if proposed is None or proposed.number is None:
            raise CasacalError("The plan has no touch left to skip", "Type q to end")
        return Answer(session.skip(proposed.number), (f"touch {proposed.number} is left out",))
    if command.word == KEEP:
        after = session.keep()
    elif command.word == CORRECT:
        after = session.correct(_suspect(session, command.number))
    else:
        assert command.word == UNDO
        after = session.undo(None if command.number is None else _place(session, command.number))
    stands = (told(after),) if len(after) and after.alarm is None else ()
    done = {KEEP: "kept", CORRECT: "put right", UNDO: "taken back"}[command.word]
    return Answer(after, (done, *stands, *doubt(after)), "changed")


def _place(session: Session, number: int) -> int:
    """Where a touch stands by the number that people know it by; raises CasacalError where there is none."""
    there = {session.shown(k): k for k in range(len(session))}
    if number not in there:
        last = f"the last one is {session.shown(len(session) - 1)}" if there else "there is none yet"
        raise CasacalError(f"No touch {number} has been made", f"Give the number of one that was; {last}")
    return there[number]


def _suspect(session: Session, number: int | None) -> Suspected | None:
    if number is None or session.alarm is None:
        return None
    if not 1 <= number <= len(session.alarm.suspects):
        raise CasacalError(f"There is no explanation {number}", f"Give 1 to {len(session.alarm.suspects)}")
    return session.alarm.suspects[number - 1]

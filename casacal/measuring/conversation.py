"""One answer of a session to what its operator types: another session, what to say, what to do with the file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from casacal.errors import CasacalError
from casacal.measuring.examine import Suspected
from casacal.measuring.gauges import Gauge
from casacal.measuring.session import Session
from casacal.measuring.spoken import HELP_WORDS, doubt, told
from casacal.measuring.touch import Touch
from casacal.measuring.typed import CORRECT, HELP, KEEP, QUIT, SKIP, UNDO, Command, command_of, touch_of

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
            raise CasacalError("There is no touch of the plan to leave out", "Type q to end")
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

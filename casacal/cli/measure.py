"""`casacal measure`: a session at the machine, each touch judged when it is made."""

from __future__ import annotations

import argparse
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import TYPE_CHECKING, Any

from casacal.cli import cell, common
from casacal.cli.common import DONE, FAILED, PROBLEM, add, whole_number
from casacal.cli.terminal import prompt, say_paragraphs
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.model.problem_file import ProblemFile
    from casacal.shopfloor.gauges import Entry, Gauge, SerialLine
    from casacal.shopfloor.recording import Recording
    from casacal.shopfloor.session import Session
    from casacal.values import Array

HELP = "take touches at the machine, each judged at once"

EVERY = 10  # touches beyond the plan between two words about how many more it takes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal measure`."""
    parser.description = (
        "Go through the touches of a plan, take each reading from the keyboard or a gauge, and save it at once. A "
        "touch that does not agree with the others is named, with the likely causes. An interrupted session continues "
        "where it stopped. Exit 1 if a tolerance was asked for and is not met, or if a touch is left in doubt."
    )
    add(parser, *PROBLEM)
    add(parser, "--instrument NAME", "which one takes the readings, where a problem has several instruments")
    add(parser, "--plan FILE", "what casacal plan wrote", required=True)
    add(parser, "--out FILE", "samples to write; those kept to verify go to FILE_check", required=True)
    words = "label of these touches where the problem tells sessions apart; default: the operator is asked"
    add(parser, "--session NAME", words)
    add(parser, "--tolerance MM", "end when the tip error is below this with 95 %% probability", kind=float)
    cell.add_where(parser)
    add(parser, "--best-first", "choose the touch that lowers the tip error most, not the next on the planned way")
    cell.add_clearance(parser)
    add_gauge(parser)
    cell.add_joints(parser)


def add_gauge(parser: argparse.ArgumentParser) -> None:
    """Add the options of a gauge on a serial line."""
    add(parser, "--serial PORT", "where a gauge is connected, such as COM3 or /dev/ttyUSB0")
    add(parser, "--gauge NAME", "digimatic, sylvac or plain; default: plain", default="plain")
    add(parser, "--pattern REGEX", "what the gauge sends, with (?P<value>...) around the number")
    add(parser, "--unit UNIT", "of readings that say none: mm, in or um, of angles deg or rad; default: mm, deg")
    add(parser, "--ask TEXT", "text that makes the gauge send a reading, sent when you press Enter")
    add(parser, "--baud N", "of the line; default: 9600", kind=whole_number, default=9600)
    add(parser, "--frame 8N1", "bits, parity and stop bits; default: 8N1", default="8N1")


def run(options: argparse.Namespace) -> int:
    """Hold a session; returns 0, or 1 where a tolerance is not met."""
    from casacal.model.problem_file import load_problem
    from casacal.shopfloor.gauges import SerialLine, gauge

    source = common.of_instrument(load_problem(options.problem), options.instrument)
    common.spare([options.out], *(file.path for file in source.files), options.plan, options.targets, own=True)
    meter = gauge(options.gauge, pattern=options.pattern, unit=options.unit, asks=options.ask)
    stands = None if options.joints is None else cell.stands_of(options.joints, source.problem.robot)
    if options.table is not None:
        source = cell.in_cell(source, options)
    recording = _begun(source, options, meter, stands)
    if options.serial is None:
        _held(recording, None)
    else:
        with closing(SerialLine(options.serial, baud=options.baud, **frame_of(options.frame))) as line:
            _held(recording, line)
    session = recording.session
    return DONE if session.alarm is None and (session.tolerance is None or session.done) else FAILED


def _begun(
    source: ProblemFile, options: argparse.Namespace, meter: Gauge, stands: Callable[[], Array] | None
) -> Recording:
    from casacal.planning.route import read_route
    from casacal.shopfloor.recording import begun
    from casacal.shopfloor.session import Session

    layout, labels = source.problem.layout(), dict[str, str]()
    today = common.columns_of_today(source, options.session)
    planned = read_route(options.plan, layout).samples.labels
    for column in today:
        said = options.session
        if said is None:
            prompt(f"{column} (Enter: {planned[column][0]}): ")
            said = sys.stdin.readline().strip()
        labels[column] = said
    box, targets = cell.where(options, source)
    session = Session(
        source.problem,
        None,
        options.tolerance,
        box,
        targets,
        source.cell,
        cell.clearance_of(options),
        options.best_first,
    )
    recording, said = begun(
        source,
        options.plan,
        options.out,
        meter,
        table=cell.table_of(source, options),
        clearance=cell.clearance_of(options, source),
        session=session,
        labels=labels,
        stands=stands,
    )
    say_paragraphs(*said)
    return recording


def _held(recording: Recording, line: SerialLine | None) -> None:
    """Take entries until there is nothing left to touch, or the operator ends."""
    from casacal.shopfloor.conversation import doubt, ended, posture, waiting

    say_paragraphs(*doubt(recording.session), "h: help; q: end")
    entered = _entries(line, recording.gauge, reads=bool(recording.file.layout.columns))
    while True:
        session = recording.session
        proposed = recording.proposed
        if session.alarm is None and recording.doubled is None:
            if proposed is None:
                break
            if proposed.number is None and not _further(session):
                break
            if recording.warning is not None:
                say_paragraphs(f"warning: {recording.warning}")
            say_paragraphs(posture(session, proposed))
        if recording.doubled is None:
            say_paragraphs(waiting(session, proposed, recording.gauge, by_gauge=line is not None))
        entry = next(entered, None)
        if entry is None:
            break
        answer = recording.enter(entry.text, sent=entry.source == "sent")
        say_paragraphs(*answer.said)
        if answer.ended:
            break
    say_paragraphs(*ended(recording.session))


def _further(session: Session) -> bool:
    """Say how many touches beyond the plan it takes, now and then; whether there is any sense in more."""
    from casacal.shopfloor.known import MOST

    beyond = sum(touch.number is None for touch in session.touches)
    if beyond % EVERY:
        return True
    needed = session.needed()
    said = f"The plan is finished; about {needed} more touches to reach {session.tolerance:g} mm"
    if needed is None:
        said = f"The plan is finished, and {MOST} more touches would not bring the tip error below "
        said += f"{session.tolerance:g} mm. It takes another face, a step of known height or a better instrument"
    say_paragraphs(said)
    return needed is not None


def _entries(line: SerialLine | None, meter: Gauge, *, reads: bool) -> Iterator[Entry]:
    """Entries of keyboard and gauge, each after its own prompt; `reads`: Enter alone asks the gauge for a reading."""
    from casacal.shopfloor.gauges import Entry, Inbox

    if line is None:
        prompt("> ")
        for typed in sys.stdin:
            yield Entry(typed)
            prompt("> ")
        return
    inbox = Inbox()

    def of_keyboard() -> None:
        held = b""  # read without a buffer of Python's, whose lock would outlive this thread
        while data := os.read(sys.stdin.fileno(), 1024):
            *whole, held = (held + data).split(b"\n")
            for typed in whole:
                inbox.type(typed.decode(errors="replace"))
        inbox.type(None)

    for source in (of_keyboard, lambda: line.listen(inbox)):
        threading.Thread(target=source, daemon=True).start()
    inbox.prompted()  # before the prompt is seen: what answers it counts however soon it comes
    prompt("> ")
    while (entry := inbox.next()) is not None:
        if reads and entry.source == "typed" and not entry.text.strip():
            inbox.take_next()
            if meter.asks:
                line.ask(meter.asks, inbox)
            continue
        if entry.source != "typed":
            say_paragraphs(entry.text)
        if entry.source != "note":
            yield entry
            inbox.prompted()
        prompt("> ")


def frame_of(text: str) -> dict[str, Any]:
    """Bits, parity and stop bits of a serial line from 8N1 and the like; raises CasacalError."""
    if len(text) != 3 or text[0] not in "78" or text[1].upper() not in "NEO" or text[2] not in "12":
        raise CasacalError(
            f"--frame {text} is not such as 8N1", "Write bits (7, 8), parity (N, E, O), stop bits (1, 2)"
        )
    return {"bits": int(text[0]), "parity": text[1].upper(), "stops": int(text[2])}

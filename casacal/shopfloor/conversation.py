"""Commands and touches as an operator types them at a session, and the session's answers in sentences."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from casacal.data.samples import WRITTEN, Layout
from casacal.errors import CasacalError
from casacal.model.instrument import OVERTRAVEL, readings_within
from casacal.model.problem import Problem
from casacal.planning.route import CHECK, joints_shown
from casacal.shopfloor.gauges import GAUGES, UNITS, Gauge
from casacal.shopfloor.known import per_reading
from casacal.shopfloor.session import DEVIATIONS, Session
from casacal.shopfloor.touch import Touch, beyond_travel
from casacal.values import Array
from casacal.wording import counted, figures, sentence, times

UNDO, KEEP, CORRECT, SKIP, QUIT, HELP = "undo", "keep", "correct", "skip", "quit", "help"
WORDS = {"u": UNDO, "k": KEEP, "c": CORRECT, "s": SKIP, "q": QUIT, "h": HELP, "?": HELP}
"""Letters for words; the words themselves are understood as well."""

COMMANDS = (
    "u: undo the last touch, or the one in doubt (u 7: touch 7). k: keep it as it is. c: accept suggestion 1 (c 2: "
    "suggestion 2). s: skip this touch (s 7: touch 7, or ask for it again). q: end; what was measured is already on "
    "disk."
)

NUMBER = re.compile(r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?")
ALIKE = 1e-9  # mm or rad by which equal readings differ
SAME_POSTURE = 1e-5  # rad or mm by which joint values differ that are of one touch of the plan
UNLIKELY = 0.01  # chance of touches kept to verify below which they do not agree with the others


class Typed(NamedTuple):
    """A touch as it was typed: joints (n,; rad, mm), readings and labels by column."""

    joints: Array
    readings: dict[str, float]
    labels: dict[str, str]


def help_words(problem: Problem, gauge: Gauge | None = None) -> str:
    """Entries that a session of a problem with one instrument accepts, and what to see to before."""
    layout, words = problem.layout(), problem.instrument.words
    read, reading = in_units(layout, gauge), "reading" if len(layout.columns) == 1 else "readings"
    said = ["Bring the arm to the posture.", *([sentence(words.approach)] if words.approach else [])]
    said.append(
        "If the controller shows these joint values, "
        f"{f'type the {reading} alone ({read})' if read else 'press Enter'}; otherwise type all joint values "
        f"(degrees, mm){f' and the {reading}' if read else ''}."
    )
    if layout.labels:
        said.append(f"Add the label if it was another {words.group}.")
    return " ".join([*said, COMMANDS])


def in_units(layout: Layout, gauge: Gauge | None = None) -> str:
    """Readings and the units in which they are typed, those of a gauge: "reading in mm"; a number has no unit."""
    units = {name: (gauge or GAUGES["plain"]).unit_of(kind) for name, kind in layout.columns.items()}
    words = {"deg": "degrees", "in": "inches", '"': "inches", "inch": "inches"}
    return ", ".join(f"{name} in {words.get(unit, unit)}" if unit else name for name, unit in units.items())


def command_of(line: str) -> tuple[str, int | None] | None:
    """The word of a command and the number after it, if any; None for a line that is no command."""
    word, _, rest = (part.strip() for part in line.strip().partition(" "))
    known = WORDS.get(word.lower(), word.lower())
    if known not in WORDS.values():
        return None
    if rest and not rest.isdecimal():
        raise CasacalError(f"'{rest}' after '{word}' is no number", "Give one, or nothing")
    return known, int(rest) if rest else None


def touch_of(line: str, layout: Layout, planned: Touch | None, gauge: Gauge) -> Typed:
    """Parse a typed touch: readings alone where joints are as planned, or joints and readings, then labels.

    Joint values are typed in degrees and mm, readings in the gauge's unit; numbers are apart by blanks or semicolons,
    or by commas where they have points. A single number is read as the gauge would write it. Raises CasacalError for
    lines that are neither.
    """
    gauge.refuse_error(line)
    joints, readings = len(layout.joints), len(layout.columns)
    if planned is not None and readings == 1 and gauge.reads(line):
        return read_by(gauge, line, layout, planned)
    cells = cells_of(line)
    count = next((k for k, cell in enumerate(cells) if not NUMBER.fullmatch(cell)), len(cells))
    as_planned = planned is not None and count == readings
    if not as_planned and count != joints + readings:
        wanted = counted(readings, "reading") if readings else ""
        instead = f"{wanted}, or " if planned is not None and readings else ""
        fix = f"Type {instead}{joints} joint values{f' and {wanted}' if wanted else ''}; h for help"
        raise CasacalError(f"{counted(count, 'number')} came", both_marks(line) + fix)
    labels = cells[count:]
    if labels and len(labels) != len(layout.labels):
        raise CasacalError(f"'{' '.join(labels)}' follows the numbers", "Type h for help")
    if not labels and planned is None and layout.labels:
        raise CasacalError(f"The touch has no {layout.labels[0]}", "Type it after the numbers")
    named = dict(zip(layout.labels, labels, strict=True)) if labels else _labels(planned, layout)
    read = _readings(cells[count - readings : count], layout, gauge)
    if planned is not None and as_planned:
        return Typed(planned.joints, read, named)
    pairs = zip(cells[:joints], layout.joints, strict=True)
    return Typed(np.array([_number(cell) / WRITTEN[kind][1] for cell, kind in pairs]), read, named)


def cells_of(line: str) -> list[str]:
    """Cells of a line; commas part them where numbers have points, else they are decimal commas."""
    apart = r"[\s;,]+" if re.search(r"\d\.\d", line) or not re.search(r"\d,\d", line) else r"[\s;]+|,\s+"
    return [cell for cell in re.split(apart, line.strip()) if cell]


def both_marks(line: str) -> str:
    """A sentence for a line with points and commas between digits, which may be of one number or two; else empty."""
    both = re.search(r"\d\.\d", line) and re.search(r"\d,\d", line)
    return "Write all decimals with points, or all with commas: here they are mixed. " if both else ""


def read_by(gauge: Gauge, line: str, layout: Layout, planned: Touch | None) -> Typed:
    """The planned touch with what a gauge's line reads; raises CasacalError for a line that is anything else."""
    if planned is None:
        raise CasacalError("No touch is waited for", "Type the joint values and the reading")
    if len(layout.columns) == 1:
        read = {name: gauge.reading(line, kind) for name, kind in layout.columns.items()}
    else:
        cells, count = [cell for cell in re.split(r"[\s;,]+", gauge.refuse_error(line)) if cell], len(layout.columns)
        if len(cells) != count or not all(NUMBER.fullmatch(cell) for cell in cells):
            raise CasacalError(f"The gauge sent {line.strip()!r}", f"A line of it is {counted(count, 'number')}")
        read = _readings(cells, layout, gauge)
    return Typed(planned.joints, read, _labels(planned, layout))


def _labels(planned: Touch | None, layout: Layout) -> dict[str, str]:
    return {} if planned is None else {name: planned.labels[name] for name in layout.labels}


def _readings(cells: Sequence[str], layout: Layout, gauge: Gauge) -> dict[str, float]:
    """Readings by column (mm, rad) from numbers as people type them, in the unit of the gauge."""
    pairs = zip(layout.columns.items(), cells, strict=True)
    return {name: _number(cell) * UNITS[kind][gauge.unit_of(kind)] for (name, kind), cell in pairs}


def _number(text: str) -> float:
    return float(text.replace(",", "."))


@dataclass(frozen=True)
class Answer:
    """The session after a line, sentences, whether touches were added or changed (or left out), whether it ends."""

    session: Session
    said: tuple[str, ...]
    change: Literal["none", "added", "changed"] = "none"
    ended: bool = False


def answered(session: Session, proposed: Touch | None, line: str, gauge: Gauge, *, sent: bool = False) -> Answer:
    """Answer a line, which can only be a reading where the gauge sent it; what cannot be done changes nothing."""
    try:
        command = None if sent else command_of(line)
        if command is not None:
            return _obeyed(session, proposed, gauge, *command)
        if session.alarm is not None:
            return Answer(session, ("Answer first, by u, c or k", *doubt(session)))
        layout = session.problem.layout()
        typed = read_by(gauge, line, layout, proposed) if sent else touch_of(line, layout, proposed, gauge)
        if (beyond := beyond_travel(session.problem, typed.readings)) is not None:
            fix = "Check sign, point and unit; if the dial does show this, declare its travel in the problem file"
            raise CasacalError(beyond, fix)
        if (another := _of_another(session, typed.joints, proposed)) is not None:
            fix = f"Go to the posture that is waited for, or skip until touch {another} is"
            raise CasacalError(f"These are the joint values of touch {another} of the plan", fix)
        after = session.take(*typed, number=None if proposed is None else proposed.number)
    except CasacalError as error:
        return Answer(session, (str(error),))
    return Answer(after, (_report(after), *doubt(after)), "added")


def _of_another(session: Session, joints: Array, proposed: Touch | None) -> int | None:
    """The touch of the plan whose joint values these are, where another one is waited for; None where none is."""
    if session.plan is None or proposed is None:
        return None
    planned = session.plan.samples.joints
    off = np.abs(planned - joints).max(axis=1)
    if proposed.number is not None:  # which may have been moved, and is made twice in some plans
        off[np.abs(planned - planned[proposed.number - 1]).max(axis=1) < SAME_POSTURE] = np.inf
    if np.abs(proposed.joints - joints).max() < SAME_POSTURE or off.min() >= SAME_POSTURE:
        return None
    return int(off.argmin()) + 1


def _obeyed(session: Session, proposed: Touch | None, gauge: Gauge, word: str, number: int | None) -> Answer:
    if word == HELP:
        return Answer(session, (help_words(session.problem, gauge),))
    if word == QUIT:
        return Answer(session, (), ended=True)
    if word == SKIP:
        if session.alarm is not None:
            return Answer(session, tuple(doubt(session)))
        if number is None and proposed is None:
            raise CasacalError("The plan has no touch left to skip", "Type q to end")
        skipped = number if number is not None or proposed is None else proposed.number
        if skipped is None:
            return Answer(session.skip(None), ("another touch is proposed",))
        if any(touch.number == skipped for touch in session.touches):
            raise CasacalError(f"Touch {skipped} has been made", f"u {skipped} takes it back")
        return Answer(after := session.skip(skipped), (_left_out(after, skipped),), "changed")
    if word == KEEP:
        done, after = "kept", session.keep()
    elif word == CORRECT:
        suspects = session.alarm.suspects if number is not None and session.alarm is not None else ()
        if suspects and not 1 <= (number or 0) <= len(suspects):
            raise CasacalError(f"There is no explanation {number}", f"Give 1 to {len(suspects)}")
        done, after = "put right", session.correct(suspects[(number or 0) - 1] if suspects else None)
    else:
        there = {session.shown(k): k for k in range(len(session))}
        if number is not None and number not in there:
            last = f"the last one is {session.shown(len(session) - 1)}" if there else "there is none yet"
            raise CasacalError(f"No touch {number} has been made", f"Give the number of one that was; {last}")
        done, after = "taken back", session.undo(None if number is None else there[number])
    stands = (_report(after),) if len(after) and after.alarm is None else ()
    return Answer(after, (done, *stands, *doubt(after)), "changed")


def _left_out(session: Session, number: int) -> str:
    """That a touch of the plan is left out, and what that costs; or that it is asked for again."""
    touch = session.planned(number)
    if number not in session.skipped or touch is None:
        return f"touch {number} is asked for again"
    said = f"touch {number} is left out (s {number} asks for it again)"
    if touch.purpose != CHECK or session.plan is None:
        return said
    planned = (session.planned(k) for k in range(1, len(session.plan) + 1) if k not in session.skipped)
    left = sum(each is not None and each.purpose == CHECK and each.labels == touch.labels for each in planned)
    where = f" on {', '.join(touch.labels.values())}" if touch.labels else ""
    return f"{said}; {counted(left, 'touch')}{where} to verify {'is' if left == 1 else 'are'} left"


def repeats_last(session: Session, line: str, gauge: Gauge) -> bool:
    """Whether a line of the gauge is the reading of the last touch again, as where its button was pressed twice."""
    columns = session.problem.layout().columns
    if len(columns) != 1 or not len(session) or session.alarm is not None:
        return False
    ((name, kind),) = columns.items()
    with suppress(CasacalError):
        return abs(gauge.reading(line, kind) - session.touches[-1].columns[name]) < ALIKE
    return False


def waiting(session: Session, proposed: Touch | None, gauge: Gauge | None = None, *, by_gauge: bool) -> str:
    """Sentence that states what the session is waiting for."""
    if session.alarm is not None:
        return f"Waiting for an answer about touch {session.shown(session.alarm.touch)}: u, c or k"
    read = in_units(session.problem.layout(), gauge)
    number = "one more touch" if proposed is None or proposed.number is None else f"touch {proposed.number}"
    how = f"{read}, {'from the gauge or typed' if by_gauge else 'typed'}" if read else "Enter when the tip touches"
    return f"Waiting for {number}: {how}"


def told(session: Session, touch: Touch) -> tuple[float, float] | None:
    """Reading that the session expects at a touch and its standard deviation, mm; None where it says too little.

    It says enough where the reading is known to half of the travel, or surely lies beyond it.
    """
    found, probe = session.expected(touch), session.problem.instrument.probe
    if found is None or probe is None:
        return None
    (reading, std), (low, high) = found, readings_within(probe.travel)
    spread = DEVIATIONS * std
    return found if spread <= (high - low) / 2 or reading - spread > high or reading + spread < low else None


def out_of_travel(session: Session, touch: Touch) -> str | None:
    """A clause on why not to drive to a touch: the dial would be crushed, or would not touch; None where it is well."""
    found, probe = told(session, touch), session.problem.instrument.probe
    if found is None or probe is None or probe.column is None:
        return None
    (reading, std), (low, high) = found, readings_within(probe.travel)
    spread, room = DEVIATIONS * std, OVERTRAVEL * (high - low)
    pressed, free = (low - reading, reading - high) if probe.sign > 0 else (reading - high, low - reading)
    if pressed + spread <= room and free <= room:
        return None
    crushed = pressed + spread > room
    what = "do not drive there" if crushed else "the tip would not touch there"
    way = "stand off first, then approach" if crushed else "go nearer"
    return (
        f"{what}: the dial would read {reading:.2f} mm, give or take {figures(spread, 2)} mm, beyond its travel of "
        f"{low:g} to {high:g} mm; {way} along the plunger until it reads about {touch.columns[probe.column]:.2f} mm, "
        "and enter the joint values of that place with the reading"
    )


def within_travel(session: Session, touch: Touch) -> Touch | None:
    """A touch moved along its plunger to where the dial reads it; None where it does as planned, or nobody knows."""
    found, probe = session.expected(touch), session.problem.instrument.probe
    if found is None or probe is None:
        return None
    low, high = readings_within(probe.travel)
    likely = low <= found[0] <= high and out_of_travel(session, touch) is None
    return None if likely else session.brought(touch)


def to_expect(session: Session, touch: Touch) -> str:
    """What to expect of a touch: by the touches so far where they tell, else as planned; and whether it was moved."""
    found, probe = told(session, touch), session.problem.instrument.probe
    moved = _beside_plan(session, touch)
    if found is not None and probe is not None:
        return f"{probe.column} about {found[0]:.2f} mm (standard deviation {figures(found[1], 2)} mm){moved}"
    planned = ", ".join(
        f"{name} about {touch.columns[name] * WRITTEN[kind][1]:.2f}{WRITTEN[kind][0].replace('_', ' ')}"
        for name, kind in session.problem.layout().columns.items()
    )
    what, vague = session.problem.instrument.words.group, session.expected(touch)
    if planned and not moved:
        planned = f"{planned} as planned"
    if probe is None or not planned or not session.problem.layout().labels:
        return planned
    known = f"where the {what} is, no touch has told yet"
    if vague is not None and any(each.labels == touch.labels for each in session.touches):
        known = f"touches tell to {figures(DEVIATIONS * vague[1], 2)} mm where the {what} is"
    return f"{planned}{moved}; {known}: approach slowly"


def _beside_plan(session: Session, touch: Touch) -> str:
    """A clause on how far a touch of the plan was moved, and why; empty where it was not."""
    probe = session.problem.instrument.probe
    planned = None if session.plan is None else session.planned(touch.number)
    found = None if planned is None else session.expected(planned)
    if planned is None or found is None or probe is None or np.array_equal(planned.joints, touch.joints):
        return ""
    column = probe.column or ""
    forward = (found[0] - touch.columns[column]) * probe.sign
    way, where = ("forward", "further away") if forward > 0 else ("back", "nearer")
    what = session.problem.instrument.words.group
    return f"; the arm is to stand {abs(forward):.1f} mm further {way} than planned, because the {what} is {where}"


def posture(session: Session, touch: Touch) -> str:
    """Where to go: face, joint values, what to expect."""
    layout = session.problem.layout()
    where = ", ".join(touch.labels[name] for name in layout.labels)
    number = "one more" if touch.number is None else f"touch {touch.number}"
    purpose = {"again": "once more", "check": "kept to verify"}.get(touch.purpose, "")
    parts = (
        f"{number} {where}".strip(),
        purpose,
        f"joints {' '.join(joints_shown(touch.joints, layout))}",
        to_expect(session, touch),
    )
    return "; ".join(part for part in parts if part)


def _report(session: Session) -> str:
    """Report of the last touch and of the state of the session."""
    state = session.state
    said = [f"touch {session.shown(len(session) - 1)} made, {len(session)} in all"]
    if state.off is not None and state.std is not None:
        off = float(state.off[0]) if len(state.off) == 1 else float(np.linalg.norm(state.off))
        off, std = _as_read(session, len(session) - 1, off, float(np.linalg.norm(state.std)))
        said.append(f"{figures(off)} mm from what was expected (standard deviation {figures(std)} mm)")
    elif len(session) - 1 in session.waiting:
        face = ", ".join(session.touches[-1].labels.values())
        said.append(f"face {face} is not yet known well enough to judge it")
    if session.tip_error is not None and session.tip_error_below is not None:
        said.append(f"tip error {figures(session.tip_error)} mm expected, below {figures(session.tip_error_below)}")
    if (distrust := too_many_corrected(session)) is not None:
        said.append(distrust)
    probe, last = session.problem.instrument.probe, session.touches[-1]
    if probe is not None and probe.column is not None and last.columns[probe.column] in readings_within(probe.travel):
        said.append("warning: the dial stands at the end of its travel, so the tip may be free, or the dial be crushed")
    if session.noise > 1:
        said.append(f"touches scatter {session.noise:.2g} times the stated noise; figures allow for it")
    return "; ".join(said)


def _as_read(session: Session, k: int, off: float, std: float) -> tuple[float, float]:
    """A residual of a touch and its standard deviation as a dial along its plunger reads them, where there is one."""
    known = session.state.known
    slope = None if known is None else per_reading(known, session.touches[k])
    return (off, std) if slope is None else (off / slope, std / abs(slope))


def too_many_corrected(session: Session) -> str | None:
    """A clause that more touches were corrected than anybody mistypes, and what to do; None where they were not."""
    if not session.distrusted:
        return None
    names = ", ".join(str(session.shown(k)) for k in session.corrected)
    return (
        f"warning: {len(session.corrected)} of {counted(len(session), 'touch')} were corrected ({names}), more than "
        "people mistype. A suggestion was accepted that was not true, or something is wrong that all touches share, "
        "such as a joint's sign, a face or the dial. No tip error is promised until these touches are made again"
    )


def doubt(session: Session) -> list[str]:
    """Doubts about touches and their explanations, a sentence each."""
    alarm = session.alarm
    if alarm is None:
        return []
    size = abs(alarm.off) / alarm.std if alarm.std > 0 else math.inf
    there, kept = alarm.raised_by == len(session) - 1, sum(touch.kept for touch in session.touches)
    off, _ = _as_read(session, alarm.raised_by, alarm.off, alarm.std)
    before = (
        f" {counted(kept, 'doubtful touch')} {'was' if kept == 1 else 'were'} kept before: where doubts go on, the arm "
        "may be further off its drawing than the problem file allows (prior_std; --accuracy of casacal new)."
    ) * (kept > 0)
    said = [
        f"warning: touch {session.shown(alarm.raised_by)} is off by {figures(off)} mm, {times(size)} times "
        f"what was to be expected.{' The arm still stands there: look at the dial again first.' * there}{before} What "
        "would explain it, the likeliest first:"
    ]
    for k, each in enumerate(alarm.suspects, 1):
        cause, chance = "no known cause explains it" if each.slip is None else each.slip.words, each.chance
        part = "over 99 %" if chance > 0.99 else f"{100 * chance:.0f} %" if chance >= 0.01 else "below 1 %"
        said.append(f"  {k}. touch {session.shown(each.touch)}: {cause} ({part})")
    fixable = "c corrects it as in 1; " if alarm.suspects and alarm.suspects[0].slip is not None else ""
    again = f"u takes touch {session.shown(alarm.touch)} back, so that it is made again"
    return [*said, f"{again}; {fixable}k keeps it as it is"]


def ended(session: Session) -> list[str]:
    """Closing words of a session."""
    said, below, met = [], session.tip_error_below, ""
    if session.tolerance is not None:
        met = f", {'within' if session.done else 'not within'} the tolerance of {session.tolerance:g} mm"
    if below is not None:
        said.append(
            f"{counted(len(session), 'touch')}: tip error {session.tip_error:.3g} mm expected, below {below:.3g} "
            f"mm{met}, apart from the pose of the base, if the priors and the form of the arm's model are right. "
            "casacal calibrate judges that"
        )
    if (distrust := too_many_corrected(session)) is not None:
        said.append(distrust)
    if few := session.too_few:
        have = f"{', '.join(few)} {'has' if len(few) == 1 else 'have'}"
        said.append(f"warning: {have} too few touches; casacal calibrate asks for more there, or leaves them out")
    if session.alarm is not None:
        name = session.shown(session.alarm.touch)
        said.append(f"warning: touch {name} is still in doubt; continue the session to settle it")
    if (checked := session.checked()) is not None:
        off, std = (float(np.sqrt((each**2).sum(axis=1).mean())) for each in checked)
        count = counted(len(checked[0]), "touch")
        said.append(f"{count} kept to verify: off by {figures(off)} mm RMS, {figures(std)} to be expected")
        if session.checked_chance() < UNLIKELY:
            said.append(
                "warning: so far off they do not agree with the others; before anything relies on them, casacal check "
                "looks for the cause in the samples"
            )
    return said

"""A session on disk: each entry is judged and written before the next is taken, at a terminal or on a page."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from casacal.data.columns import Labels
from casacal.data.samples import WRITTEN, Samples
from casacal.errors import CasacalError, SamplesError, SimulationError
from casacal.model.problem_file import ProblemFile
from casacal.planning.choice import wanted_joints
from casacal.planning.clearance import Clearance, hindered
from casacal.planning.route import Route, read_route, refuse_plan_of_another, renumbered
from casacal.shopfloor.conversation import (
    Answer,
    answered,
    command_of,
    out_of_travel,
    repeats_last,
    touch_of,
    within_travel,
)
from casacal.shopfloor.gauges import Gauge
from casacal.shopfloor.session import Session
from casacal.shopfloor.touch import Touch, TouchFile, rows_of
from casacal.values import Array
from casacal.wording import counted

NEAR = 0.05  # degrees or mm by which joint values may differ from the planned ones without a word


@dataclass
class Recording:
    """A session and the files of its touches, which one program at a time may change.

    gauge: how a reading is written. table: height (mm) that nothing goes below, and clearance: what postures keep clear
    of, for warnings. stands: gives the joint values (n,; rad, mm) that the controller shows; where it is there, a
    reading alone is of these, not of the planned ones.
    """

    session: Session
    file: TouchFile
    gauge: Gauge
    table: float = 0.0
    clearance: Clearance = field(default_factory=Clearance)
    stands: Callable[[], Array] | None = None
    doubled: str | None = None
    """The gauge's last line where it repeats the reading before, about which the operator is asked."""

    def __post_init__(self) -> None:
        self._stamps = self.file.stamps()
        self._proposed: tuple[Session, Touch | None] | None = None
        self._warning: str | None = None
        self._hit = {} if self.session.plan is None else self._hindered(self.session.plan.samples)

    @property
    def proposed(self) -> Touch | None:
        """The touch to make next; None where enough has been touched. Raises SimulationError as `Session.next`.

        One whose face stands where the dial would be crushed, or would not touch, is moved along its plunger.
        """
        if self._proposed is None or self._proposed[0] is not self.session:
            touch = self.session.next()
            beyond = None if touch is None else out_of_travel(self.session, touch)
            moved = None if touch is None else within_travel(self.session, touch)
            hit = None if touch is None else self._hit.get(touch.number or 0)
            if moved is not None and not self._hindered(rows_of([moved])):
                touch, beyond, hit = moved, None, None
            self._warning = beyond if hit is None else f"do not go to the next posture ({hit}); s skips it"
            self._proposed = self.session, touch
        return self._proposed[1]

    def _hindered(self, postures: Samples) -> dict[int, str]:
        """What of the drawn arm collides, by row from 1."""
        return hindered(self.session.problem, postures, self.table, self.clearance)

    @property
    def overtaken(self) -> bool:
        """Whether another program has written to the files."""
        return self.file.stamps() != self._stamps

    @property
    def warning(self) -> str | None:
        """A clause on why the arm must not go to the proposed posture; None where nothing speaks against it."""
        return None if self.proposed is None else self._warning

    def enter(self, line: str, *, sent: bool = False) -> Answer:
        """Judge a line, typed or sent by the gauge, and write what it changes.

        What cannot be done is said and changes nothing. Raises CasacalError where another program changed the files.
        """
        if self.doubled is not None and not sent and line.strip().lower() in ("y", "yes"):
            line, sent, self.doubled = self.doubled, True, None
        elif sent and repeats_last(self.session, line, self.gauge):
            self.doubled = line
            said = f"The gauge sent {line.strip()}, the reading of the last touch again. Was it read here? y takes it; "
            return Answer(self.session, (f"{said}otherwise send another",))
        self.doubled = None
        try:
            proposed = None if self.session.alarm is not None else self.proposed
        except SimulationError:  # nothing can be proposed; commands, and joint values with a reading, can be entered
            proposed = None
        if not line.strip() and (self.file.layout.columns or self.session.alarm is not None or proposed is None):
            return Answer(self.session, ())
        try:
            at, note = self._standing(proposed, line, sent=sent)
        except CasacalError as error:
            return Answer(self.session, (str(error),))
        answer = answered(self.session, at, line, self.gauge, sent=sent)
        if answer.change != "none" and self.overtaken:
            what = f"another program changed '{self.file.path}'"
            raise CasacalError(what, "End the other session, and go on with this command")
        if answer.change == "added":
            self.file.append(answer.session.touches[-1], len(answer.session), answer.session.skipped)
        elif answer.change == "changed":
            self.file.rewrite(answer.session.touches, answer.session.skipped)
        self.session, self._stamps = answer.session, self.file.stamps()
        return replace(answer, said=(*note, *answer.said)) if answer.change == "added" else answer

    def _standing(self, proposed: Touch | None, line: str, *, sent: bool) -> tuple[Touch | None, tuple[str, ...]]:
        """The proposed touch where the controller says that the arm stands, and words where that is elsewhere."""
        layout = self.file.layout
        if self.stands is None or proposed is None or (not sent and command_of(line) is not None):
            return proposed, ()
        if not sent and touch_of(line, layout, proposed, self.gauge).joints is not proposed.joints:
            return proposed, ()  # they were typed
        joints = self.stands()
        off = np.abs((joints - proposed.joints) * [WRITTEN[kind][1] for kind in layout.joints])
        worst = int(off.argmax())
        if off[worst] <= NEAR:
            return replace(proposed, joints=joints), ()
        unit = "mm" if layout.joints[worst] == "length" else "degrees"
        words = (
            f"taken where the controller shows the arm, up to {off[worst]:.2f} {unit} (joint {worst + 1}) off the plan"
        )
        return replace(proposed, joints=joints), (words,)


def begun(
    source: ProblemFile,
    plan: str | Path,
    out: str | Path,
    gauge: Gauge,
    *,
    table: float,
    clearance: Clearance,
    session: Session | None = None,
    labels: Mapping[str, str] | None = None,
    stands: Callable[[], Array] | None = None,
) -> tuple[Recording, list[str]]:
    """Begin a recording of a plan's touches, or go on with the one in a file, and sentences on what was found there.

    Args:
        source: the problem, with one instrument.
        plan: what `casacal plan` wrote.
        out: CSV of the touches; those kept to verify go to a file beside it.
        gauge: how readings are written.
        table: height that the plan was made for, mm.
        clearance: what postures of the plan are looked at against.
        session: one without touches of which tolerance, box, targets and order are taken.
        labels: of today, by column, such as that of the session, in place of the plan's.
        stands: joint values as the controller shows them.

    Raises CasacalError for a plan of another problem, and for files of another session.

    """
    layout = source.problem.layout()
    route = with_labels(read_route(plan, layout), labels or {})
    begin = Session(source.problem, cell=source.cell) if session is None else session
    begin = replace(begin, plan=route)
    if begin.known is not None:  # a box out of reach is said before anybody touches
        wanted_joints(begin.known.bound, begin.box, begin.targets)
    file = TouchFile(Path(out), layout, plan_mark(source, plan))
    file.refuse_others()
    refuse_plan_of_another(plan, source.name, table)
    touches, skipped, cut = file.read()
    said = ["The last line of the file was cut off; make that touch again"] if cut else []
    if renumbered(plan):
        what = (
            f"Rows of {Path(plan).name} were left out, moved or added: its touches are numbered as they stand there now"
        )
        said.append(f"{what}. A sheet or a program of the whole plan has other numbers")
    if unknown := [touch.number for touch in touches if (touch.number or 0) > len(route)]:
        what = f"touch {unknown[0]} is none of the plan, which has 1 to {len(route)}"
        raise SamplesError(Path(out).as_posix(), what, "Restore it, or write - where a touch is beyond the plan")
    if touches:
        begin = replace(begin.resumed(touches), skipped=frozenset(number for number in skipped if number <= len(route)))
        said.append(f"Going on after {counted(len(touches), 'touch')} of {Path(out).as_posix()}")
    return Recording(begin, file, gauge, table, clearance, stands), said


def plan_mark(source: ProblemFile, plan: str | Path) -> str:
    """First words of files of touches that were made by a plan, as it stands in its file."""
    content = hashlib.sha256(Path(plan).read_bytes()).hexdigest()[:12]
    return f"measured by casacal: {source.name}, plan {content}"


def with_labels(route: Route, labels: Mapping[str, str]) -> Route:
    """A plan with labels of today (by column, alike for all its touches), which no plan knows."""
    there = dict(route.samples.labels)
    there |= {column: Labels.alike(label, len(route)) for column, label in labels.items() if label}
    return replace(route, samples=replace(route.samples, labels=there))

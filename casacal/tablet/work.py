"""One arm's way through the gates, in one folder: what every window of the page sees, and the steps it may ask for.

The folder holds all that lasts: plan.csv and sheet.html, samples.csv and samples_check.csv as `casacal measure` writes
them, and fit/ as `casacal calibrate` does. What is held here besides can be made again from them.
"""

from __future__ import annotations

import base64
import hashlib
import logging
import math
import re
import secrets
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from casacal.data.samples import Samples
from casacal.deployment.arm import FRAMES, CalibratedArm
from casacal.deployment.result_file import read_result, same_code
from casacal.errors import CasacalError, RefusedResultError, refuse_unknown
from casacal.files import together, write_text
from casacal.model.joints import Conventions
from casacal.model.problem_file import CONVENTIONS, ProblemFile, SourceFile, keep_conventions
from casacal.planning.clearance import Clearance
from casacal.planning.route import joints_shown
from casacal.planning.scene import scene
from casacal.shopfloor.conversation import doubt
from casacal.shopfloor.gauges import Gauge, Inbox, SerialLine
from casacal.shopfloor.recording import Recording, begun, plan_mark
from casacal.shopfloor.session import Session
from casacal.shopfloor.touch import stamp
from casacal.tablet.asked import Frame, corrected, number_of, pendant_table, text_of, uploaded
from casacal.values import Array
from casacal.verification.verification import Verification
from casacal.wording import counted

OF_SET_UPS = re.compile(r"--(block|tilt|plate)\b")
OF_TERMINAL = re.compile(
    r"(?<![\w-])--[a-z]|\bcasacal (?:calibrate|changed|check|compensate|doctor|export|measure|plan|predict|verify)\b"
)
_LOG = logging.getLogger("casacal")
AGAIN = 0.05  # as `casacal plan`: parts of a plan that are repeated, and kept to verify
CHECK = 0.15
POOL = 3000
MOST_TOUCHES = 500


class OutdatedError(CasacalError):
    """A step that another window has overtaken."""


@dataclass(frozen=True)
class Workplace:
    """Everything that the page was started with, which does not change while it runs.

    source: the problem with one instrument. folder: where all is kept. plan: a plan from elsewhere, else the folder's
    own. gauge: how readings are written. table: height of what the arm stands on, mm. stands: joint values as the
    controller shows them. since: an earlier result of this arm. labels: of today's touches, by column.
    """

    source: ProblemFile
    folder: Path
    gauge: Gauge
    table: float
    clearance: Clearance
    tolerance: float | None = None
    plan: Path | None = None
    stands: Callable[[], Array] | None = None
    since: CalibratedArm | None = None
    labels: Mapping[str, str] = field(default_factory=dict)

    @property
    def plan_file(self) -> Path:
        """The plan, whether it is there yet or not."""
        return self.folder / "plan.csv" if self.plan is None else self.plan

    @property
    def samples(self) -> Path:
        """Touches to fit."""
        return self.folder / "samples.csv"

    @property
    def check(self) -> Path:
        """Touches kept to verify."""
        return self.folder / "samples_check.csv"

    @property
    def fit(self) -> Path:
        """Folder of the calibration."""
        return self.folder / "fit"


class Work:
    """The state of a workplace, changed by one step at a time; `version` counts the changes.

    Raises CasacalError where the files of the folder belong to another problem or plan.
    """

    def __init__(self, place: Workplace, *, line: SerialLine | None = None) -> None:
        self.place, self.source = place, place.source
        self.lock, self.version, self.run = threading.RLock(), 0, secrets.token_hex(4)
        self.job: str | None = None
        self.said: dict[str, tuple[str, ...]] = {}  # the last words of each gate
        self.failed: dict[str, bool] = {}  # whether these say what went wrong
        self.recording: Recording | None = None
        self.arm: CalibratedArm | None = None
        self.errors: list[tuple[int, float]] = []  # expected tip error by number of touches
        self._verified: tuple[Verification, Samples] | None = None  # and the touches that it is of
        self._fitted: Samples | None = None  # touches of the calibration that was made here
        self._scene: dict[str, Any] | None = None
        self.line, self._inbox = line, None if line is None else Inbox()
        self.trouble = ""  # what is wrong with the files of the session, in sentences
        self._count = 0  # touches that were seen in them
        if place.plan is not None or place.plan_file.is_file():
            self._begin()
        self._seen = self._stamps()
        try:
            self.arm = read_result(place.fit) if (place.fit / "result.json").is_file() else None
        except CasacalError as error:  # such as of a problem that was changed since: the page leads to another one
            self.said["decide"], self.failed["decide"] = (str(error),), True
        if self.arm is not None and not self.outdated:
            self._fitted = self._rows(place.samples)
        if line is not None and self._inbox is not None:
            threading.Thread(target=line.listen, args=(self._inbox,), daemon=True).start()
            threading.Thread(target=self._listen, daemon=True).start()

    @property
    def outdated(self) -> bool:
        """Whether touches are others than those that the calibration was made from."""
        with suppress(OSError):
            now = hashlib.sha256(self.place.samples.read_bytes()).hexdigest()
            other = self.arm is not None and self.arm.found.data.sha256 != now
            return other and (self._fitted is None or self._fitted != self._rows(self.place.samples))
        return False

    def _rows(self, path: Path) -> Samples | None:
        """Touches of a file without what is noted beside them, such as which were left out; None where it has none."""
        with suppress(CasacalError):
            return replace(self.source.problem.read(path), lines=(), extra={}, file="", sha256="")
        return None

    @property
    def verified(self) -> Verification | None:
        """The verification of the calibration, by the touches as they are; None where they are others since."""
        if self._verified is not None and self._verified[1] != self._rows(self.place.check):
            self._verified = None
            self.said.pop("verify", None)
        return None if self._verified is None else self._verified[0]

    @property
    def edited(self) -> str:
        """Path of a file of the problem that now says something else than when the page was started; else empty."""
        for kept in self.source.files:
            with suppress(OSError):
                now = SourceFile.read(kept.path)
                if now.sha256 != kept.sha256 and not same_code(Path(kept.path), now.text, kept.text):
                    return kept.path
        return ""

    @property
    def touched(self) -> bool:
        """Whether files of touches hold anything."""
        return any(found[1] for found in self._stamps()[1:] if found)

    def do(self, step: str, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Take a step that a window asks for, and what it answers beside the new state.

        asked: `version` of the state that the window shows, and what the step needs. Raises OutdatedError where that
        state is no more, CasacalError for what cannot be done; then nothing has changed.
        """
        steps: Mapping[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
            "enter": self._enter,
            "go_on": self._go_on,
            "ask": self._ask,
            "conventions": self._conventions,
            "plan": self._plan,
            "calibrate": self._calibrate,
            "verify": self._verify,
            "correct": self._correct,
        }
        refuse_unknown("step", [step], steps)
        self.look()
        with self.lock:
            if asked.get("version") != self.version:
                raise OutdatedError(
                    "Something changed meanwhile, in another window or at the gauge", "Look, and repeat"
                )
            if self.job is not None:
                raise CasacalError(f"Still at work: {self.job}", "Wait until it is done")
            if step in ("conventions", "plan", "calibrate") and (file := self.edited):
                what = f"{file} was changed after this page was started, which knows the problem as it was"
                raise CasacalError(what, "End casacal serve and start it again; touches and plan are kept")
            return steps[step](asked)

    def look(self) -> None:
        """Read anew what others, such as `casacal measure`, have done to the plan or the files of touches.

        What cannot be read is said in `trouble`, and is looked at again when it has changed once more.
        """
        with self.lock:
            now, before = self._stamps(), self.recording
            if self.job is not None or (now == self._seen and not (before is not None and before.overtaken)):
                return
            plan, samples = self.place.plan_file, self.place.samples
            self.recording, self.trouble, self._seen, self._scene = None, "", now, None
            try:
                if now[0]:
                    self._begin()
                elif self.touched or self._count:
                    what = f"'{plan}' is gone, and touches of it were made, in '{samples}'"
                    raise CasacalError(what, "Put both back; to plan anew, move the files of touches away")
                elif before is not None:
                    self.said["plan"] = (f"'{plan}' is gone. Plan again",)
            except CasacalError as error:
                changed = before is not None and now[0] and plan_mark(self.source, plan) != before.file.mark
                said = f"'{plan}' was changed after touches of it were made: put it back as it was. " if changed else ""
                self.recording, self.trouble = None, f"{said}{error}"
            except Exception as error:
                self.recording, self.trouble = None, unforeseen(error)
            if self.recording is not None:
                self._compare(before, self.recording)
            self.version += 1

    def _compare(self, before: Recording | None, now: Recording) -> None:
        """Say what has become of plan and touches that were seen before."""
        left = len(now.session)
        if left < self._count:
            files = f"'{now.file.path}' and '{now.file.check_path.name}'"
            self.trouble = (
                f"{counted(self._count, 'touch')} had been made, and {files} hold {left}: others took the rest out. If "
                "nobody meant that, put the files back before you go on."
            )
        if before is not None and before.file.mark != now.file.mark:
            self.said["plan"] = ("The plan was changed by another program: this is what it says now",)
        self._count = max(self._count, left)

    def _stamps(self) -> tuple[tuple[int, ...], ...]:
        """How plan and touches look from outside, by which changes are noticed."""
        samples = self.place.samples
        return tuple(map(stamp, (self.place.plan_file, samples, self.place.check)))

    def space(self) -> dict[str, Any]:
        """The cell and the planned postures in space, as `casacal.planning.scene` has them; {} before a plan."""
        with self.lock:
            if self._scene is None and self.recording is not None and self.recording.session.plan is not None:
                samples = self.recording.session.plan.samples
                self._scene = scene(self.recording.session.problem, self.source.cell, self.place.clearance, samples)
            return self._scene or {}

    def stands(self) -> dict[str, Any]:
        """Where the controller shows the arm: `joints` in degrees and mm, `off` the plan; or `error`, a sentence."""
        if self.place.stands is None:
            return {}
        try:
            joints = self.place.stands()
        except CasacalError as error:
            return {"error": str(error)}
        layout, found = self.source.problem.layout(), dict[str, Any]()
        found["joints"] = joints_shown(joints, layout)
        with self.lock:
            proposed = None if self.recording is None or self.recording.session.alarm else self.recording.proposed
        if proposed is not None:
            found["off"] = joints_shown(joints - proposed.joints, layout)
        return found

    def changed(self, gate: str, said: Sequence[str], *, failed: bool = False) -> None:
        """Count a change, with the words of the gate that it happened at."""
        with self.lock:
            self.said[gate], self.failed[gate] = tuple(said), failed
            self.version += 1

    def _begin(self) -> None:
        """Begin to measure, or go on."""
        place = self.place
        session = Session(
            self.source.problem, tolerance=place.tolerance, cell=self.source.cell, clearance=place.clearance
        )
        self.recording, said = begun(
            self.source,
            place.plan_file,
            place.samples,
            place.gauge,
            table=place.table,
            clearance=place.clearance,
            session=session,
            labels=place.labels,
            stands=place.stands,
        )
        self._scene, session = None, self.recording.session
        self._seen, self._count = self._stamps(), max(self._count, len(session))
        self.errors = []
        if session.tip_error is not None:
            for count in range(1, len(session)):
                before = session.resumed(session.touches[:count])
                if before.tip_error is not None:
                    self.errors.append((count, before.tip_error))
            self.errors.append((len(session), session.tip_error))
        self.said["measure"] = (*said, *doubt(session))

    def _enter(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        self._take(text_of(asked, "line", 500), sent=False)
        if self._inbox is not None:
            self._inbox.prompted()
        return {}

    def _go_on(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Go on beyond the plan, with the touches that tell most, until the tip error is below what is wanted."""
        recording, tolerance = self._recorded(), number_of(asked, "tolerance", 0, 1000)
        recording.session = replace(recording.session, tolerance=tolerance)
        self.changed("measure", ())
        return {}

    def _recorded(self) -> Recording:
        """The session; raises CasacalError where there is none."""
        if self.recording is None:
            what, _, fix = self.trouble.removesuffix(".").partition(". ")
            raise CasacalError(what or "There is no plan yet", fix or "Plan the touches first")
        return self.recording

    def _take(self, line: str, *, sent: bool) -> None:
        """Enter a line; what the session answers becomes what the gate says."""
        recording = self._recorded()
        answer = recording.enter(line, sent=sent)
        session, count = recording.session, len(recording.session)
        if answer.change != "none":
            self._seen, self._count, self.trouble = self._stamps(), count, ""
        self.errors = [each for each in self.errors if each[0] < count]
        if session.tip_error is not None:
            self.errors.append((count, session.tip_error))
        said = [words for words in answer.said if words not in doubt(session)]
        self.changed("measure", said, failed=answer.change == "none" and not answer.ended)

    def _listen(self) -> None:
        """Take in what the gauge sends, for as long as there is one."""
        assert self._inbox is not None
        self._inbox.prompted()
        while (entry := self._inbox.next()) is not None:
            try:
                with self.lock:
                    if entry.source == "note" or self.recording is None:
                        self.changed("measure", (entry.text,), failed=True)
                    else:
                        self._take(entry.text, sent=True)
            except CasacalError as error:
                self.changed("measure", (str(error),), failed=True)
            except Exception as error:  # the gauge is listened to all the same
                self.changed("measure", (unforeseen(error),), failed=True)
            if entry.source != "note":
                self._inbox.prompted()

    def _ask(self, _: Mapping[str, Any]) -> dict[str, Any]:
        if self.line is None or self._inbox is None or not self.place.gauge.asks:
            raise CasacalError("No gauge that can be asked is connected", "Type the reading")
        self._inbox.take_next()
        self.line.ask(self.place.gauge.asks, self._inbox)
        return {}

    def _conventions(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Look at poses off the pendant; where they confirm the problem's conventions, keep that beside it."""
        from casacal.doctor.diagnosis import diagnose
        from casacal.doctor.pendant_rows import read_pendant_rows
        from casacal.doctor.words import diagnosis_text

        robot = self.source.problem.robot
        rows = read_pendant_rows(pendant_table(asked, robot.revolute.tolist()), robot.revolute.tolist())
        found = diagnose(robot, rows)
        said = diagnosis_text(found, robot.axes).split("\n\n")[0].strip().split("\n")
        best = found.meanings[0] if found.meanings else None
        if best is not None and (best.length_unit != "mm" or best.joint_unit != "deg"):
            what = f"The poses fit with joints in {best.joint_unit} and lengths in {best.length_unit}"
            raise CasacalError(what, "Copy joint values in degrees and lengths in mm")
        if found.certain and best is not None and best.simplest == Conventions.plain(len(robot.axes)):
            if self.source.path:
                keep_conventions(self.source, file="the page beside the robot", poses=found.postures)
                self.source = replace(self.source)  # which reads anew what was kept
            self.changed("conventions", [*said, "Kept beside the problem: nobody is asked again"])
        else:
            fix = "Change the problem file as this says, and start the page again" if found.certain else ""
            if (found.certain or not found.meanings) and self.source.confirmed:
                (Path(self.source.path).parent / CONVENTIONS).unlink(missing_ok=True)
                self.source = replace(self.source)
                fix += ". What an earlier comparison had confirmed counts no more: these poses contradict it"
            self.changed("conventions", [*diagnosis_text(found, robot.axes).strip().split("\n"), fix], failed=True)
        return {}

    def _plan(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        if self.place.plan is not None:
            raise CasacalError(f"The plan is {self.place.plan}", "Start the page without --plan to make another one")
        if self.touched:
            what = self.trouble.removesuffix(".") or "Touches of this plan were made"
            raise CasacalError(what, "Take them back first, or start the page with another --out for another plan")
        touches, tolerance = number_of(asked, "touches", 3, MOST_TOUCHES), number_of(asked, "tolerance", 0, 1000)
        if touches is not None and (tolerance is not None or touches % 1):
            raise CasacalError("Got a number of touches and a tolerance", "Give a whole number, or a tolerance alone")

        def run() -> None:
            from casacal.planning.handouts import sheet_page
            from casacal.planning.plan import cell_words, plan, plan_sentences, plan_text, touches_for
            from casacal.planning.route import touches_needed
            from casacal.planning.set_ups import set_ups

            problem, cell, clearance = self.source.problem, self.source.cell, self.place.clearance
            count = int(touches or touches_for(problem, cell, tolerance, clearance=clearance, again=AGAIN, check=CHECK))
            made = plan(problem, cell, touches=count, pool=POOL, again=AGAIN, check=CHECK, clearance=clearance)
            fitted = made.purposes.count("fit")
            if (rows := len(made) - made.purposes.count("check")) < (least := touches_needed(problem, made.samples)):
                what = f"Of {count} touches {rows} are fitted, and a calibration takes {least} for all unknowns"
                wanted = math.ceil(1.5 * least)  # some are kept to verify, and more faces have more unknowns
                raise CasacalError(what, f"Ask for {wanted} or more, or leave the number empty")
            faced = problem.instrument.probe is not None and fitted <= POOL
            compared = set_ups(problem, cell, touches=fitted, clearance=clearance) if faced else ()
            said, name = cell_words(made, problem, clearance), self.source.name
            texts = {
                "plan.csv": plan_text(made, problem, name, clearance),
                "sheet.html": sheet_page(problem, made, name, said, made.cell, clearance),
            }
            self.place.folder.mkdir(parents=True, exist_ok=True)
            with together(self.place.folder, list(texts)) as place:
                for file, text in texts.items():
                    write_text(place / file, text)
            with self.lock:
                self.trouble, self._count = "", 0
                self._begin()
            self.changed("plan", plan_sentences(made, compared, where="over the workspace", pool=POOL, after=False))

        return self._run("plan", "planning the touches", run)

    def _calibrate(self, _: Mapping[str, Any]) -> dict[str, Any]:
        recording = self._recorded()
        if not len(recording.session):
            raise CasacalError("No touch has been made", "Measure first")
        if recording.session.alarm is not None:
            raise CasacalError("A touch is in doubt", "Settle it first, where touches are measured")

        def run() -> None:
            from casacal.calibration.brief import brief
            from casacal.calibration.calibrate import calibrate

            samples, fitted = self.source.problem.read(self.place.samples), self._rows(self.place.samples)
            found = calibrate(self.source, samples)
            found.save(self.place.fit)
            with self.lock:
                self.arm, self._verified, self._fitted = read_result(self.place.fit), None, fitted
                self.said.pop("verify", None)
            told = (found.verdict.words, *found.verdict.reasons, found.arm.mirror_words)
            lines = brief(found, found.verdict, out=self.place.fit.as_posix(), width=10_000).split("\n")
            said = [line for line in lines if line.strip(" -") not in told]
            if self.place.since is not None:
                from casacal.changes.changed import changed

                try:
                    since = changed(self.place.since, samples).summary().split("\n")
                except CasacalError as error:  # such as an earlier result of another instrument
                    since = [str(error)]
                said += ["Since the earlier calibration:", *since]
            self.changed("decide", [line.strip() for line in said if line.strip()])

        return self._run("decide", "calibrating", run)

    def _verify(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        tolerance = number_of(asked, "tolerance", 0, 1000)
        if self.arm is None or self.recording is None:
            raise CasacalError("There is no calibration yet", "Calibrate first")
        if not self.place.check.is_file():
            raise CasacalError("No touch kept to verify has been made", "Go on with the plan: some of it is kept")
        arm, check = self.arm, self.place.check

        def run() -> None:
            from casacal.verification.verification import verify

            rows, fresh = self._rows(check), self.source.problem.read(check)
            found = verify(arm, fresh, tolerance=tolerance)
            write_text(self.place.folder / "verified.html", found.page(), own=True)
            with self.lock:
                self._verified = None if rows is None else (found, rows)
            self.changed("verify", found.summary(whole=False).split("\n"))

        return self._run("verify", "verifying", run)

    def _correct(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Targets or programs corrected for the calibrated arm, all or none: names, bytes, and what is to be known."""
        if self.arm is None:
            raise CasacalError("There is no calibration yet", "Calibrate first")
        if self.outdated:
            raise CasacalError("Touches were made after the calibration", "Calibrate again first")
        frame = text_of(asked, "frame", 10)
        refuse_unknown("frame", [frame], FRAMES)
        out, said = list[dict[str, str]](), list[str]()
        with tempfile.TemporaryDirectory(prefix="casacal-") as place:
            kept = uploaded(asked, Path(place))
            wholes = [path for path in kept if path.suffix != ".dat"]
            for path in wholes:
                try:
                    made, words = corrected(
                        self.arm, path, kept[path], cast(Frame, frame), leave=asked.get("leave") is True
                    )
                except CasacalError as error:
                    here, there = str(path.with_suffix("")), Path(kept[path]).stem
                    kind = RefusedResultError if isinstance(error, RefusedResultError) else CasacalError
                    raise kind(error.what.replace(here, there), error.fix.replace(here, there)) from error
                stem = "corrected" if len(wholes) == 1 else f"corrected_{Path(kept[path]).stem}"
                out += [{"name": f"{stem}{end}", "data": base64.b64encode(data).decode()} for end, data in made]
                said += words if len(wholes) == 1 else [f"{kept[path]}: {each}" for each in words]
        return {"files": out, "said": list(map(for_page, said))}

    def _run(self, gate: str, words: str, run: Callable[[], None]) -> dict[str, Any]:
        """Do something that takes its time; the steps of others wait for it."""

        def alone() -> None:
            try:
                run()
            except CasacalError as error:
                self.changed(gate, (str(error),), failed=True)
            except Exception as error:  # a window that waits must not be left without a word
                self.changed(gate, (unforeseen(error),), failed=True)
            finally:
                with self.lock:
                    self.job = None
                    self.version += 1

        self.job = words
        self.version += 1
        threading.Thread(target=alone, daemon=True).start()
        return {}


def unforeseen(error: Exception) -> str:
    """Words for what nobody foresaw, which the log of the server tells whole."""
    _LOG.error("casacal serve: unforeseen", exc_info=error)
    return f"This failed for a reason that is not foreseen ({error!r}); the window of casacal serve tells more"


def for_page(words: str) -> str:
    """Words of casacal for its page, which has neither commands nor options: where they name some, that is said."""
    own = "these are commands and options of casacal in a terminal, which can take turns with this page"
    if OF_SET_UPS.search(words):
        own = "options of casacal plan in a terminal: end this page, plan there, and serve the problem that it writes"
    words = words.replace("with --skip-unknown", "with the box under Hand over")
    return f"{words} ({own})" if OF_TERMINAL.search(words) else words

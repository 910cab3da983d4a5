"""One arm's way through the gates, in one folder: what every window of the page sees, and the steps it may ask for.

The folder holds all that lasts: plan.csv and sheet.html, samples.csv and samples_check.csv as `casacal measure` writes
them, and fit/ as `casacal calibrate` does. What is held here besides can be made again from them.
"""

from __future__ import annotations

import base64
import binascii
import math
import secrets
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from casacal.data.text import Table
from casacal.deployment.arm import CalibratedArm
from casacal.deployment.result_file import read_result
from casacal.errors import CasacalError, refuse_unknown
from casacal.files import together, write_text
from casacal.model.joints import Conventions
from casacal.model.problem_file import ProblemFile, keep_conventions
from casacal.planning.clearance import Clearance
from casacal.planning.route import joints_shown
from casacal.planning.scene import scene
from casacal.shopfloor.conversation import doubt
from casacal.shopfloor.gauges import Gauge, Inbox, SerialLine
from casacal.shopfloor.recording import Recording, begun
from casacal.shopfloor.session import Session
from casacal.values import Array
from casacal.verification.verification import Verification
from casacal.wording import counted

AGAIN = 0.05  # as `casacal plan`: parts of a plan that are repeated, and kept to verify
CHECK = 0.15
POOL = 3000
MOST_TOUCHES = 500
ENOUGH_POSES, MOST_ROWS = 4, 50  # off a pendant


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
        """Touches to fit; those kept to verify stand in `samples_check.csv`."""
        return self.folder / "samples.csv"

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
        self.verified: Verification | None = None
        self._scene: dict[str, Any] | None = None
        self.line, self._inbox = line, None if line is None else Inbox()
        if place.plan is not None or place.plan_file.is_file():
            self._begin()
        if (place.fit / "result.json").is_file():
            self.arm = read_result(place.fit)
        if line is not None and self._inbox is not None:
            threading.Thread(target=line.listen, args=(self._inbox,), daemon=True).start()
            threading.Thread(target=self._listen, daemon=True).start()

    @property
    def outdated(self) -> bool:
        """Whether touches were made or changed after the calibration."""
        result, samples = self.place.fit / "result.json", self.place.samples
        with suppress(OSError):
            return samples.stat().st_mtime > result.stat().st_mtime
        return False

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
            return steps[step](asked)

    def look(self) -> None:
        """Read anew what another program, such as `casacal measure`, has written to the file of touches."""
        with self.lock:
            if self.job is None and self.recording is not None and self.recording.overtaken:
                self._begin()
                self.version += 1

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
        self.errors = []
        if session.tip_error is not None:
            for count in range(1, len(session)):
                before = session.resumed(session.touches[:count])
                if before.tip_error is not None:
                    self.errors.append((count, before.tip_error))
            self.errors.append((len(session), session.tip_error))
        self.said["measure"] = (*said, *doubt(session))

    def _enter(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        line = text_of(asked, "line", 500)
        if self.recording is None:
            raise CasacalError("There is no plan yet", "Plan the touches first")
        self._take(line, sent=False)
        if self._inbox is not None:
            self._inbox.prompted()
        return {}

    def _go_on(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Go on beyond the plan, with the touches that tell most, until the tip error is below what is wanted."""
        if self.recording is None:
            raise CasacalError("There is no plan yet", "Plan the touches first")
        tolerance = number_of(asked, "tolerance", 0, 1000)
        self.recording.session = replace(self.recording.session, tolerance=tolerance)
        self.changed("measure", ())
        return {}

    def _take(self, line: str, *, sent: bool) -> None:
        """Enter a line; what the session answers becomes what the gate says."""
        recording = self.recording
        assert recording is not None
        answer = recording.enter(line, sent=sent)
        session, count = recording.session, len(recording.session)
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
            self.changed("conventions", [*diagnosis_text(found, robot.axes).strip().split("\n"), fix], failed=True)
        return {}

    def _plan(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        if self.place.plan is not None:
            raise CasacalError(f"The plan is {self.place.plan}", "Start the page without --plan to make another one")
        if self.recording is not None and len(self.recording.session):
            what = "Touches of this plan were made"
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
            with together(self.place.folder, list(texts), own=True) as place:
                for file, text in texts.items():
                    write_text(place / file, text)
            with self.lock:
                self._begin()
            self.changed("plan", plan_sentences(made, compared, where="over the workspace", pool=POOL, after=False))

        return self._run("plan", "planning the touches", run)

    def _calibrate(self, _: Mapping[str, Any]) -> dict[str, Any]:
        recording = self.recording
        if recording is None or not len(recording.session):
            raise CasacalError("No touch has been made", "Measure first")
        if recording.session.alarm is not None:
            raise CasacalError("A touch is in doubt", "Settle it first, where touches are measured")

        def run() -> None:
            from casacal.calibration.brief import brief
            from casacal.calibration.calibrate import calibrate

            samples = self.source.problem.read(self.place.samples)
            found = calibrate(self.source, samples)
            found.save(self.place.fit)
            told = (found.verdict.words, *found.verdict.reasons, found.arm.mirror_words)
            lines = brief(found, found.verdict, out=self.place.fit.as_posix(), width=10_000).split("\n")
            said = [line for line in lines if line.strip(" -") not in told]
            if self.place.since is not None:
                from casacal.changes.changed import changed

                said += ["Since the earlier calibration:", *changed(self.place.since, samples).summary().split("\n")]
            with self.lock:
                self.arm, self.verified = read_result(self.place.fit), None
                self.said.pop("verify", None)
            self.changed("decide", [line.strip() for line in said if line.strip()])

        return self._run("decide", "calibrating", run)

    def _verify(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        tolerance = number_of(asked, "tolerance", 0, 1000)
        if self.arm is None or self.recording is None:
            raise CasacalError("There is no calibration yet", "Calibrate first")
        if not self.recording.file.check_path.is_file():
            raise CasacalError("No touch kept to verify has been made", "Go on with the plan: some of it is kept")
        arm, check = self.arm, self.recording.file.check_path

        def run() -> None:
            from casacal.verification.verify import verify

            found = verify(arm, self.source.problem.read(check), tolerance=tolerance)
            write_text(self.place.folder / "verified.html", found.page(), own=True)
            said = found.summary(whole=False).split("\n")
            with self.lock:
                self.verified = found
            self.changed("verify", said + ([] if arm.mirror_words is None else [arm.mirror_words]))

        return self._run("verify", "verifying", run)

    def _correct(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Targets or a program corrected for the calibrated arm: its name, its bytes, and what is to be known."""
        if self.arm is None:
            raise CasacalError("There is no calibration yet", "Calibrate first")
        if self.outdated:
            raise CasacalError("Touches were made after the calibration", "Calibrate again first")
        with tempfile.TemporaryDirectory(prefix="casacal-") as place:
            paths = uploaded(asked, Path(place))
            out, said = corrected(self.arm, paths)
        return {"files": [{"name": name, "data": base64.b64encode(data).decode()} for name, data in out], "said": said}

    def _run(self, gate: str, words: str, run: Callable[[], None]) -> dict[str, Any]:
        """Do something that takes its time; the steps of others wait for it."""

        def alone() -> None:
            try:
                run()
            except CasacalError as error:
                self.changed(gate, (str(error),), failed=True)
            except Exception as error:  # nobody foresaw it; a window that waits must not be left without a word
                self.changed(gate, (f"This failed for a reason that is not foreseen ({error!r})",), failed=True)
            finally:
                with self.lock:
                    self.job = None
                    self.version += 1

        self.job = words
        self.version += 1
        threading.Thread(target=alone, daemon=True).start()
        return {}


def text_of(asked: Mapping[str, Any], name: str, longest: int) -> str:
    """A text that a window sent; raises CasacalError."""
    text = asked.get(name)
    if not isinstance(text, str) or len(text) > longest:
        raise CasacalError(f"'{name}' is no text of at most {longest} letters", "Send it again")
    return text


def number_of(asked: Mapping[str, Any], name: str, low: float, high: float) -> float | None:
    """A number in a field, None where it was left empty; raises CasacalError."""
    text = text_of(asked, name, 40).strip().replace(",", ".")
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not (low < value <= high or value == low > 0):  # zero is no number of anything here, three touches are
        what = f"'{text}' is no {'number of touches' if name == 'touches' else name}"
        raise CasacalError(what, f"Give a number from {low:g} to {high:g}, or leave it empty")
    return value


ORIENTATIONS: Mapping[str, tuple[str, ...]] = {
    "abc": ("a_deg", "b_deg", "c_deg"),
    "wpr": ("w_deg", "p_deg", "r_deg"),
    "rxyz": ("rx_rad", "ry_rad", "rz_rad"),
    "rxyz_deg": ("rx_deg", "ry_deg", "rz_deg"),
    "oat": ("o_deg", "a_deg", "t_deg"),
    "quaternion": ("qw", "qx", "qy", "qz"),
}
"""Columns of an orientation as a pendant shows it, by the word that the page has for it."""


def pendant_table(asked: Mapping[str, Any], turns: Sequence[bool]) -> Table:
    """Rows of a pendant as a window sends them: joints, x, y, z and an orientation, one pose a line."""
    form, text = text_of(asked, "form", 20), text_of(asked, "rows", 20_000)
    refuse_unknown("form of an orientation", [form], ORIENTATIONS)
    joints = [f"q{k}_{'deg' if turning else 'mm'}" for k, turning in enumerate(turns, 1)]
    header = (*joints, "x_mm", "y_mm", "z_mm", *ORIENTATIONS[form])
    rows, lines = list[tuple[str, ...]](), list[int]()
    for number, line in enumerate(text.splitlines(), 1):
        cells = tuple(line.replace(";", " ").replace(",", " ").split())
        if cells and len(cells) != len(header):
            what = f"Line {number} has {len(cells)} numbers, not {len(header)}"
            raise CasacalError(what, f"Write {', '.join(header)}, apart by blanks")
        if cells:
            rows.append(cells)
            lines.append(number)
    if not ENOUGH_POSES <= len(rows) <= MOST_ROWS:
        raise CasacalError(f"Got {counted(len(rows), 'pose')}", f"Give {ENOUGH_POSES} or more, at most {MOST_ROWS}")
    return Table("the page", "", header, 0, tuple(rows), tuple(lines), decimal_comma=False)


def uploaded(asked: Mapping[str, Any], place: Path) -> list[Path]:
    """Files that a window sent, in a folder of their own, under names of ours; raises CasacalError."""
    from casacal.programs.endings import ENDINGS

    files = asked.get("files")
    if not isinstance(files, list) or not 1 <= len(files) <= 2:
        raise CasacalError("No file came", "Choose a file of targets or a program; of KRL both files")
    paths = list[Path]()
    for each in files:
        sent: Mapping[str, Any] = each if isinstance(each, dict) else {}
        suffix = Path(text_of(sent, "name", 300)).suffix.lower()
        if suffix not in (".csv", ".dat", *ENDINGS):
            raise CasacalError(f"A file that ends in '{suffix[:20]}' came", f"Give .csv, {', '.join(ENDINGS)}")
        try:
            data = base64.b64decode(text_of(sent, "data", 4_000_000), validate=True)
        except binascii.Error:
            raise CasacalError("The file came damaged", "Choose it again") from None
        paths.append(place / f"targets{suffix}")
        paths[-1].write_bytes(data)
    return sorted(paths, key=lambda path: path.suffix == ".dat")


def corrected(arm: CalibratedArm, paths: Sequence[Path]) -> tuple[list[tuple[str, bytes]], list[str]]:
    """Names and bytes of corrected targets or of a program, and sentences; raises CasacalError where it is refused."""
    from casacal.deployment.compensate import compensate, read_targets
    from casacal.deployment.programs import notes, rounding_of, text_of
    from casacal.programs.correct import compensate_program
    from casacal.programs.endings import is_program
    from casacal.programs.read import read_program

    if is_program(paths[0]):
        found = compensate_program(arm, read_program(paths[0]))
        largest = float(found.correction_mm[found.reached].max(initial=0.0))
        said = [f"{int(found.reached.sum())} targets corrected, by up to {largest:.2f} mm"]
        said += [f"Left as it is: line {each.line}, {each.what}" for each in found.program.puzzles]
        said += [f"Left as it is: {found.program.targets[i].name}: {why}" for i, why in found.why.items()]
        names = [f"corrected{Path(path).suffix}" for path in found.program.paths]
        return [(n, text.encode("latin-1")) for n, text in zip(names, found.texts, strict=True)], said
    rounding = rounding_of("csv", arm.source.problem.robot)
    targets = replace(read_targets(paths[0], arm.source), file=paths[0].name)
    made = compensate(arm, targets, rounding=rounding)
    lost = sum(outcome.value != "reached" for outcome in made.outcomes)
    said = [*notes(made, arm), *([f"{lost} targets are not reached: see the column status"] if lost else [])]
    return [("corrected.csv", text_of(made, "csv", arm).encode())], said

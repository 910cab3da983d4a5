"""Compensated targets as text: CSV, or joint moves in RAPID (ABB), KRL (KUKA) and URScript (Universal Robots).

A move is written for a target that is reached; the others are comments with the reason, never moves. Whatever comes
from a user's file goes into comments as plain ASCII on one line.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from casacal.deployment.arm import FLANGE_UNKNOWN, TRUTH, CalibratedArm, column_notes, unit_notes
from casacal.deployment.compensate import Compensation, Outcome, Rounding
from casacal.deployment.inverse_kinematics import torn
from casacal.errors import CasacalError, refuse_unknown
from casacal.files import MADE
from casacal.model.robot import Robot
from casacal.uncertainty.figures import rms
from casacal.values import Array, FrozenMapping
from casacal.wording import counted, figures

LONGEST = 300  # letters in a comment


@dataclass(frozen=True)
class Language:
    """Syntax of a controller: comment mark, six joint values and their rounding, and the lines around the moves."""

    name: str
    comment: str
    joints: str
    rounding: Rounding
    head: str
    begin: tuple[str, ...]
    move: str
    end: tuple[str, ...]

    def refuse_others(self, robot: Robot, move: str, fix: str) -> None:
        """Raise CasacalError for a robot whose joints the language does not hold."""
        kinds = "".join(joint.kind[0].upper() for joint in robot.axes)
        if kinds != "RRRRRR":
            what = f"'{robot.name}' has {len(kinds)} joints ({kinds}), and a {move} in {self.name} has six that turn"
            raise CasacalError(what, fix)

    def written(self, joints: Array, decimals: int) -> str:
        """Joint values (6,; rad) as a move names them."""
        factor = 180 / math.pi if self.rounding.degrees else 1.0
        return self.joints.format(*(f"{value * factor:.{decimals}f}" for value in joints))

    def program(self, compensation: Compensation, notes: list[str]) -> str:
        """The whole program, the notes and each source row as comments."""
        said = [f"  {self.comment} {line}" for note in notes for line in in_comments(note)]
        lines = [self.head, *said, *self.begin]
        for i, outcome in enumerate(compensation.outcomes):
            source = printable(compensation.targets.text[i])
            lines.append(f"  {self.comment} line {compensation.targets.lines[i]}: {source}")
            if outcome is Outcome.REACHED:
                joints = self.written(compensation.joints[i], self.rounding.decimals)
                lines.append(f"  {self.move.format(joints)}")
            else:
                lines.append(f"  {self.comment} no move: {outcome.value}: {outcome.meaning}{compensation.left(i)}")
        return "\n".join([*lines, *self.end]) + "\n"


# RAPID's num and KRL's REAL have seven digits, so more decimals of a degree would be lost in the controller
RAPID = Language(
    "RAPID",
    "!",
    "[[{},{},{},{},{},{}],[9E9,9E9,9E9,9E9,9E9,9E9]]",
    Rounding(decimals=5),
    "MODULE casacal_targets",
    ("PROC take_targets()",),
    "MoveAbsJ {}\\NoEOffs, v100, fine, tool0;",
    ("ENDPROC", "ENDMODULE"),
)
KRL = Language(
    "KRL",
    ";",
    "{{A1 {}, A2 {}, A3 {}, A4 {}, A5 {}, A6 {}}}",
    Rounding(decimals=5),
    "DEF casacal_targets()",
    ("  BAS(#INITMOV, 0)",),
    "PTP {}",
    ("END",),
)
URSCRIPT = Language(
    "URScript",
    "#",
    "[{}, {}, {}, {}, {}, {}]",
    Rounding(degrees=False, decimals=9),
    "def casacal_targets():",
    (),
    "movej({})",
    ("end",),
)
LANGUAGES: Mapping[str, Language] = FrozenMapping({"rapid": RAPID, "krl": KRL, "urscript": URSCRIPT})
CSV = "csv"


def rounding_of(form: str, robot: Robot) -> Rounding:
    """Rounding of joint values in a form; raises CasacalError for a robot whose joints its language does not hold."""
    refuse_unknown("form of targets", [form], (CSV, *LANGUAGES))
    if form == CSV:
        return Rounding()
    LANGUAGES[form].refuse_others(robot, "joint move", "Use --format csv")
    return LANGUAGES[form].rounding


def text_of(compensation: Compensation, form: str, result: CalibratedArm) -> str:
    """The file: notes on what it is and what to expect, then one entry per target."""
    what = notes(compensation, result)
    if form != CSV:
        return LANGUAGES[form].program(compensation, what)
    said = [f"# {line}" for note in what for line in in_comments(note)]
    return "\n".join([*said, *_table(compensation, result)]) + "\n"


def notes(compensation: Compensation, result: CalibratedArm) -> list[str]:
    """Origin of the file, its proof and the accuracy to expect; one sentence per line."""
    reached, targets = compensation.reached, compensation.targets
    counts = Counter(outcome.value for outcome in compensation.outcomes)
    robot = result.source.problem.robot
    names = {name for key, unknown in robot.parameters.items() for name in unknown.names(key)}
    unseen = [row.name for row in result.found.parameters if row.known_from in ("prior alone", "held")]
    held = [name for name in unseen if name in names]
    lines = [
        f"{MADE}: compensate {targets.file} (SHA-256 {targets.sha256[:12]}), result {result.file} of {robot.name}",
        "joint values are those that the controller shows",
        f"{counted(len(targets), 'target')}: " + ", ".join(f"{count} {word}" for word, count in counts.items()),
    ]
    if result.found.method == "truth":
        lines.append(f"WARNING: {TRUTH}")
    if (denial := result.denial) is not None:
        lines.append(f"WARNING, forced against the verdict: {denial}")
    if (care := result.caution) is not None:
        lines.append(f"the result's verdict: {care}")
    if (image := result.mirror_words) is not None and targets.poses is not None:
        lines.append(image)
    if reached.any():
        lines += [
            f"round trip: at these joint values the calibrated {compensation.frame} misses the nominal poses by "
            f"{_figures(compensation.residual_mm[reached], 'mm')} and "
            f"{_figures(1e3 * compensation.residual_rad[reached], 'mrad')}, over the rows that are reached",
            f"what the correction {'removes' if denial is None else 'changes'} there: "
            f"{_figures(compensation.correction_mm[reached], 'mm')}",
        ]
        lines += no_gain(compensation.correction_mm[reached], compensation.expected_mm[reached])
    if compensation.frame == "flange" and not result.flange_known and denial is None:
        lines.append(FLANGE_UNKNOWN)
    elif reached.any() and denial is None:
        lines.append(
            f"position error of the {compensation.frame} to expect: "
            f"{_figures(compensation.expected_mm[reached], 'mm')}; standard deviation, apart from the pose of the "
            "base, whose origin and directions must be taught"
        )
    lines += [] if targets.joints is None else unit_notes(robot, targets.joints)
    lines += column_notes(result, compensation.missing, compensation.beyond)
    if len(robot.axes) < 6:
        lines.append("fewer than six joints: position first, the orientation as near as the position allows")
    if targets.poses is not None and targets.joints is None:
        jumps = [targets.lines[i] for i in torn(result.source.problem.robot, compensation.joints, *targets.poses)]
        if jumps:
            shown = ", ".join(map(str, jumps[:10])) + (", ..." if len(jumps) > 10 else "")
            lines.append(f"the branch changes, so the joints swing, before line {shown}; joint columns would choose it")
    if held:
        lines.append(f"known from the prior alone, so at or near nominal: {', '.join(held)}")
    return lines


def no_gain(removed: Array, left: Array) -> list[str]:
    """A warning where errors (N,; mm) that a correction leaves are not expected to be smaller than what it removes."""
    if not (len(removed) and rms(left) >= rms(removed)):  # what is left may be unknown
        return []
    return [
        f"warning: the error to expect after this correction ({figures(rms(left), 2)} mm RMS) is not smaller than what "
        f"it removes ({figures(rms(removed), 2)} mm RMS): targets may be no better than without it"
    ]


def _figures(values: Array, unit: str) -> str:
    return f"{figures(rms(values), 2)} {unit} RMS ({figures(float(values.max()), 2)} {unit} at worst)"


def _table(compensation: Compensation, result: CalibratedArm) -> Iterator[str]:
    turns = result.source.problem.robot.revolute
    names = ",".join(f"q{i}_{'deg' if turn else 'mm'}" for i, turn in enumerate(turns, 1))
    named = compensation.targets.names
    names = ",".join(("line", *named, names))
    slides = "" if turns.all() else "correction_slide_mm,"
    yield f"{names},status,residual_mm,residual_mrad,correction_mm,correction_deg,{slides}expected_mm"
    denied = result.denial is not None
    written = compensation.joints * np.where(turns, 180 / math.pi, 1.0)
    moves = np.abs(compensation.joints - compensation.start)
    largest = [np.degrees(moves[:, turns].max(axis=1, initial=0.0)), moves[:, ~turns].max(axis=1, initial=0.0)]
    for i, outcome in enumerate(compensation.outcomes):
        figures = (
            compensation.residual_mm[i],
            1e3 * compensation.residual_rad[i],
            compensation.correction_mm[i],
            *(each[i] for each in largest[: 1 if turns.all() else 2]),
            math.nan if denied else compensation.expected_mm[i],
        )
        joints = [_cell(value, compensation.rounding.decimals) for value in written[i]]
        known = [_cell(value, 6) for value in figures]
        told = [_quoted(cells[i]) for cells in named.values()]
        yield ",".join([str(compensation.targets.lines[i]), *told, *joints, outcome.value, *known])


def _cell(value: float, decimals: int) -> str:
    """A number of the table; nothing where it is not known."""
    return f"{value:.{decimals}f}" if math.isfinite(value) else ""


def _quoted(text: str) -> str:
    """A cell of text as CSV has it."""
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"#') else text


def in_comments(note: str) -> list[str]:
    """A note as lines of comments, ASCII, none longer than `LONGEST`; nothing of a verdict is lost."""
    plain = note.encode("unicode_escape").decode("ascii")
    return textwrap.wrap(plain, LONGEST, subsequent_indent="  ", break_on_hyphens=False)


def printable(text: str) -> str:
    """Text for a comment of any language: ASCII on one line, cut to a sensible length."""
    plain = text.encode("unicode_escape").decode("ascii")
    return plain if len(plain) <= LONGEST else f"{plain[:LONGEST]}..."

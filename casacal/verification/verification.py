"""Report of a verification: figures, sentences with the answer first, and a page."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from html import escape
from typing import Any

from markupsafe import Markup

from casacal.calibration.fresh import Judged
from casacal.pages.drawing import fixed, rendered, shortened
from casacal.values import Value
from casacal.verification.arm_error import Decision, PartError
from casacal.verification.page import LONGEST, boxes, error_rows, errors_picture
from casacal.wording import capital, chance, counted, figures, mm, numbered_lines
from casacal.wording import shortened as first_few
from casacal.wording import times as in_two

LEVEL = 0.05
"""Chance at which rows that are as promised are said not to be: at most one verification in twenty of a good arm.

Two tests share it, of all residuals and of what they say of the arm alone.
"""

SHOWN = 12  # faces, or lines of rows, that are named one by one
CERTAIN = 0.9999  # probability beyond which nobody asks how near to one
VERDICTS = {"accept": "Accepted", "reject": "Rejected", "undecided": "Undecided"}

WORTH_SAYING = 1.05  # noise over noise beyond which a difference is worth saying


@dataclass(frozen=True)
class FaceVerification:
    """One face: rows, residuals (mm RMS) as drawn, as calibrated and as predicted, chi-square over freedom, chance."""

    label: str
    rows: int
    before_mm: float
    after_mm: float
    predicted_mm: float
    chi_square: float
    freedom: int
    p: float


@dataclass(frozen=True, eq=False, repr=False)
class Verification(Value):
    """Result of `verify`: whether the promise was kept, with every figure behind it.

    A row's residual is its distance from the face, mm, or the length of its error where a row has several residuals.

    judged: the rows, and the calibration, which has not seen them.
    before_mm, after_mm, predicted_mm: residuals, RMS, with the arm as drawn, as calibrated, and as it was predicted.
    chi_square, freedom, p: of all residuals against their predicted covariance, and the chance of so much or more.
    seen, arm_chi_square, arm_p: the same in those directions of the arm alone that these rows know better than the
    prior, as many as `seen` of its `unknowns`: where an arm that changed since shows.
    faces: each face by itself. gross_lines, kept_without_gross: rows that the others do not expect where they are, and
    whether the promise is kept without them.
    quantile_mm: within which 95 % of the residuals lie, noise and all.
    errors: the arm's error, RMS over postures of this kind, noise taken off: of all rows, each face, each region; none
    where the rows say nothing of it. decision: whether it is within the tolerance that was asked for, or None.
    noise_mm, noise_most_mm: the instrument's own noise, RMS of a row: what was taken off, and the most that it may be.
    noise_stated_mm: as the problem states it.
    promised_tip_mm, hidden_tip_mm: tip error that the calibration expects, RMS over the workspace apart from where the
    base stands and how another instrument is mounted, and the part of it that rows like these would leave; infinite
    where nothing bounds it.
    accuracy: whether residuals are errors of the tip itself. things: what was measured, as in "planes". sees: what the
    residual is, as in "distance from the planes". unit: of it all.
    """

    judged: Judged
    before_mm: float
    after_mm: float
    predicted_mm: float
    chi_square: float
    freedom: int
    p: float
    seen: int
    unknowns: int
    arm_chi_square: float
    arm_p: float
    faces: tuple[FaceVerification, ...]
    gross_lines: tuple[int, ...]
    kept_without_gross: bool
    quantile_mm: float
    errors: tuple[PartError, ...]
    decision: Decision | None
    noise_mm: float
    noise_most_mm: float
    noise_stated_mm: float
    promised_tip_mm: float
    hidden_tip_mm: float
    accuracy: bool
    things: str
    sees: str
    unit: str

    @property
    def kept(self) -> bool:
        """Whether the promise was kept: the residuals are no larger than chance explains, at a level of 5 %."""
        return min(self.p, self.arm_p) >= LEVEL / 2

    @property
    def overall(self) -> PartError | None:
        """The arm's error in all rows; None where they say nothing of it."""
        return next((part for part in self.errors if part.kind == "all"), None)

    @property
    def denied(self) -> bool:
        """Whether the calibration's own verdict is not to use it."""
        return self.judged.verdict[0] == "do not use"

    @property
    def passed(self) -> bool:
        """Whether the promise was kept, and the arm accepted where there is a tolerance, if it may be used at all."""
        return self.kept and (self.decision is None or (self.decision.verdict == "accept" and not self.denied))

    @property
    def measurand(self) -> str:
        """Measurand of the error, and its limits."""
        if self.accuracy:
            return "error of the tip, all three axes, where it was measured"
        return f"error as seen by these {self.things}" + (f" ({self.sees})" if self.sees != "residual" else "")

    def summary(self, *, whole: bool = True) -> str:
        """Report of `casacal verify --verbose`, or its brief form without `whole`; one paragraph a line."""
        return "\n".join(_paragraphs(self, whole=whole))

    def to_dict(self) -> dict[str, Any]:
        """All of it in JSON's own types, as `casacal verify --json` prints it."""
        instead: dict[str, Any] = {name: [asdict(part) for part in getattr(self, name)] for name in ("faces", "errors")}
        if self.decision is not None:
            instead["decision"] = {
                **asdict(self.decision),
                "guard_mm": self.decision.guard_mm,
                "guard_of_rejection_mm": self.decision.guard_of_rejection_mm,
                "rule": "JCGM 106:2012, guarded acceptance and guarded rejection",
            }
        if self.denied or not self.kept:  # no figure of accuracy beside a verdict that denies it
            instead["promised_tip_mm"] = instead["hidden_tip_mm"] = math.nan
        return self.judged.document({"kept": self.kept, "passed": self.passed}, self, instead)

    def page(self) -> str:
        """HTML of a page that needs no other file, no network and no script: what `casacal verify --report` writes."""
        title = f"Verification of {self.judged.robot} ({self.judged.samples})"
        return rendered("verification.html", {"title": title, "part_of_report": False, **_context(self)})

    def section(self) -> str:
        """Section for the calibration's report, as `casacal verify --into-report` inserts it."""
        return rendered("verified.html", {"part_of_report": True, **_context(self)})

    def __repr__(self) -> str:
        said = "kept" if self.kept else "not kept"
        p = min(self.p, self.arm_p)
        return f"<Verification of {self.judged.robot} by {self.judged.rows} fresh rows: promise {said}, p {p:.3g}>"

    def _repr_html_(self) -> str:
        """`summary` for notebooks."""
        return "".join(f"<p>{escape(words)}</p>" for words in _paragraphs(self, whole=False))


def _context(found: Verification) -> dict[str, Any]:
    """Context of the templates."""
    undecided = found.kept and found.decision is not None and found.decision.verdict == "undecided"
    faces = []
    for face in found.faces:
        sizes = map(fixed, (face.before_mm, face.after_mm, face.predicted_mm))
        faces.append([shortened(face.label, LONGEST), f"{face.rows:,}", *sizes, f"{face.p:.2g}"])
    return {
        "found": found,
        "paragraphs": _paragraphs(found),
        "decision": _decision(found),
        "measurand": found.measurand,
        # a result whose own verdict denies it looks no better for rows that agree with it
        "look": "bad" if found.denied else "good" if found.passed else "care" if undecided else "bad",
        "rows": [
            ("Fresh rows", f"{found.judged.samples}: {found.judged.rows:,}"),
            ("SHA-256 of the rows", Markup("<code>{}</code>").format(found.judged.sha256)),
            ("Fitted to these rows", shortened(", ".join(found.judged.own), 200) or "nothing"),
            ("Assumed not to have moved", ", ".join(found.judged.standing) or "nothing"),
        ],
        "overall": boxes(found.overall, found.decision),
        "picture": None if found.overall is None else errors_picture(found.errors, found.decision),
        "errors": error_rows(found.errors),
        "faces": faces,
    }


def _paragraphs(found: Verification, *, whole: bool = True) -> list[str]:
    """Paragraphs, the answer first; statistics, faces and regions where the whole is asked for."""
    own = f" ({first_few(found.judged.own, 4)})"
    what = "Error of the tip, all three axes" if found.accuracy else f"Residual on these {found.things}"
    statistics = [
        f"Chi-square {found.chi_square:.3g} with {found.freedom} degrees of freedom, {chance(found.p)}; of the "
        f"arm alone {found.arm_chi_square:.3g} with {found.seen}, {chance(found.arm_p)}. The promise is kept if both p "
        f"are at least {LEVEL / 2:g}. The arm was not fitted; {found.judged.fitted_words(own)}.",
        *(_face(found, face) for face in found.faces[:SHOWN]),
        *([f"{len(found.faces) - SHOWN} more faces with --json."] if len(found.faces) > SHOWN else []),
    ]
    gross = []
    if found.gross_lines:
        fit, without = ("does not fit", "it") if len(found.gross_lines) == 1 else ("do not fit", "them")
        kept = "is kept" if found.kept_without_gross else "is not kept either"
        gross = [
            f"{capital(numbered_lines(found.gross_lines))} of {found.judged.samples} {fit} the other rows: measure "
            f"{without} again. Without {without} the promise {kept}."
        ]
    return [
        _answer(found),
        *found.judged.own_verdict,
        *found.judged.remarks,
        *found.judged.left_out(
            "of {} repeat others to the last digit and count once",
            "of {} are among those that the arm was calibrated from and do not count",
        ),
        f"{what}: {in_two(found.after_mm)} {found.unit} RMS as calibrated, {in_two(found.predicted_mm)} predicted, "
        f"{in_two(found.before_mm)} as drawn; 95 % of the rows are within {in_two(found.quantile_mm)}.",
        *(statistics if whole else []),
        *gross,
        *(_errors(found) if whole else _errors(found)[:1]),
        *_decision(found),
        _vouches(found),
        *_next(found),
    ]


def _answer(found: Verification) -> str:
    if not found.kept:
        if found.p < LEVEL / 2:
            times = f"{in_two(math.sqrt(found.chi_square / max(found.freedom, 1)))} times what was predicted"
            return f"Promise not kept: the residuals of {found.judged.said} are {times} ({chance(found.p)})."
        return f"Promise not kept: {found.judged.said} do not agree with the arm as calibrated ({chance(found.arm_p)})."
    verdict = ""
    if found.decision is not None:
        decided = {"accept": ", and accepted", "reject": ", but rejected", "undecided": ", but undecided"}
        verdict = ", but the result must not be used" if found.denied else decided[found.decision.verdict]
    return f"Promise kept{verdict}: {found.judged.said} agree with the calibration of {found.judged.robot}."


def _face(found: Verification, face: FaceVerification) -> str:
    return (
        f"  {face.label}: {counted(face.rows, 'row')}, {in_two(face.after_mm)} {found.unit} RMS, "
        f"{in_two(face.predicted_mm)} predicted (as drawn: {in_two(face.before_mm)}); chi-square "
        f"{face.chi_square:.3g} / {face.freedom}, {chance(face.p)}"
    )


def _errors(found: Verification) -> list[str]:
    """The error of all rows, of each face, of each region, and the noise that was taken off."""
    if found.overall is None:
        return []
    lines = [
        f"The arm's {found.measurand}, noise removed, RMS over postures of this kind: {_interval(found.overall)}. "
        "Brackets are 95 % intervals."
    ]
    for kind, name in (("face", "Face"), ("region", "Tip at")):
        parts = [part for part in found.errors if part.kind == kind]
        lines += [f"  {name} {part.label}: {counted(part.rows, 'row')}, {_interval(part)}" for part in parts[:SHOWN]]
        lines += [f"  {len(parts) - SHOWN} more with --json."] if len(parts) > SHOWN else []
    gross = ["The rows named above are included."] if found.gross_lines else []
    return [*lines, *gross, _noise(found)]


def _interval(part: PartError) -> str:
    after, before = (
        f"{in_two(each.mm)}{unit} ({in_two(each.low_mm)} to "
        + (f"{in_two(each.high_mm)})" if math.isfinite(each.high_mm) else "without bound)")
        for each, unit in ((part.after, " mm"), (part.before, ""))
    )
    promised = "" if math.isnan(part.promised_mm) else f", {in_two(part.promised_mm)} promised"
    return f"{after} as calibrated{promised}; {before} as drawn"


def _noise(found: Verification) -> str:
    """Sentence on the noise removed, and on whose error remains."""
    said = f"Noise removed: {figures(found.noise_mm)} mm"
    if found.noise_mm * WORTH_SAYING < found.noise_stated_mm:
        return f"{said}. The problem states {found.noise_stated_mm:.3g}, but the residuals are too small for that much."
    if found.noise_mm * WORTH_SAYING < found.noise_most_mm:
        return (
            f"{said}, as stated. The calibration found {found.noise_most_mm:.3g}; the rows cannot tell whether the "
            "difference is noise or the arm's error. The upper ends and acceptance count it as error, the lower ends "
            "and rejection as noise."
        )
    return f"{said}, as stated. If the true noise is smaller, the error is larger."


def _decision(found: Verification) -> list[str]:
    """The decision with its limits, its reservations, and what would settle it."""
    decision = found.decision
    if decision is None:
        return []
    hidden = "" if decision.measured_mm > 0 else " (the residuals are no larger than the noise)"
    size = f"{figures(decision.measured_mm)} mm RMS{hidden}"
    what = f"{size}, {found.measurand}, against a tolerance of {decision.tolerance_mm:g} mm"
    verdict, reserves = f"{VERDICTS[decision.verdict]}: {what}.", ""
    if decision.verdict == "accept":
        if found.denied or not found.kept:
            why = "the result must not be used" if found.kept else "the promise was not kept"
            verdict = f"Tolerance: {what}. That alone would be accepted, but {why}."
        if decision.rests_on_noise:
            noise = f"{figures(found.noise_mm)} mm"
            reserves += f" Acceptance depends on the noise of {noise}: without it the arm would not be accepted."
        if not found.accuracy:
            reserves += f" This decides on what these {found.things} see, not on the position of the tip."
        if found.overall is not None and found.overall.before.high_mm < decision.tolerance_mm:
            drawn = f"{figures(found.overall.before.mm)} mm"
            reserves += f" The arm as drawn ({drawn}) would be accepted as well. Is the tolerance in mm?"
    said = [f"{verdict} {_limits(decision)}{reserves}"]
    if decision.verdict == "undecided" and decision.hangs_on_gross:
        said.append("The decision depends on the rows named above: measure them again.")
    elif decision.verdict == "undecided" and decision.further_rows is None:
        said.append(
            "More rows alone would hardly settle it: the error is too near the tolerance, or the noise is too large."
        )
    elif decision.verdict == "undecided":
        said.append(
            f"About {counted(decision.further_rows or 0, 'more row')} like these would settle it in four cases of "
            "five, if the error is as measured here."
        )
    return said


def _limits(decision: Decision) -> str:
    lowest = (
        f"Too few rows or too much noise to accept anything (guard band: all of the {decision.tolerance_mm:g} mm)"
        if math.isnan(decision.accept_below_mm)
        else f"Accepted up to {figures(decision.accept_below_mm)} (guard band {figures(decision.guard_mm)} mm)"
    )
    p = decision.probability
    within = (
        f"more than {100 * CERTAIN:.2f} %" if p > CERTAIN else "less than 0.01 %" if p < 1e-4 else f"{100 * p:.3g} %"
    )
    return (
        f"Probability of being within tolerance: {within}. {lowest}, rejected from {figures(decision.reject_above_mm)} "
        "mm. An arm exactly at the tolerance is wrongly accepted, or wrongly rejected, with a chance of about "
        f"{100 * decision.risk:g} % at most (JCGM 106:2012, guarded)."
    )


def _vouches(found: Verification) -> str:
    """Sentence on the meaning of the residuals and on the directions that they leave open."""
    rows = f"These rows determine {found.seen} of the arm's {found.unknowns} unknown directions better than the priors"
    if found.accuracy:
        what = "These are errors of the tip itself where it was measured, apart from the position of the base"
        what += "." if not any(name.startswith("tool") for name in found.judged.own) else " and of the reflector."
    else:
        what = "Small residuals are not accuracy: these rows do not see every direction in which the arm can err."
    if found.denied or not found.kept or not found.promised_tip_mm:
        return f"{what} {rows}."
    if not math.isfinite(found.hidden_tip_mm):
        return f"{what} {rows}; a tip error of any size could remain unseen."
    return (
        f"{what} {rows}. Of the expected tip error of {mm(found.promised_tip_mm)} RMS, {mm(found.hidden_tip_mm)} could "
        "remain unseen."
    )


def _next(found: Verification) -> list[str]:
    """Next step where rows contradict the promise, by the pattern of their residuals."""
    if found.kept and (found.decision is None or found.decision.verdict != "reject"):
        return []
    bad = [face.label for face in found.faces if face.p < LEVEL / 2]
    if found.kept:
        said = (
            "calibrate with old and new rows, and with more touches where the residuals are largest. Then verify "
            "with fresh rows. Or ask for a tolerance that the calibration promises."
        )
    elif found.gross_lines and found.kept_without_gross:
        it = "this row" if len(found.gross_lines) == 1 else "these rows"
        said = f"measure {it} again; casacal check PROBLEM {found.judged.samples} looks closer at the rows."
    elif len(bad) == 1 and len(found.faces) > 1:
        its_own = any(f".{bad[0]}." in name for name in found.judged.own)
        when = "may have moved during the touches" if its_own else "has moved: leave it out of --standing"
        said = (
            f"only '{bad[0]}' does not agree. That face {when}; or something was different there, such as the "
            "zero of the dial. Touch it again, and verify again."
        )
    elif found.p >= LEVEL / 2:
        said = (
            "the rows agree with one another, but not with the arm as calibrated. An encoder zero, the tool or "
            "a part has changed since: casacal changed RESULT ROWS looks which. After a change, calibrate again with "
            "the new rows alone; otherwise with old and new rows."
        )
    else:
        said = (
            f"casacal check PROBLEM {found.judged.samples} looks for mistakes in these rows. Measure some of them "
            "again; if they read the same, calibrate again with old and new rows."
        )
    return [f"Next: {said}"]

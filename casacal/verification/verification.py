"""Test a calibration by fresh rows, without fitting the arm again; the report with the answer first, and a page."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from casacal.calibration.as_arm import AsArm
from casacal.calibration.fresh import Fresh, Judged, Opened, opened, with_memory
from casacal.data.samples import Samples
from casacal.deployment.arm import CalibratedArm, cautions
from casacal.errors import CasacalError, SamplesError
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.pages.drawing import fixed, rendered, shortened
from casacal.uncertainty.figures import rms
from casacal.uncertainty.fresh_rows import FreshRows, learnt
from casacal.uncertainty.fresh_rows import chance as chance_of
from casacal.uncertainty.identifiability import prior_scale
from casacal.uncertainty.tip_error import spread_rms, workspace_joints
from casacal.values import Array, Index, Value, is_real
from casacal.verification.arm_error import (
    LONGEST,
    RISK,
    Decision,
    PartError,
    boxes,
    decide,
    error_rows,
    errors_by_part,
    errors_picture,
    visible_error,
)
from casacal.wording import capital, chance, counted, figures, mm, numbered_lines
from casacal.wording import shortened as first_few
from casacal.wording import times as in_two

LEVEL = 0.05
"""Chance at which rows that are as promised are said not to be: two tests share it, of all residuals and of the arm."""
SHOWN = 12  # faces, or lines of rows, that are named one by one
CERTAIN = 0.9999  # probability beyond which nobody asks how near to one
VERDICTS = {"accept": "Accepted", "reject": "Rejected", "undecided": "Undecided"}
BEFORE = '<section id="measured"'  # where a section is put into another report
STANDING = re.compile(r'<section id="verified".*?</section>\n*', re.DOTALL)
REPORT = "report.html"
WORTH_SAYING = 1.05  # noise over noise beyond which a difference is worth saying
LEAST_RISK = 1e-4  # risk below which nobody knows the noise well enough


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
            guards = {name: getattr(self.decision, name) for name in ("guard_mm", "guard_of_rejection_mm")}
            rule = "JCGM 106:2012, guarded acceptance and guarded rejection"
            instead["decision"] = {**asdict(self.decision), **guards, "rule": rule}
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
        said, p = "kept" if self.kept else "not kept", min(self.p, self.arm_p)
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
        *(
            f"  {face.label}: {counted(face.rows, 'row')}, {in_two(face.after_mm)} {found.unit} RMS, "
            f"{in_two(face.predicted_mm)} predicted (as drawn: {in_two(face.before_mm)}); chi-square "
            f"{face.chi_square:.3g} / {face.freedom}, {chance(face.p)}"
            for face in found.faces[:SHOWN]
        ),
        *([f"{len(found.faces) - SHOWN} more faces with --json."] if len(found.faces) > SHOWN else []),
    ]
    gross = []
    if found.gross_lines:
        fit, it = ("does not fit", "it") if len(found.gross_lines) == 1 else ("do not fit", "them")
        kept = "is kept" if found.kept_without_gross else "is not kept either"
        lines = f"{capital(numbered_lines(found.gross_lines))} of {found.judged.samples}"
        gross = [f"{lines} {fit} the other rows: measure {it} again. Without {it} the promise {kept}."]
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


def _errors(found: Verification) -> list[str]:
    """The error of all rows, of each face, of each region, and the noise that was taken off."""
    if found.overall is None:
        return []
    said = f"noise removed, RMS over postures of this kind: {_interval(found.overall)}"
    lines = [f"The arm's {found.measurand}, {said}. Brackets are 95 % intervals."]
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
    if (decision := found.decision) is None:
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
        why = "the error is too near the tolerance, or the noise is too large"
        said.append(f"More rows alone would hardly settle it: {why}.")
    elif decision.verdict == "undecided":
        rows = counted(decision.further_rows or 0, "more row")
        said.append(f"About {rows} like these would settle it in four cases of five, if the error is as measured here.")
    return said


def _limits(decision: Decision) -> str:
    lowest = f"Accepted up to {figures(decision.accept_below_mm)} (guard band {figures(decision.guard_mm)} mm)"
    if math.isnan(decision.accept_below_mm):
        guard = f"guard band: all of the {decision.tolerance_mm:g} mm"
        lowest = f"Too few rows or too much noise to accept anything ({guard})"
    p = decision.probability
    within = "less than 0.01 %" if p < 1e-4 else f"{100 * p:.3g} %"
    within = f"more than {100 * CERTAIN:.2f} %" if p > CERTAIN else within
    return (
        f"Probability of being within tolerance: {within}. {lowest}, rejected from {figures(decision.reject_above_mm)} "
        "mm. An arm exactly at the tolerance is wrongly accepted, or wrongly rejected, with a chance of about "
        f"{100 * decision.risk:g} % at most (JCGM 106:2012, guarded)."
    )


def _vouches(found: Verification) -> str:
    """Sentence on the meaning of the residuals and on the directions that they leave open."""
    what = "Small residuals are not accuracy: these rows do not see every direction in which the arm can err."
    if found.accuracy:
        reflector = " and of the reflector" if any(name.startswith("tool") for name in found.judged.own) else ""
        what = "These are errors of the tip itself where it was measured, apart from the pose of the base"
        what = f"{what}{reflector}."
    said = f"{what} These rows determine {found.seen} of the arm's {found.unknowns} unknown directions better than "
    if found.denied or not found.kept or not found.promised_tip_mm:
        return f"{said}the priors."
    if not math.isfinite(found.hidden_tip_mm):
        return f"{said}the priors; a tip error of any size could remain unseen."
    hidden = f"{mm(found.promised_tip_mm)} RMS, {mm(found.hidden_tip_mm)} could remain unseen"
    return f"{said}the priors. Of the expected tip error of {hidden}."


def _next(found: Verification) -> list[str]:
    """Next step where rows contradict the promise, by the pattern of their residuals."""
    if found.kept and (found.decision is None or found.decision.verdict != "reject"):
        return []
    bad = [face.label for face in found.faces if face.p < LEVEL / 2]
    if found.kept:
        said = "calibrate with old and new rows, and with more touches where the residuals are largest. Then verify "
        said += "with fresh rows. Or ask for a tolerance that the calibration promises."
    elif found.gross_lines and found.kept_without_gross:
        it = "this row" if len(found.gross_lines) == 1 else "these rows"
        said = f"measure {it} again; casacal check PROBLEM {found.judged.typed} looks closer at the rows."
    elif len(bad) == 1 and len(found.faces) > 1:
        its_own = any(f".{bad[0]}." in name for name in found.judged.own)
        when = "may have moved during the touches" if its_own else "has moved: leave it out of --standing"
        said = f"only '{bad[0]}' does not agree. That face {when}; or something was different there, such as the "
        said += "zero of the dial. Touch it again, and verify again."
    elif found.p >= LEVEL / 2:
        said = "the rows agree with one another, but not with the arm as calibrated. An encoder zero, the tool or "
        said += "a part has changed since: casacal changed RESULT ROWS looks which. After a change, calibrate again "
        said += "with the new rows alone; otherwise with old and new rows."
    else:
        said = f"casacal check PROBLEM {found.judged.typed} looks for mistakes in these rows. Measure some of them "
        said += "again; if they read the same, calibrate again with old and new rows."
    return [f"Next: {said}"]


def verify(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    problem: Problem | ProblemFile | str | Path | None = None,
    instrument: str | None = None,
    standing: Collection[str] = (),
    tolerance: float | None = None,
    risk: float = RISK,
) -> Verification:
    """Judge a calibration by rows that it has not seen; the arm is not fitted again.

    Only what the rows alone know is fitted to them: where the faces or the tracker stand, and the tool of another
    instrument. What is left is compared with its predicted covariance: of what the calibration may err by, from the
    posterior in result.json, and of the noise as the calibration used it. The sum of squares is chi-square with rows
    less fitted unknowns degrees of freedom (F where the calibration itself found the noise), and the promise is kept
    unless it is larger than 95 % of those of a good arm. Rows that were pasted again count once, and
    rows that the arm was calibrated from do not count.

    Args:
        result: a calibration, what `load` or `read_result` returns, or the path of a result.json or its folder.
        samples: fresh rows: `Samples`, a file, a pandas DataFrame, or arrays by column.
        problem: the same arm with the instrument of these rows, where it is not that of the calibration: a `Problem`,
            what `load_problem` returns, or a path.
        instrument: which of the calibration's instruments, or of those of `problem`, took these rows, where there are
            several; by default the one of the calibration whose columns they have.
        standing: labels of faces ("floor") or unknowns ("plane", "tool") that stand where the calibration found them,
            and so are not fitted again.
        tolerance: largest RMS error, mm, that the arm may have in what this instrument sees: accepted, rejected or left
            undecided by JCGM 106:2012.
        risk: chance of a wrong decision of an arm whose error is the tolerance, below one half.

    Returns:
        What was found; residuals in mm.

    Raises CasacalError for what is no result, another arm, or a tolerance or risk that is none; UnknownNameError for
    something else standing; SamplesError for rows that do not fit, are too few, or half of which are those of the
    calibration; ProblemError for rows without the columns that tell an effect.

    """
    if tolerance is not None and not (is_real(tolerance) and 0 < tolerance < math.inf):
        raise CasacalError(f"The tolerance is {tolerance!r}", "Give a positive number of mm")
    if not (is_real(risk) and LEAST_RISK <= risk < 0.5):
        fix = f"Give a chance from {LEAST_RISK:g} to below 0.5, such as 0.05 for 5 %"
        raise CasacalError(f"The risk is {risk!r}", fix)
    case = opened(result, samples, problem=problem, instrument=instrument, standing=standing)
    unit = case.source.problem.instrument.words.unit
    if tolerance is not None and unit != "mm":
        raise CasacalError(f"The tolerance is in mm, but the residuals are in {unit}", "Leave it out")
    return _judged(case, tuple(standing), None if tolerance is None else float(tolerance), float(risk))


def _judged(case: Opened, standing: tuple[str, ...], tolerance: float | None, risk: float) -> Verification:
    """All figures of a verification."""
    anew, freedom, words = case.fresh(standing), case.noise_freedom, case.source.problem.instrument.words
    memory, lasting = with_memory(anew, case.arm), {term.key for term in anew.bound.problem.terms if term.lasting}
    # of geometry and effects together it is known where they are, and the arm as it is used is elsewhere
    at = np.where([key in lasting for key in anew.bound.beside], memory.at, anew.at)
    away = (memory.at - at)[anew.known]
    fresh = replace(anew, at=at, covariance=memory.covariance + np.outer(away, away))
    bound, rows, arm = fresh.bound, fresh.linear, fresh.of_arm
    # slopes by the arm's unknowns, in units of their priors (1 mm, 1 mrad if flat); priors of own unknowns have none
    scaled = np.zeros((len(rows.residual), arm.size))
    scaled[: bound.rows] = fresh.jacobian[:, arm] * prior_scale(bound)[arm]
    per_row = bound.rows // len(case.rows)
    off = np.array([k for k in rows.gross() if k < bound.rows], dtype=np.intp)
    kept = np.setdiff1d(np.arange(len(rows.residual)), off)
    p, arm_chi, directions, arm_p = _chances(rows, scaled, freedom)
    without, _, _, arm_without = _chances(rows.take(kept), scaled[kept], freedom)
    drawn, visible = fresh.fitted(np.where(fresh.known, 0.0, fresh.at)), visible_error(case.arm, fresh)
    sizes = [_lengths(bound.plain_residual(x), per_row) for x in (drawn, fresh.x)]
    sizes.append(_lengths(rows.std[: bound.rows] * bound.noise, per_row))
    noise, most, stated = visible.noises_mm()
    promised, hidden = _tips(fresh)
    judged = case.judged(fresh, standing)
    # fresh rows of the same instrument fit a mirror image as well
    known = [words for words in cautions(case.arm) if words != case.arm.caution]  # which the verdict says
    return Verification(
        replace(judged, remarks=(*judged.remarks, *known)),
        before_mm=rms(sizes[0]),
        after_mm=rms(sizes[1]),
        predicted_mm=rms(sizes[2]),
        chi_square=rows.chi_square,
        freedom=rows.freedom,
        p=p,
        seen=directions,
        arm_chi_square=arm_chi,
        arm_p=arm_p,
        faces=_faces(fresh, sizes, freedom),
        gross_lines=tuple(sorted({int(case.rows.lines[k // per_row]) for k in off.tolist()})),
        kept_without_gross=min(without, arm_without) >= LEVEL / 2,
        quantile_mm=float(np.quantile(sizes[1], 0.95, method="inverted_cdf")),
        errors=errors_by_part(visible, drawn) if words.unit == "mm" else (),
        decision=None if tolerance is None else _decided(case.arm, fresh, off, tolerance, risk),
        noise_mm=noise,
        noise_most_mm=most,
        noise_stated_mm=stated,
        unknowns=arm.size,
        promised_tip_mm=promised,
        hidden_tip_mm=hidden,
        accuracy=words.accuracy,
        things=words.things,
        sees=words.residual,
        unit=words.unit,
    )


def _chances(rows: FreshRows, scaled: Array, noise: float) -> tuple[float, float, int, float]:
    """Chance of all residuals; chi-square in the arm's directions alone, its freedom and its chance."""
    arm, directions = rows.toward(scaled)
    return chance_of(rows.chi_square, rows.freedom, noise), arm, directions, chance_of(arm, directions, noise)


def _decided(arm: CalibratedArm, fresh: Fresh, off: Index, tolerance: float, risk: float) -> Decision:
    """The decision by all rows; undecided where it hangs on those that are gross."""
    found = []
    for without in (None, off) if off.size else (None,):
        visible = visible_error(arm, fresh, without)
        if (scatter := visible.scatter(visible.residual(fresh.x))) is None:
            what = "the unknowns fitted to these rows absorb any error of the arm, so no tolerance can be tested"
            raise SamplesError(fresh.bound.block.samples.file, what, "Take more rows, or leave the tolerance out")
        found.append(decide(scatter, visible.effective_rows(), tolerance, risk))
    if found[-1].verdict == found[0].verdict:
        return found[0]
    return replace(found[0], verdict="undecided", further_rows=None, hangs_on_gross=True)


def _lengths(values: Array, per_row: int) -> Array:
    """Norm (N,) of the `per_row` values of each row, from values (N per_row,): an error of three axes counts once."""
    return np.asarray(np.linalg.norm(values.reshape(-1, per_row), axis=1))


def _faces(fresh: Fresh, sizes: list[Array], noise: float) -> tuple[FaceVerification, ...]:
    """Each face by itself, in the order of the rows; none where there is only one."""
    bound, found = fresh.bound, []
    labels = bound.block.samples.faces(bound.problem.instrument.groups)
    for label, rows in labels.rows().items() if len(labels.names) > 1 else ():
        one = fresh.some(bound.residuals_of(rows))
        drawn, here, promised = (rms(each[rows]) for each in sizes)
        p = chance_of(one.chi_square, one.freedom, noise)
        found.append(FaceVerification(label, len(rows), drawn, here, promised, one.chi_square, one.freedom, p))
    return tuple(found)


def _tips(fresh: Fresh) -> tuple[float, float]:
    """Expected tip error, mm RMS: by the calibration, and by its posterior after these rows as well."""
    joints = workspace_joints(fresh.bound.problem.robot)
    tips, slopes = fresh.bound.tips(fresh.x, joints), fresh.bound.tip_jacobian(fresh.x, joints)
    by_known, there = slopes[:, fresh.known], np.flatnonzero(~fresh.lost)
    after, own = fresh.covariance.copy(), fresh.linear.own
    slopes = np.zeros((len(own), there.size))
    slopes[: fresh.bound.rows] = fresh.jacobian[:, np.flatnonzero(fresh.known)[there]]
    after[np.ix_(there, there)] = learnt(fresh.covariance[np.ix_(there, there)], slopes, own)
    return spread_rms(fresh.covariance, by_known, tips), spread_rms(after, by_known, tips)


def with_section(path: Path, arm: CalibratedArm, section: str) -> str:
    """The text of a calibration's report with the section of a verification.

    arm: the result that the report is of. Raises CasacalError where there is no such report, or it is of
    another calibration.
    """
    fix = "Write a separate page: --report FILE"
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise CasacalError(f"There is no report '{path}' to write into", fix) from None
    marks = ["<title>Calibration of", arm.source.sha256, arm.found.data.sha256]
    if text.count(BEFORE) != 1 or not all(mark in text for mark in marks):
        raise CasacalError(f"'{path}' is not the report of this result", fix)
    return STANDING.sub("", text).replace(BEFORE, f"{section.strip()}\n{BEFORE}")

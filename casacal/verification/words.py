"""A verification in words: the answer first, then the figures, then what the rows cannot vouch for."""

from __future__ import annotations

import math

from casacal.verification.figures import LEVEL, FaceVerification, Figures
from casacal.verification.words_of_error import decision_told, errors_told
from casacal.wording import capital, chance, counted, mm, numbered_lines, shortened

SHOWN = 12
"""Faces, or lines of rows, that are named."""


def told(found: Figures) -> list[str]:
    """Paragraphs, the answer first."""
    return [
        _answer(found),
        *_own_verdict(found),
        *found.left_out,
        _residuals(found),
        _statistic(found),
        *(_face(found, face) for face in found.faces[:SHOWN]),
        *([f"{len(found.faces) - SHOWN} more faces with --json."] if len(found.faces) > SHOWN else []),
        *_gross(found),
        *errors_told(found),
        *decision_told(found),
        _vouches(found),
        *_next(found),
    ]


def _answer(found: Figures) -> str:
    said = f"{counted(found.rows, 'fresh row')} of {found.samples}"
    if not found.kept:
        if found.p < LEVEL / 2:
            times = f"{math.sqrt(found.chi_square / max(found.freedom, 1)):.3g} times what was predicted"
            return f"Promise not kept: the residuals of {said} are {times} ({chance(found.p)})."
        return f"Promise not kept: {said} do not agree with the arm as calibrated ({chance(found.arm_p)})."
    decided = {"accept": ", and accepted", "reject": ", but rejected", "undecided": ", but undecided"}
    verdict = "" if found.decision is None else decided[found.decision.verdict]
    verdict = ", but the result must not be used" if found.decision is not None and found.denied else verdict
    return f"Promise kept{verdict}: {said} agree with the calibration of {found.robot}."


def _own_verdict(found: Figures) -> list[str]:
    level, words = found.verdict
    if level in ("", "calibrated"):
        return []
    return [f"The result's own verdict: {words}"]


def _residuals(found: Figures) -> str:
    what = "Error of the tip, all three axes" if found.accuracy else f"Residual on these {found.things}"
    return (
        f"{what}: {found.after_mm:.4f} {found.unit} RMS as calibrated, {found.predicted_mm:.4f} predicted, "
        f"{found.before_mm:.4f} as drawn; 95 % of the rows are within {found.quantile_mm:.4f}."
    )


def _statistic(found: Figures) -> str:
    own = counted(len(found.own), "unknown")
    fitted = f"{own} fitted to these rows ({shortened(found.own, 4)})" if found.own else "nothing fitted to these rows"
    still = f"; assumed not to have moved: {', '.join(found.standing)}" if found.standing else ""
    return (
        f"Chi-square {found.chi_square:.1f} with {found.freedom} degrees of freedom, {chance(found.p)}; of the "
        f"arm alone {found.arm_chi_square:.1f} with {found.seen}, {chance(found.arm_p)}. The promise is kept if both p "
        f"are at least {LEVEL / 2:g}. The arm was not fitted; {fitted}{still}."
    )


def _face(found: Figures, face: FaceVerification) -> str:
    return (
        f"  {face.label}: {counted(face.rows, 'row')}, {face.after_mm:.4f} {found.unit} RMS, {face.predicted_mm:.4f} "
        f"predicted (as drawn: {face.before_mm:.4f}); chi-square {face.chi_square:.1f} / {face.freedom}, "
        f"{chance(face.p)}"
    )


def _gross(found: Figures) -> list[str]:
    lines = found.gross_lines
    if not lines:
        return []
    fit = "does not fit" if len(lines) == 1 else "do not fit"
    without = "it" if len(lines) == 1 else "them"
    kept = "is kept" if found.kept_without_gross else "is not kept either"
    return [
        f"{capital(numbered_lines(lines))} of {found.samples} {fit} the other rows: measure {without} again. Without "
        f"{without} the promise {kept}."
    ]


def _vouches(found: Figures) -> str:
    """What residuals mean, and what they leave open."""
    seen = f"These rows determine {found.seen} of the arm's {found.unknowns} unknown directions better than the priors"
    if found.accuracy:
        what = "These are errors of the tip itself where it was measured, apart from the position of the base"
        what += "." if not any(name.startswith("tool") for name in found.own) else " and of the reflector."
    else:
        what = "Small residuals are not accuracy: these rows do not see every direction in which the arm can err."
    if found.denied or not found.kept or not found.promised_tip_mm:
        return f"{what} {seen}."
    if not math.isfinite(found.hidden_tip_mm):
        return f"{what} {seen}; a tip error of any size could remain unseen."
    return (
        f"{what} {seen}. Of the expected tip error of {mm(found.promised_tip_mm)} RMS, {mm(found.hidden_tip_mm)} could "
        "remain unseen."
    )


def _next(found: Figures) -> list[str]:
    """What to do where the rows are not as promised, by what is seen of them."""
    if found.kept and (found.decision is None or found.decision.verdict != "reject"):
        return []
    if found.kept:
        return [
            "Next: calibrate with old and new rows, and with more touches where the residuals are largest. Then verify "
            "with fresh rows. Or ask for a tolerance that the calibration promises."
        ]
    if found.gross_lines and found.kept_without_gross:
        it = "this row" if len(found.gross_lines) == 1 else "these rows"
        return [f"Next: measure {it} again; casacal check PROBLEM {found.samples} looks closer at the rows."]
    bad = [face for face in found.faces if face.p < LEVEL / 2]
    others = [face for face in found.faces if face.p >= LEVEL / 2]
    if len(bad) == 1 and others:
        face = bad[0].label
        its_own = any(f".{face}." in name for name in found.own)
        when = "may have moved during the touches" if its_own else "has moved: leave it out of --standing"
        return [
            f"Next: only '{face}' does not agree. That face {when}; or something was different there, such as the "
            "zero of the dial. Touch it again, and verify again."
        ]
    if found.p >= LEVEL / 2:
        return [
            "Next: the rows agree with one another, but not with the arm as calibrated. An encoder zero, the tool or "
            "a part has changed since: casacal changed RESULT ROWS looks which. After a change, calibrate again with "
            "the new rows alone; otherwise with old and new rows."
        ]
    return [
        f"Next: casacal check PROBLEM {found.samples} looks for mistakes in these rows. Measure some of them again; "
        "if they read the same, calibrate again with old and new rows."
    ]

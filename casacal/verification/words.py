"""A verification in words: the answer first, then the figures, then what the rows cannot vouch for."""

from __future__ import annotations

import math
from collections.abc import Sequence

from casacal.errors import counted
from casacal.verification.figures import LEVEL, FaceVerification, Figures
from casacal.verification.words_of_error import decision_told, errors_told

LEAST = 1e-6
"""Chance below which nobody asks how small."""

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
            return f"Not kept: the residuals of {said} are {times}, which is hardly chance ({_chance(found.p)})."
        return (
            f"Not kept: {said} lie where an arm other than the calibrated one would put them, which is hardly chance "
            f"({_chance(found.arm_p)})."
        )
    decided = {"accept": ", and accepted", "reject": ", but rejected", "undecided": ", but undecided"}
    verdict = "" if found.decision is None else decided[found.decision.verdict]
    verdict = ", but not to be used" if found.decision is not None and found.denied else verdict
    return f"Kept{verdict}: {said} lie as the calibration of {found.robot} promised."


def _chance(p: float) -> str:
    return f"p = {p:.2g}" if p >= LEAST else f"p < {LEAST:g}"


def _own_verdict(found: Figures) -> list[str]:
    level, words = found.verdict
    if level in ("", "calibrated"):
        return []
    return [f"The result's own verdict: {words}"]


def _residuals(found: Figures) -> str:
    what = "Error of the tip, all three axes" if found.accuracy else f"Residual on these {found.things}"
    return (
        f"{what}: {found.after_mm:.4f} {found.unit} RMS as calibrated, {found.predicted_mm:.4f} predicted (as drawn: "
        f"{found.before_mm:.4f}); 95 % of the rows within {found.quantile_mm:.4f}."
    )


def _statistic(found: Figures) -> str:
    own = counted(len(found.own), "unknown")
    fitted = f"{own} fitted to these rows ({_named(found.own, 4)})" if found.own else "nothing fitted to these rows"
    still = f"; taken to stand where calibrated: {', '.join(found.standing)}" if found.standing else ""
    return (
        f"Chi-square {found.chi_square:.1f} with {found.freedom} degrees of freedom, {_chance(found.p)}; of it "
        f"{found.arm_chi_square:.1f} with {found.seen} in what they say of the arm, {_chance(found.arm_p)}. Kept where "
        f"both are {LEVEL / 2:g} or more. The arm was not fitted; {fitted}{still}."
    )


def _face(found: Figures, face: FaceVerification) -> str:
    return (
        f"  {face.label}: {counted(face.rows, 'row')}, {face.after_mm:.4f} {found.unit} RMS, {face.predicted_mm:.4f} "
        f"predicted (as drawn: {face.before_mm:.4f}); chi-square {face.chi_square:.1f} / {face.freedom}, "
        f"{_chance(face.p)}"
    )


def _gross(found: Figures) -> list[str]:
    lines = found.gross_lines
    if not lines:
        return []
    where = f"{'Line' if len(lines) == 1 else 'Lines'} {_named([str(line) for line in lines], SHOWN)}"
    lies = "lies" if len(lines) == 1 else "lie"
    without = "it" if len(lines) == 1 else "them"
    kept = "is kept" if found.kept_without_gross else "is not kept either"
    return [
        f"{where} of {found.samples} {lies} where no other row expects {without}: measure there again. Without "
        f"{without} the promise {kept}."
    ]


def _vouches(found: Figures) -> str:
    """What residuals mean, and what they leave open."""
    seen = f"These rows see {found.seen} of the arm's {found.unknowns} unknown directions better than its priors do"
    if found.accuracy:
        what = "These are errors of the tip, and so accuracy where it was watched, apart from where the base stands"
        what += "." if not any(name.startswith("tool") for name in found.own) else " and the reflector sits."
    else:
        what = "Small residuals are not accuracy: they say nothing of directions that these rows do not see."
    if found.denied or not found.kept or not found.promised_tip_mm:
        return f"{what} {seen}."
    if not math.isfinite(found.hidden_tip_mm):
        return f"{what} {seen}, and a tip error without bound could hide from them."
    return (
        f"{what} {seen}; of the {found.promised_tip_mm:.3f} mm RMS that the calibration expects of the arm, "
        f"{found.hidden_tip_mm:.3f} mm could hide from them."
    )


def _next(found: Figures) -> list[str]:
    """What to do where the rows are not as promised, by what is seen of them."""
    if found.kept and (found.decision is None or found.decision.verdict != "reject"):
        return []
    if found.kept:
        return [
            "Next: calibrate with the old rows and these together, and with touches where these lie worst; then verify "
            "with fresh ones, or ask for a tolerance that the calibration promises."
        ]
    if found.gross_lines and found.kept_without_gross:
        it = "this row" if len(found.gross_lines) == 1 else "these rows"
        return [f"Next: measure {it} again; casacal check PROBLEM {found.samples} says more of them."]
    bad = [face for face in found.faces if face.p < LEVEL / 2]
    others = [face for face in found.faces if face.p >= LEVEL / 2]
    if len(bad) == 1 and others:
        face = bad[0].label
        its_own = any(f".{face}." in name for name in found.own)
        when = "may have moved while it was touched" if its_own else "has moved, so leave it out of --standing"
        return [
            f"Next: only '{face}' lies otherwise than promised: that face {when}; or something was done otherwise "
            "there, such as the dial's zero. Touch it again, and verify again."
        ]
    if found.p >= LEVEL / 2:
        return [
            "Next: the rows fit one another, and another arm than the calibrated one: a joint's zero, the tool or a "
            "part has changed since. See what was done to the arm; then calibrate again with old and new rows where it "
            "is the same arm, with new rows alone where it is not."
        ]
    return [
        f"Next: casacal check PROBLEM {found.samples} looks for mistakes in these rows; measure some of them again, "
        "and where they read the same, calibrate again with old and new rows."
    ]


def _named(names: Sequence[str], most: int) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more

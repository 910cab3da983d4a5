"""The arm's error in words: before and after by face and region, what noise was taken off, and the decision."""

from __future__ import annotations

import math

from casacal.verification.decision import Decision
from casacal.verification.figures import Figures, PartError
from casacal.wording import counted

SHOWN = 12
"""Faces that are told one by one."""

CERTAIN = 0.9999
"""Probability beyond which nobody asks how near to one."""

WORTH_SAYING = 1.05
"""Noise over noise beyond which a difference is worth saying."""


def measurand(found: Figures) -> str:
    """What the error is of, and that it is no more than that."""
    if found.accuracy:
        return "error of the tip, all three axes, where it was measured"
    return f"error as seen by these {found.things}" + (f" ({found.sees})" if found.sees != "residual" else "")


def errors_told(found: Figures) -> list[str]:
    """The error of all rows, of each face, of each region, and the noise that was taken off."""
    if found.overall is None:
        return []
    said = measurand(found)
    lines = [
        f"The arm's {said}, noise removed, RMS over postures of this kind: {_interval(found.overall)}. Brackets are "
        "95 % intervals."
    ]
    for kind, name in (("face", "Face"), ("region", "Tip at")):
        parts = [part for part in found.errors if part.kind == kind]
        lines += [f"  {name} {part.label}: {counted(part.rows, 'row')}, {_interval(part)}" for part in parts[:SHOWN]]
        lines += [f"  {len(parts) - SHOWN} more with --json."] if len(parts) > SHOWN else []
    gross = ["The rows named above are included."] if found.gross_lines else []
    return [*lines, *gross, _noise(found)]


def _interval(part: PartError) -> str:
    after, before = part.after, part.before
    promised = "" if math.isnan(part.promised_mm) else f", {part.promised_mm:.4f} promised"
    return (
        f"{after.mm:.4f} mm ({after.low_mm:.4f} to {_upper(after.high_mm)}) as calibrated{promised}; {before.mm:.4f} "
        f"({before.low_mm:.4f} to {_upper(before.high_mm)}) as drawn"
    )


def _upper(value: float) -> str:
    return f"{value:.4f}" if math.isfinite(value) else "without bound"


def _noise(found: Figures) -> str:
    """What was taken off as noise, and whose error the rest is."""
    said = f"Noise removed: {found.noise_mm:.4f} mm"
    if found.noise_mm * WORTH_SAYING < found.noise_stated_mm:
        return f"{said}. The problem states {found.noise_stated_mm:.4f}, but the residuals are too small for that much."
    if found.noise_mm * WORTH_SAYING < found.noise_most_mm:
        return (
            f"{said}, as stated. The calibration found {found.noise_most_mm:.4f}; the rows cannot tell whether the "
            "difference is noise or the arm's error. The upper ends and acceptance count it as error, the lower ends "
            "and rejection as noise."
        )
    return f"{said}, as stated. If the true noise is smaller, the error is larger."


def decision_told(found: Figures) -> list[str]:
    """The decision with its limits, and what it is not a decision of."""
    decision = found.decision
    if decision is None:
        return []
    part, drawn = found.overall, ""
    if decision.verdict == "accept" and part is not None and part.before.high_mm < decision.tolerance_mm:
        drawn = f" The arm as drawn ({part.before.mm:.4f} mm) would be accepted as well. Is the tolerance in mm?"
    said = f"{_verdict(found, decision)} {_limits(decision)}{_nothing_else(found, decision)}{drawn}"
    return [said, *_more(decision)]


def _verdict(found: Figures, decision: Decision) -> str:
    hidden = "" if decision.measured_mm > 0 else " (the residuals are no larger than the noise)"
    size = f"{decision.measured_mm:.4f} mm RMS{hidden}"
    what = f"{size}, {measurand(found)}, against a tolerance of {decision.tolerance_mm:g} mm"
    if decision.verdict == "accept":
        if not found.kept:
            return f"Tolerance: {what}. That alone would be accepted, but the promise was not kept."
        if found.denied:
            return f"Tolerance: {what}. That alone would be accepted, but the result must not be used."
        return f"Accepted: {what}."
    return f"{'Rejected' if decision.verdict == 'reject' else 'Undecided'}: {what}."


def _limits(decision: Decision) -> str:
    risk = f"{100 * decision.risk:g} %"
    lowest = (
        f"Too few rows or too much noise to accept anything (guard band: all of the {decision.tolerance_mm:g} mm)"
        if math.isnan(decision.accept_below_mm)
        else f"Accepted up to {decision.accept_below_mm:.4f} (guard band {decision.guard_mm:.4f} mm)"
    )
    return (
        f"Probability of being within tolerance: {_probability(decision.probability)}. {lowest}, rejected from "
        f"{decision.reject_above_mm:.4f} mm. An arm exactly at the tolerance is wrongly accepted, or wrongly rejected, "
        f"with a chance of about {risk} at most (JCGM 106:2012, guarded)."
    )


def _probability(p: float) -> str:
    return f"more than {100 * CERTAIN:.2f} %" if p > CERTAIN else "less than 0.01 %" if p < 1e-4 else f"{100 * p:.3g} %"


def _nothing_else(found: Figures, decision: Decision) -> str:
    if decision.verdict != "accept":
        return ""
    noise = f" Acceptance depends on the noise of {found.noise_mm:.4f} mm: without it the arm would not be accepted."
    said = noise if decision.rests_on_noise else ""
    return (
        said
        if found.accuracy
        else f"{said} This decides on what these {found.things} see, not on the position of the tip."
    )


def _more(decision: Decision) -> list[str]:
    """What would settle it."""
    if decision.verdict != "undecided":
        return []
    if decision.hangs_on_gross:
        return ["The decision depends on the rows named above: measure them again."]
    if decision.further_rows is None:
        return [
            "More rows alone would hardly settle it: the error is too near the tolerance, or the noise is too large."
        ]
    return [
        f"About {counted(decision.further_rows, 'more row')} like these would settle it in four cases of five, if the "
        "error is as measured here."
    ]

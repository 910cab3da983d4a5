"""What to do next with a result: the step that the verdict calls for, and the cheapest cure of what stays unseen."""

from __future__ import annotations

import math

from casacal.calibration.calibration import MINIMISERS, NOT_NEEDED, Calibration
from casacal.calibration.verdict import Verdict, wrong_with_samples
from casacal.uncertainty.identifiability import NullDirection, WeakDirection


def next_step(
    calibration: Calibration, verdict: Verdict, *, about: str = "PROBLEM SAMPLES", out: str | None = None
) -> str:
    """One sentence.

    Args:
        calibration: what was found.
        verdict: on it.
        about: problem and samples, as a command line names them.
        out: folder with the result's files; None when it was not kept.

    """
    check = f"casacal check {about}"
    if verdict.level == "do not use":
        return _repair(calibration, check)
    if verdict.level == "use with care":
        kept = "" if out is not None else "; --out DIR keeps the result and its report"
        return f"settle the doubt; {check} looks closer at the samples{kept}."
    if out is None:
        return "--out DIR keeps the result and its report, for casacal compensate, predict and export."
    return f"casacal compensate {out}/result.json TARGETS --out FILE corrects joint targets."


def best_cure(calibration: Calibration) -> str:
    """What would let the samples see the costliest direction that has a cure, as a sentence; empty without one."""
    found = calibration.identifiability
    directions: tuple[NullDirection | WeakDirection, ...] = (*found.null, *found.weak)
    cured = [
        (direction.tip_mm, cure)
        for direction, cure in zip(directions, calibration.advice, strict=True)
        if cure != NOT_NEEDED and not cure.endswith("rely on the prior")
    ]
    if not cured:
        return ""
    size, cure = max(cured, key=lambda entry: entry[0])
    if not math.isfinite(size):
        return f"{cure}."
    return f"{cure}; without it a tip error of {size:.2g} mm stays possible."


def _repair(calibration: Calibration, check: str) -> str:
    reference = calibration.reference
    wrong = wrong_with_samples(calibration)
    if wrong:
        return f"{wrong[0].fix[:1].lower()}{wrong[0].fix[1:]}; then {check}."
    if not calibration.result.converged:
        return f"{check} looks at the samples; --method lm is another way to the minimum."
    if reference is not None and not reference.agrees:
        if calibration.method in MINIMISERS:
            return f"{check}; then compare the costs of --method lm and --method ipopt, and keep the lower one."
        return "--method lm or sckf-lm, which go to the minimum."
    if math.isfinite(calibration.tip_std[1]):
        return f"{check} looks at the samples."
    cure = best_cure(calibration)
    return cure or "give every parameter a prior, or hold it with --fix."

"""What to do next with a result: the step that the verdict calls for, and what would lower the tip error most."""

from __future__ import annotations

import math

from casacal.calibration.calibration import Calibration
from casacal.calibration.fitted import MINIMISERS
from casacal.calibration.verdict import Verdict, wrong_with_samples
from casacal.calibration.warnings import VERIFY, doubts, suspicious
from casacal.planning.cures import Cure


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
        return _repair(calibration.unjudged, check)
    if verdict.level == "use with care":
        kept = "" if out is not None else "; --out DIR keeps the result and its report"
        step = next((doubt.step for doubt in doubts(calibration)[:1]), "")
        asked = suspicious(calibration)  # the data check, which named nothing, or the result would be denied
        if step or asked:
            return f"settle the doubt: {step or VERIFY}{kept}."
        return f"settle the doubt; {check} looks closer at the samples{kept}."
    if out is None:
        return "--out DIR keeps the result and its report, for casacal compensate, predict and export."
    return f"casacal compensate {out}/result.json TARGETS --out FILE corrects joint targets."


def best_cure(calibration: Calibration) -> str:
    """The best cure and its figure, as a sentence; empty where none gains much. Not for who must not use the result."""
    cure = _best(calibration)
    if cure is None:
        return ""
    return f"{cure.words}: expected tip error {fall(calibration.tip_std[1], cure.expected_rms_mm)}."


def nothing_helps(calibration: Calibration) -> str:
    """That no cure gains much, as a sentence; empty where one does, or none is known."""
    if not calibration.cures or _best(calibration) is not None:
        return ""
    least = calibration.cures[0].expected_rms_mm
    return f"No cure that was tried helps much: expected tip error {fall(calibration.tip_std[1], least)} at best."


def fall(now: float, after: float) -> str:
    """Two tip errors, with as many digits as tell them apart."""
    digits = 2 if now >= 0.1 and after >= 0.02 and round(now, 2) > round(after, 2) else 3
    return f"{now:.{digits}f} -> {after:.{digits}f} mm"


def _best(calibration: Calibration) -> Cure | None:
    """The first of the cures that are worth it and bound the tip error."""
    worth = (cure for cure in calibration.cures if cure.recommended and math.isfinite(cure.expected_rms_mm))
    return next(worth, None)


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
    cure = _best(calibration)
    return f"{cure.words}." if cure is not None else "give every parameter a prior, or hold it with --fix."

"""A calibration in a few lines: what came out, why it is doubted, and the next step."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Sequence

from casacal.calibration.calibration import Calibration
from casacal.calibration.motion import tip_error
from casacal.calibration.result_json import image_words, verdict_lines
from casacal.calibration.verdict import VERIFY, doubts, repair
from casacal.deployment.result import Verdict
from casacal.fit.methods import minimises
from casacal.planning.cures import Cure
from casacal.wording import figures, listed, mm

WORSE = 1.5  # expected error of the flange over that of the tip from which it is the tip that is worth correcting
MOST_LINES = 15  # lines of the whole, files written included


def next_step(
    calibration: Calibration, verdict: Verdict, *, about: str = "PROBLEM SAMPLES", out: str | None = None
) -> str:
    """One sentence; about: problem and samples, as a command line names them; out: folder of the files, if any."""
    check = f"casacal check {about}"
    tool = calibration.hidden_tool if verdict.level != "do not use" else None
    if tool is not None:
        return f"measure {listed(tool.names)}, state it in the problem file with its prior_std, and calibrate again."
    if verdict.level == "do not use":
        said = repair(calibration.unjudged, check)
        cure = None if said else _best(calibration.unjudged)
        return said or ("give every parameter a prior, or hold it with --fix." if cure is None else f"{cure.words}.")
    if verdict.level == "use with care":
        kept = "" if out is not None else "; --out DIR keeps the result and its report"
        step = next((doubt.step for doubt in doubts(calibration)[:1]), "")
        checked = calibration.unjudged.suspicious  # the data check, which named nothing, or the result would be denied
        return f"{step or (VERIFY if checked else f'run {check}, which looks closer at the samples')}{kept}."
    if out is None:
        return "add --out DIR to keep the result and its report; casacal compensate, predict and export read it."
    at_tip = not calibration.flange_std[1] <= WORSE * calibration.tip_std[1]
    tip = " (--frame tip if this tip does the work)" if at_tip else ""
    where = f"{shlex.quote(f'{out}/result.json')} TARGETS --out FILE{tip}"
    return f"verify with fresh touches, then correct joint targets with casacal compensate {where}."


def best_cure(calibration: Calibration) -> str:
    """The best cure and its figure, as a sentence; empty where none gains much. Not for who must not use the result."""
    if (cure := _best(calibration)) is None:
        return ""
    return f"{cure.words}; expected tip error {fall(calibration.tip_std[1], cure.expected_rms_mm)}."


def nothing_helps(calibration: Calibration) -> str:
    """A sentence for the case that no cure gains much; empty where one does or none was tried."""
    if not calibration.cures or _best(calibration) is not None:
        return ""
    least = calibration.cures[0].expected_rms_mm
    return f"More touches help little: expected tip error {fall(calibration.tip_std[1], least)} at best."


def fall(now: float, after: float) -> str:
    """Two tip errors, with as many digits as show the difference."""
    digits = 2 if now >= 0.1 and after >= 0.02 and round(now, 2) > round(after, 2) else 3
    return f"{now:.{digits}f} -> {after:.{digits}f} mm"


def _best(calibration: Calibration) -> Cure | None:
    """The first of the cures that are worth it and bound the tip error."""
    worth = (cure for cure in calibration.cures if cure.recommended and math.isfinite(cure.expected_rms_mm))
    return next(worth, None)


def brief(
    calibration: Calibration,
    verdict: Verdict,
    *,
    about: str = "PROBLEM SAMPLES",
    out: str | None = None,
    expected: Sequence[str] = (),
    width: int = 100,
    room: int = MOST_LINES,
) -> str:
    """At most `room` lines of at most `width` characters, unless a single word is longer.

    about, out: as for `next_step`. expected: further sentences on accuracy, left out when the verdict denies it.
    """
    calibration = calibration.unjudged
    denied = verdict.level == "do not use"
    held, rows, checked = calibration.heldout, f"{len(calibration.samples)} samples", ""
    if held is not None:
        rows += f", {len(held.measured)} of them held out{together(calibration)}"
    if (found := calibration.reference) is not None:
        lower_cost = not minimises(calibration.method) and found.gap > 0
        apart = f"finds a cost lower by {found.gap:.2g}" if lower_cost else "DIFFERS"
        checked = f"; {found.solver} {'agrees' if found.agrees else apart}"
    rows += "" if calibration.earlier is None else f" and {calibration.earlier.file}"
    subject = f"{calibration.fit.problem.robot.name}: {calibration.method} from {rows}{checked}"
    head = [subject, *verdict_lines(calibration, verdict)]
    tail = [] if denied else [*expected, _residual(calibration)]
    others = [reason for reason in verdict.reasons if reason.lower() not in verdict.words.lower()]
    others += image_words(calibration, verdict)
    above = _wrapped(head, width)
    cure = "" if denied else best_cure(calibration)
    first = verdict.level == "calibrated" and cure  # a doubt is settled first
    for named in (about, "PROBLEM SAMPLES"):  # long paths give way to what speaks against the result
        step = next_step(calibration, verdict, about=named, out=out)
        below = _wrapped([*tail, f"Next: {cure if first else step}"], width)
        left = room - len(above) - len(below)
        if left >= min(len(others), 2):
            break
    reasons = _reasons(others, width, left)
    said = f"Then: {step if first else cure}" if cure else "" if denied else nothing_helps(calibration)
    more = _wrapped([said], width)
    if len(reasons) + len(more) > left:  # advice gives way to what speaks against the result
        more = []
    return "\n".join([*above, *reasons, *below, *more]) + "\n"


def together(calibration: Calibration) -> str:
    """How rows were held out, where not one by one."""
    return "" if calibration.heldout_by == "rows" else f" by {calibration.heldout_by}"


def _residual(calibration: Calibration) -> str:
    part = "fit" if calibration.heldout is None else "heldout"
    before, after = (calibration.metrics[when][part] for when in ("before", "after"))
    assert before is not None
    assert after is not None
    said, held = calibration.fit.problem.words, "" if part == "fit" else "held-out "
    known = "as drawn" if calibration.earlier is None else "by the earlier result"
    now, then = (figures(each["rmse_mm"]) for each in (after, before))
    return f"Residual on the {held}{said.things}, not accuracy: {now} {said.unit} RMS ({known}: {then})."


def _reasons(reasons: Sequence[str], width: int, room: int) -> list[str]:
    """As many reasons as fit, a bullet each; the first is cut short rather than left out, the rest are counted."""
    lines: list[str] = []
    for k, reason in enumerate(reasons):
        bullet = textwrap.wrap(reason, width, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False)
        left = room - len(lines) - (k + 1 < len(reasons))  # a line to count the rest, unless this is the last
        left = max(left, 1) if k == 0 else left
        if len(bullet) <= left:
            lines += bullet
        elif k == 0:
            lines += [*bullet[: left - 1], f"{bullet[left - 1][: width - 4]} ..."]
        else:
            return [*lines, f"- {len(reasons) - k} more with --verbose"][: max(room, 1)]
    return lines


def _wrapped(sentences: Sequence[str], width: int) -> list[str]:
    wrapper = textwrap.TextWrapper(width, subsequent_indent="  ", break_on_hyphens=False, break_long_words=False)
    return [line for sentence in sentences for line in wrapper.wrap(sentence)]


def corrected_words(calibration: Calibration) -> list[str]:
    """Corrected effects and the tip error of a controller that cannot correct them; empty where none is corrected."""
    named = listed([each.words for each in calibration.tried if each.corrected])
    if not named:
        return []
    alone = tip_error(calibration.fit, calibration.result, ())
    return [
        f"The result corrects {named}; predict, compensate and the C export apply it. Tables of lengths",
        f"and angles cannot: with those alone expect a tip error of {mm(alone)} RMS.",
    ]

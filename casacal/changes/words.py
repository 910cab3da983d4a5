"""What was found of an arm that may have changed, in words: the answer first, what it rests on, what to do."""

from __future__ import annotations

import math
from collections.abc import Sequence

from casacal.changes.figures import CHANGED, NOTHING, ROWS, CauseFound, Figures
from casacal.errors import counted

LEAST = 1e-6
"""Chance below which nobody asks how small."""

INTERVAL = 1.96
"""Standard deviations of an interval of 95 %."""


def told(found: Figures) -> list[str]:
    """Paragraphs, the answer first."""
    return [
        _answer(found),
        *(_unseen(found) if found.ended == NOTHING else []),
        *_own_verdict(found),
        *_left_out(found),
        *_causes(found),
        *_bad(found),
        _rests_on(found),
        _shown(found),
        *(_unseen(found) if found.ended != NOTHING else []),
        *_next(found),
    ]


def name_of(cause: CauseFound) -> str:
    """A cause as a sentence calls it."""
    return {
        "joint": f"the zero of {cause.name}",
        "tool": "where the tool stands",
        "base": "where the base stands",
        "place": f"where '{cause.name}' stands",
        "row": f"{cause.name} alone, as a row that is off",
    }[cause.kind]


def amount(cause: CauseFound) -> str:
    """By how much, with intervals of 95 %; nothing of a row."""
    parts = []
    for label, unit, shift, std in zip(cause.labels, cause.units, cause.shift, cause.std, strict=True):
        said = f"{label} " if len(cause.units) > 1 else ""
        if unit == "rad":
            said += f"{1e3 * shift:+.2f} mrad +- {1e3 * INTERVAL * std:.2f} ({math.degrees(shift):+.4f} degrees)"
        else:
            said += f"{shift:+.3f} mm +- {INTERVAL * std:.3f}"
        parts.append(said)
    return ", ".join(parts)


def _answer(found: Figures) -> str:
    said = f"{counted(found.rows, 'fresh row')} of {found.samples}"
    rate = f"at a rate of false alarms of {100 * found.alarm:g} %"
    if found.ended == NOTHING:
        return f"No change found: {said} lie as the calibration of {found.robot} promised, {rate}."
    if found.ended == ROWS:
        which = _lines(found)
        return f"Look at {which} first: without {_it(found)} no change is found in {said}, {rate}."
    if found.ended == CHANGED:
        (cause,) = found.causes
        return f"Changed: {name_of(cause)}, by {amount(cause)}; {said}, {_chance(found.p)}, {rate}."
    if not found.causes:
        return (
            f"Undecided: {said} do not lie as promised, {_chance(found.p)}, and no cause that is known explains them."
        )
    if len(found.causes) == 1:
        (cause,) = found.causes
        return (
            f"Undecided: {said} do not lie as promised, {_chance(found.p)}. {_capital(name_of(cause))} explains them "
            f"best and leaves what is hardly chance ({_chance(cause.left)}): more than one thing changed, or another."
        )
    return (
        f"Undecided: {said} do not lie as promised, {_chance(found.p)}, and cannot tell "
        f"{_listed([name_of(cause) for cause in found.causes])} apart."
    )


def _own_verdict(found: Figures) -> list[str]:
    level, words = found.verdict
    return [] if level in ("", "calibrated") else [f"The result's own verdict: {words}"]


def _left_out(found: Figures) -> list[str]:
    said = []
    for lines, why in (
        (found.copied_lines, "repeat others to the last digit and count once"),
        (found.fitted_lines, "are among those that the arm was calibrated from and do not count"),
    ):
        if lines:
            said.append(f"{counted(len(lines), 'row')} of {found.samples} {why}.")
    return said


def _causes(found: Figures) -> list[str]:
    if found.ended == CHANGED or not found.causes:
        return []
    return [
        f"  {_capital(name_of(cause))}: {100 * cause.share:.0f} % of the evidence"
        + (f"; then by {amount(cause)}" if cause.kind != "row" else "")
        + f"; what it leaves: {_chance(cause.left)}"
        for cause in found.causes
    ]


def _bad(found: Figures) -> list[str]:
    if not found.bad_lines:
        return []
    lies = "lies" if len(found.bad_lines) == 1 else "lie"
    return [
        f"{_capital(_lines(found))} {lies} where no other row and no change of the arm expects {_it(found)}: measure "
        "there again."
    ]


def _rests_on(found: Figures) -> str:
    own = counted(len(found.own), "unknown")
    fitted = f"{own} fitted to these rows" if found.own else "nothing fitted to these rows"
    still = f"; taken to stand where calibrated: {', '.join(found.standing)}" if found.standing else ""
    drift = ", ".join(f"{name} {std:g}" for name, std in found.drift)
    return (
        f"Smallest chance of all tests {_number(found.p)}; an alarm below {_number(found.level)}. All residuals: "
        f"chi-square {found.chi_square:.1f} with {found.freedom} degrees of freedom, {_chance(found.p_all)}. "
        f"{_capital(fitted)}{still}{f'; drift {drift}' if drift else ''}."
    )


def _shown(found: Figures) -> str:
    parts = []
    for joint in found.joints:
        if math.isfinite(joint.shift):
            size = f"{1e3 * joint.shift:.2g} mrad" if joint.unit == "rad" else f"{joint.shift:.2g} mm"
            parts.append(f"{joint.name} {size}")
    if not parts:
        return "No shift of any joint would show in these rows."
    return f"Shift of a joint's zero that these rows would have shown with 90 %: {', '.join(parts)}."


def _unseen(found: Figures) -> list[str]:
    return [f"A shift of {_listed(found.unseen, 'or')} does not show here."] if found.unseen else []


def _next(found: Figures) -> list[str]:
    if found.ended == NOTHING:
        return []
    if found.ended == CHANGED:
        return [
            "Next: see what was done to the arm; --update DIR writes a result from the old one and these rows, or "
            "calibrate again; then verify with fresh rows."
        ]
    if found.ended == ROWS:
        return [f"Next: measure {_lines(found)} again, and ask again."]
    if any(cause.kind == "row" for cause in found.causes):
        lines = _listed([cause.name for cause in found.causes if cause.kind == "row"])
        return [f"Next: measure {lines} again: where it reads the same, the arm changed."]
    if len(found.causes) < 2:
        return [
            f"Next: casacal check PROBLEM {found.samples} looks for mistakes in these rows; where there are none, "
            "calibrate again with old and new rows."
        ]
    if found.touches is None:
        return ["Next: --touches FILE writes touches that would tell; give them together with these rows."]
    if found.tells < 1.0:
        return ["Next: no touch of these faces tells them apart; what was done to the arm may."]
    sure = f"odds of about {math.exp(min(found.tells, 14.0)):.0f} to 1"
    return [f"Next: {len(found.touches)} touches would tell, with {sure}; give them together with these rows."]


def _lines(found: Figures) -> str:
    return f"{'line' if len(found.bad_lines) == 1 else 'lines'} {_listed([str(line) for line in found.bad_lines])}"


def _it(found: Figures) -> str:
    return "it" if len(found.bad_lines) == 1 else "them"


def _listed(names: Sequence[str], word: str = "and") -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _chance(p: float) -> str:
    return f"p {'=' if p >= LEAST else '<'} {_number(p)}".replace("< < ", "< ")


def _number(p: float) -> str:
    return f"{p:.2g}" if p >= LEAST else f"{LEAST:g}"

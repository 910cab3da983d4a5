"""What was found of an arm that may have changed, in words and in JSON's own types: the answer first."""

from __future__ import annotations

import math
from dataclasses import asdict, fields
from typing import Any

from casacal.changes.figures import CHANGED, NOTHING, ROWS, CauseFound, Figures
from casacal.files import jsonable
from casacal.wording import capital, chance, counted, listed, numbered_lines, times

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
        "tool": "the position of the tool",
        "base": "the position of the base",
        "place": f"the position of '{cause.name}'",
        "row": f"{cause.name} alone, as a faulty row",
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
    rate = f"False alarm rate {100 * found.alarm:g} %."
    if found.ended == NOTHING:
        return f"No change found: {said} agree with the calibration of {found.robot}. {rate}"
    if found.ended == ROWS:
        return f"Look at {numbered_lines(found.bad_lines)} first: without {_it(found)}, {said} show no change. {rate}"
    if found.ended == CHANGED:
        (cause,) = found.causes
        return f"Changed: {name_of(cause)}, by {amount(cause)}; {said}, {chance(found.p)}. {rate}"
    start = f"Undecided: {said} do not agree with the calibration ({chance(found.p)})"
    if not found.causes:
        return f"{start}, and no known cause explains them."
    if len(found.causes) == 1:
        (cause,) = found.causes
        return (
            f"{start}. {capital(name_of(cause))} explains them best, but not fully ({chance(cause.left)} for the "
            "rest): more than one thing changed, or something else did."
        )
    return f"{start}. They cannot distinguish between {listed([name_of(cause) for cause in found.causes])}."


def _own_verdict(found: Figures) -> list[str]:
    level, words = found.verdict
    return [] if level in ("", "calibrated") else [f"The result's own verdict: {words}"]


def _left_out(found: Figures) -> list[str]:
    said = []
    for lines, why in (
        (found.copied_lines, "repeat other rows to the last digit and are counted once"),
        (found.fitted_lines, "were used for the calibration and are not counted"),
    ):
        if lines:
            said.append(f"{counted(len(lines), 'row')} of {found.samples} {why}.")
    return said


def _causes(found: Figures) -> list[str]:
    if found.ended == CHANGED or not found.causes:
        return []
    return [
        f"  {capital(name_of(cause))}: {100 * cause.share:.0f} % of the evidence"
        + (f"; size {amount(cause)}" if cause.kind != "row" else "")
        + f"; rest {chance(cause.left)}"
        for cause in found.causes
    ]


def _bad(found: Figures) -> list[str]:
    if not found.bad_lines:
        return []
    fit = "fits" if len(found.bad_lines) == 1 else "fit"
    return [
        f"{capital(numbered_lines(found.bad_lines))} {fit} neither the other rows nor any change of the arm. Measure "
        f"{_it(found)} again."
    ]


def _rests_on(found: Figures) -> str:
    own = counted(len(found.own), "unknown")
    fitted = f"{own} fitted to these rows" if found.own else "nothing fitted to these rows"
    still = f"; assumed not to have moved: {', '.join(found.standing)}" if found.standing else ""
    drift = ", ".join(f"{name} {std:g}" for name, std in found.drift)
    return (
        f"Smallest p of all tests {chance(found.p).split()[-1]}; alarm below {found.level:.2g}. All residuals: "
        f"chi-square {found.chi_square:.1f} with {found.freedom} degrees of freedom, {chance(found.p_all)}. "
        f"{capital(fitted)}{still}{f'; drift {drift}' if drift else ''}."
    )


def _shown(found: Figures) -> str:
    parts = []
    for joint in found.joints:
        if math.isfinite(joint.shift):
            size = f"{1e3 * joint.shift:.2g} mrad" if joint.unit == "rad" else f"{joint.shift:.2g} mm"
            parts.append(f"{joint.name} {size}")
    if not parts:
        return "These rows would not show a shift of any joint."
    return f"Smallest shift of an encoder zero that these rows show with 90 % probability: {', '.join(parts)}."


def _unseen(found: Figures) -> list[str]:
    return [f"These rows do not show a shift of {listed(found.unseen, 'or')}."] if found.unseen else []


def _next(found: Figures) -> list[str]:
    if found.ended == NOTHING:
        return []
    if found.ended == CHANGED:
        return [
            "Next: find out what was done to the arm. Then update the old result with these rows (--update DIR) or "
            "calibrate again, and verify with fresh rows."
        ]
    if found.ended == ROWS:
        return [f"Next: measure {numbered_lines(found.bad_lines)} again, and run this command again."]
    if any(cause.kind == "row" for cause in found.causes):
        lines = listed([cause.name for cause in found.causes if cause.kind == "row"])
        return [f"Next: measure {lines} again. If the reading is the same, the arm has changed."]
    if len(found.causes) < 2:
        return [
            f"Next: casacal check PROBLEM {found.samples} looks for mistakes in these rows. If there are none, "
            "calibrate again with old and new rows."
        ]
    if found.touches is None:
        return ["Next: --touches FILE plans touches that would settle it. Pass them together with these rows."]
    if found.tells < 1.0:
        return ["Next: no touch of these faces would settle it. Find out what was done to the arm."]
    odds = f"{times(math.exp(min(found.tells, 14.0)))} to 1"
    return [
        f"Next: {len(found.touches)} planned touches would settle it, at odds of about {odds}. Pass them with these "
        "rows."
    ]


def _it(found: Figures) -> str:
    return "it" if len(found.bad_lines) == 1 else "them"


class Change(Figures):
    """Whether an arm has changed since its calibration, what, and by how much."""

    def summary(self) -> str:
        """What `casacal changed` prints: a paragraph each line."""
        return "\n".join(told(self))

    def to_dict(self) -> dict[str, Any]:
        """All of it in JSON's own types, as `casacal changed --json` prints it."""
        level, words = self.verdict
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        found["verdict"] = {"level": level, "words": words} if level else None
        found["causes"] = [asdict(each) for each in self.causes]
        found["joints"] = [asdict(each) for each in self.joints]
        found["drift"] = dict(self.drift)
        found["touches"] = None if self.touches is None else len(self.touches)
        return dict(jsonable({"changed": self.changed, **found}))

    def __repr__(self) -> str:
        names = ", ".join(cause.name for cause in self.causes)
        said = {"nothing": "nothing changed", "rows": "rows are off"}.get(self.ended, f"{self.ended}: {names}")
        return f"<Change of {self.robot} by {self.rows} fresh rows: {said}, p {self.p:.3g}>"

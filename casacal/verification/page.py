"""The page of a verification, by itself or as a section of the calibration's own report."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from casacal.errors import CasacalError
from casacal.pages.render import fixed, mm, rendered, shortened
from casacal.verification.error_picture import NAMES, error_picture
from casacal.verification.figures import ErrorInterval, Figures, PartError
from casacal.verification.words import told
from casacal.verification.words_of_error import decision_told, measurand

LONGEST = 60
"""Characters of a label in a table."""

BEFORE = '<section id="measured"'
"""Where the section is put."""

STANDING = re.compile(r'<section id="verified".*?</section>\n*', re.DOTALL)

REPORT = "report.html"


def verification_page(found: Figures) -> str:
    """HTML of all that was found."""
    title = f"Verification of {found.robot} ({found.samples})"
    return rendered("verification.html", {"title": title, "part_of_report": False, **_context(found)})


def with_section(path: Path, document: Mapping[str, Any], found: Figures) -> str:
    """The text of a calibration's report with the section of a verification.

    Args:
        path: the report, as `casacal calibrate` wrote it.
        document: the result.json that the report is of.
        found: the verification.

    Raises CasacalError where there is no such report, or it is of another calibration.

    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise CasacalError(
            f"There is no report '{path}' to write into", "Write a separate page: --report FILE"
        ) from None
    marks = [str(document.get(part, {}).get("sha256", "")) for part in ("problem", "data")]
    if "<title>Calibration of" not in text or text.count(BEFORE) != 1 or not all(mark in text for mark in marks):
        raise CasacalError(f"'{path}' is not the report of this result", "Write a separate page: --report FILE")
    section = rendered("verified.html", {"part_of_report": True, **_context(found)})
    return STANDING.sub("", text).replace(BEFORE, f"{section.strip()}\n{BEFORE}")


def _context(found: Figures) -> dict[str, Any]:
    """What the templates show."""
    return {
        "found": found,
        "told": told(found),
        "decision": decision_told(found),
        "measurand": measurand(found),
        "look": _look(found),
        "rows": [
            ("Fresh rows", f"{found.samples}: {found.rows:,}"),
            ("SHA-256 of the rows", Markup("<code>{}</code>").format(found.sha256)),
            ("Fitted to these rows", shortened(", ".join(found.own), 200) or "nothing"),
            ("Assumed not to have moved", ", ".join(found.standing) or "nothing"),
        ],
        "overall": _boxes(found),
        "picture": None if found.overall is None else error_picture(found),
        "errors": [_error(part) for part in found.errors],
        "faces": [
            [
                shortened(face.label, LONGEST),
                f"{face.rows:,}",
                *map(fixed, (face.before_mm, face.after_mm, face.predicted_mm)),
                f"{face.p:.2g}",
            ]
            for face in found.faces
        ],
    }


def _look(found: Figures) -> str:
    """A result whose own verdict denies it looks no better for rows that agree with it."""
    undecided = found.kept and found.decision is not None and found.decision.verdict == "undecided"
    return "bad" if found.denied else "good" if found.passed else "care" if undecided else "bad"


def _boxes(found: Figures) -> list[tuple[str, str, str]]:
    part, decision = found.overall, found.decision
    if part is None:
        return []
    boxes = [
        ("Error as drawn", mm(part.before.mm, 4), f"{_between(part.before)} mm"),
        ("Error as calibrated", mm(part.after.mm, 4), f"{_between(part.after)} mm"),
        ("Promised", mm(part.promised_mm, 4), "what the calibration expects, RMS"),
    ]
    if decision is not None:
        limit = "noise hides it"
        if not math.isnan(decision.accept_below_mm):
            limit = f"accepted up to {mm(decision.accept_below_mm, 4)}"
        boxes.append(("Tolerance", f"{decision.tolerance_mm:g} mm", f"{decision.verdict}; {limit}"))
    return boxes


def _between(error: ErrorInterval) -> str:
    return f"{fixed(error.low_mm)} to {fixed(error.high_mm)}"


def _error(part: PartError) -> list[str]:
    each = [cell for error in (part.before, part.after) for cell in (fixed(error.mm), _between(error))]
    return [shortened(NAMES[part.kind] + part.label, LONGEST), f"{part.rows:,}", *each, fixed(part.promised_mm)]

"""The page of a verification, by itself or as a section of the calibration's own report."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from casacal.calibration.page.markup import Markup, paragraph, section, tag, together
from casacal.calibration.page.numbers import fixed, mm, shortened
from casacal.calibration.page.shell import whole_page
from casacal.calibration.page.table import NUMBER, WORDS, facts, table
from casacal.errors import CasacalError
from casacal.verification.error_picture import error_picture
from casacal.verification.figures import ErrorInterval, Figures, PartError
from casacal.verification.words import told
from casacal.verification.words_of_error import decision_told, measurand

LONGEST = 60
"""Characters of a label in a table."""

KINDS = {"all": "", "face": "face ", "region": "tip at "}


def verification_page(found: Figures) -> str:
    """HTML of all that was found."""
    main = tag("main", _heading(found), _verdict(found), verified_section(found), _words(found))
    return whole_page(f"Verification of {found.robot} ({found.samples})", main)


def section_of_report(found: Figures) -> Markup:
    """The same as one section of the calibration's report."""
    answer, *more = told(found)
    told_so = [paragraph(words) for words in (*decision_told(found), *more)]
    rows = facts("verified-rows", _of_the_rows(found))
    errors = [error_picture(found), _errors(found), _faces(found)] if found.overall is not None else []
    return section(
        "verified",
        "Verified by fresh rows",
        paragraph(answer, style=f"verdict {_look(found)}"),
        rows,
        *told_so,
        _boxes(found),
        *errors,
    )


def verified_section(found: Figures) -> Markup | None:
    """The arm's error before and after, by face and region: picture and table; None where rows say nothing of it."""
    if found.overall is None:
        return None
    return section(
        "verified",
        "Verified by fresh rows",
        paragraph(
            f"The {measurand(found)}: RMS over postures of the kind that were measured, the instrument's own noise "
            f"({mm(found.noise_mm, 4)}) taken off, and what was fitted to these rows alone given back. Each stands "
            "between what it lies with a chance of 95 %."
            + ("" if found.accuracy else " Small errors here are necessary, not sufficient, for an accurate tip.")
        ),
        error_picture(found),
        _errors(found),
        _faces(found),
    )


def _heading(found: Figures) -> Markup:
    pairs: list[tuple[str, object]] = [("Calibration", found.result), *_of_the_rows(found)]
    return tag(
        "header", paragraph("Verification report", style="kind"), tag("h1", found.robot), facts("subject", pairs)
    )


def _of_the_rows(found: Figures) -> list[tuple[str, object]]:
    return [
        ("Fresh rows", f"{found.samples}: {found.rows:,}"),
        ("SHA-256 of the rows", tag("code", found.sha256)),
        ("Fitted to these rows", shortened(", ".join(found.own), 200) or "nothing"),
        ("Taken to stand", ", ".join(found.standing) or "nothing"),
    ]


def _verdict(found: Figures) -> Markup:
    """The answer, the decision and the figures behind them."""
    answer, *_ = told(found)
    return section(
        "verdict",
        "Verdict",
        paragraph(answer, style=f"verdict {_look(found)}"),
        *(paragraph(words) for words in decision_told(found)),
        _boxes(found),
    )


def _look(found: Figures) -> str:
    """A result whose own verdict denies it looks no better for rows that agree with it."""
    undecided = found.kept and found.decision is not None and found.decision.verdict == "undecided"
    return "bad" if found.denied else "good" if found.passed else "care" if undecided else "bad"


def _boxes(found: Figures) -> Markup | None:
    part, decision = found.overall, found.decision
    if part is None:
        return None
    boxes = [
        _box("Error as drawn", mm(part.before.mm, 4), _between(part.before)),
        _box("Error as calibrated", mm(part.after.mm, 4), _between(part.after)),
        _box("Promised", mm(part.promised_mm, 4), "what the calibration expects of it, RMS"),
    ]
    if decision is not None:
        said = f"{decision.verdict}; accepted up to {mm(decision.accept_below_mm, 4)}"
        said = said if decision.accept_below_mm == decision.accept_below_mm else f"{decision.verdict}; noise hides it"
        boxes.append(_box("Tolerance", f"{decision.tolerance_mm:g} mm", said))
    return tag("ul", *boxes, at={"class": "figures"})


def _box(title: str, value: str, words: str) -> Markup:
    what, how = tag("span", title, at={"class": "what"}), tag("span", words, at={"class": "how"})
    return tag("li", what, tag("strong", value), how)


def _between(error: ErrorInterval) -> str:
    return f"{fixed(error.low_mm)} to {fixed(error.high_mm)} mm"


def _errors(found: Figures) -> Markup:
    columns = [("Rows", WORDS), ("Count", NUMBER), ("As drawn, mm", NUMBER), ("95 %", NUMBER)]
    columns += [("As calibrated, mm", NUMBER), ("95 %", NUMBER), ("Promised, mm", NUMBER)]
    return table("verified-errors", f"Arm's error, RMS ({found.sees})", columns, [_row(part) for part in found.errors])


def _row(part: PartError) -> list[object]:
    each = ((fixed(error.mm), _between(error).removesuffix(" mm")) for error in (part.before, part.after))
    label = shortened(KINDS[part.kind] + part.label, LONGEST)
    return [label, f"{part.rows:,}", *(cell for pair in each for cell in pair), fixed(part.promised_mm)]


def _faces(found: Figures) -> Markup | None:
    """Residuals of each face, noise and all, against what was predicted of them."""
    if not found.faces:
        return None
    columns = [
        ("Face", WORDS),
        ("Rows", NUMBER),
        ("As drawn", NUMBER),
        ("As calibrated", NUMBER),
        ("Predicted", NUMBER),
    ]
    rows = [
        [
            shortened(face.label, LONGEST),
            f"{face.rows:,}",
            *map(fixed, (face.before_mm, face.after_mm, face.predicted_mm)),
            f"{face.p:.2g}",
        ]
        for face in found.faces
    ]
    caption = f"Residuals with their noise, {found.unit} RMS"
    return table("verified-residuals", caption, [*columns, ("Chance of so much", NUMBER)], rows)


def _words(found: Figures) -> Markup:
    """All paragraphs, as the command prints them."""
    return section("words", "In words", together(*(paragraph(words) for words in told(found))))


BEFORE = '<section id="measured"'
"""Where the section is put."""

STANDING = re.compile(r'<section id="verified".*?</section>\n*', re.DOTALL)

REPORT = "report.html"


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
            f"There is no report '{path}' to write into", "Write a page of its own: --report FILE"
        ) from None
    marks = [str(document.get(part, {}).get("sha256", "")) for part in ("problem", "data")]
    if "<title>Calibration of" not in text or text.count(BEFORE) != 1 or not all(mark in text for mark in marks):
        raise CasacalError(f"'{path}' is not the report of this result", "Write a page of its own: --report FILE")
    bare = STANDING.sub("", text)
    return bare.replace(BEFORE, f"{section_of_report(found)}\n{BEFORE}")

"""The verdict in one sentence, its reasons, and the figures behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from casacal.calibration.calibration import Calibration
from casacal.calibration.page.markup import Markup, paragraph, section, tag
from casacal.calibration.page.numbers import count, mm
from casacal.calibration.verdict import Level

LOOKS: Mapping[Level, str] = {"calibrated": "good", "use with care": "care", "do not use": "bad"}
"""How the page paints each level."""


def verdict_section(calibration: Calibration, document: Mapping[str, Any]) -> Markup:
    """Verdict, reasons and figures."""
    verdict = document["verdict"]
    return section(
        "verdict",
        "Verdict",
        paragraph(verdict["words"], style=f"verdict {LOOKS[verdict['level']]}"),
        _reasons(verdict["reasons"]),
        _figures(calibration, document),
    )


def _figures(calibration: Calibration, document: Mapping[str, Any]) -> Markup:
    before, after = document["metrics"]["before"], document["metrics"]["after"]
    part = "fit" if after["heldout"] is None else "heldout"
    free = [row for row in document["parameters"] if row["note"] != "held at nominal"]
    known = sum(row["identifiable"] == "data" for row in free)
    reference = calibration.reference
    agreement, checked = "not run", "nothing checked"
    if reference is not None:
        checked, agreement = "on", f"{reference.solver.upper()} {'agrees' if reference.agrees else 'differs'}"
    where = "fitted rows" if part == "fit" else "held-out rows"
    found = document["identifiability"]
    return tag(
        "ul",
        _expected(document),
        _figure(
            "Residual: not accuracy",
            mm(after[part]["rmse_mm"], 4),
            f"RMS of the {where}; before {mm(before[part]['rmse_mm'], 4)}",
        ),
        _figure("Known from samples", f"{known} of {len(free)}", "parameters; the others lean on the prior"),
        _figure(
            "Second solver",
            agreement,
            f"{checked} the minimum; rank {found['rank']} of {count(found['unknowns'], 'unknown')}",
        ),
        at={"class": "figures"},
    )


def _expected(document: Mapping[str, Any]) -> Markup:
    tip = document["tip"]
    if document["verdict"]["level"] == "do not use":
        return _figure("Expected tip error", "not stated", "the verdict denies it")
    return _figure(
        "Expected tip error",
        mm(tip["expected_rms_mm"]),
        f"RMS over the workspace, apart from where the base stands; before {mm(tip['prior_rms_mm'])}",
    )


def _figure(title: str, value: str, words: str) -> Markup:
    return tag(
        "li",
        tag("span", title, at={"class": "what"}),
        tag("strong", value),
        tag("span", words, at={"class": "how"}),
    )


def _reasons(sentences: Sequence[str]) -> Markup:
    if not sentences:
        return paragraph("Nothing speaks against it.", style="calm")
    items = [tag("li", sentence) for sentence in sentences]
    return tag("div", tag("h3", "Why"), tag("ul", *items), at={"class": "warnings"})

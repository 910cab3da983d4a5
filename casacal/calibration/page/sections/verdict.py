"""The verdict in one sentence, the figures behind it, and the warnings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from casacal.calibration.calibration import MINIMISERS, Calibration
from casacal.calibration.page.markup import Markup, paragraph, section, tag
from casacal.calibration.page.numbers import count, mm

GAIN = 0.9
"""Expected tip error over the one before, above which little was gained."""

Level = Literal["good", "care", "bad"]
WORDS: Mapping[Level, str] = {"good": "Calibrated", "care": "Use with care", "bad": "Do not use"}


@dataclass(frozen=True)
class Verdict:
    """How far the result may be used, and the sentence that says so."""

    level: Level
    sentence: str


def verdict_of(calibration: Calibration, document: Mapping[str, Any]) -> Verdict:
    """Whether to use the result; the first reason that speaks against it decides."""
    tip, planes = document["tip"], calibration.fit.problem.instrument.words.things
    stands = (
        f"the tip is expected to be wrong by {mm(tip['expected_rms_mm'])} RMS over the workspace "
        f"(before: {mm(tip['prior_rms_mm'])}), provided that the stated noise and priors are right"
    )
    where = "held-out residual" if document["metrics"]["after"]["heldout"] else "residual"
    residual = f"the {where} of {mm(_residual(document), 4)} on the {planes} is how well the rows fit, not accuracy"
    if not calibration.result.converged:
        return Verdict("bad", f"Do not use this result: the method did not finish. {document['status']}")
    missed = _missed_minimum(calibration)
    if missed:
        return Verdict("bad", f"Do not use this result: {missed}.")
    if not math.isfinite(tip["expected_rms_mm"]):
        return Verdict("bad", f"Do not rely on this arm: its tip error has no bound with these samples; {residual}.")
    warned = len(document["warnings"])
    if warned:
        told = "a warning below tells" if warned == 1 else f"{warned} warnings below tell"
        return Verdict("care", f"Use with care: {stands}, and {told} where that may not hold; {residual}.")
    if calibration.reference is None and calibration.method not in MINIMISERS:
        return Verdict("care", f"Use with care: no second solver checked that this is the minimum; {residual}.")
    if tip["expected_rms_mm"] > GAIN * tip["prior_rms_mm"]:
        return Verdict("care", f"Little was gained: {stands}; {residual}.")
    return Verdict("good", f"Calibrated: {stands}; {residual}.")


def verdict_section(calibration: Calibration, document: Mapping[str, Any]) -> Markup:
    """Verdict, figures and warnings."""
    verdict = verdict_of(calibration, document)
    return section(
        "verdict",
        "Verdict",
        paragraph(verdict.sentence, style=f"verdict {verdict.level}"),
        _figures(calibration, document),
        _warnings(document["warnings"]),
    )


def _missed_minimum(calibration: Calibration) -> str:
    """Why the estimate is not the minimum, or nothing.

    A method that promises the minimum must meet the reference; any other may miss it by what the estimate's own spread
    explains: twice the cost above the minimum is then about chi-square with as many degrees of freedom as unknowns.
    """
    reference = calibration.reference
    if reference is None or reference.agrees:
        return ""
    if calibration.method in MINIMISERS:
        return f"{calibration.method} and {reference.solver} ended at different costs, so one of them is wrong"
    if 2 * (calibration.result.cost - reference.cost) <= calibration.fit.unknowns:
        return ""
    return (
        f"{calibration.method} ended at a cost of {calibration.result.cost:.4g}, far above the {reference.cost:.4g} "
        f"that {reference.solver} found; the expected tip error below holds at the minimum alone"
    )


def _residual(document: Mapping[str, Any]) -> float:
    after = document["metrics"]["after"]
    return float((after["heldout"] or after["fit"])["rmse_mm"])


def _figures(calibration: Calibration, document: Mapping[str, Any]) -> Markup:
    before, after = document["metrics"]["before"], document["metrics"]["after"]
    part = "fit" if after["heldout"] is None else "heldout"
    free = [row for row in document["parameters"] if row["note"] != "held at nominal"]
    known = sum(row["identifiable"] == "data" for row in free)
    tip, reference = document["tip"], calibration.reference
    agreement, checked = "not run", "nothing checked"
    if reference is not None:
        checked, agreement = "on", f"{reference.solver.upper()} {'agrees' if reference.agrees else 'differs'}"
    where = "fitted rows" if part == "fit" else "held-out rows"
    found = document["identifiability"]
    return tag(
        "ul",
        _figure(
            "Expected tip error",
            mm(tip["expected_rms_mm"]),
            f"RMS over the workspace, up to the base frame; before {mm(tip['prior_rms_mm'])}",
        ),
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


def _figure(title: str, value: str, words: str) -> Markup:
    return tag(
        "li",
        tag("span", title, at={"class": "what"}),
        tag("strong", value),
        tag("span", words, at={"class": "how"}),
    )


def _warnings(sentences: list[str]) -> Markup:
    if not sentences:
        return paragraph("No warnings.", style="calm")
    items = [tag("li", sentence[:1].upper() + sentence[1:]) for sentence in sentences]
    return tag("div", tag("h3", "Warnings"), tag("ul", *items), at={"class": "warnings"})

"""Parameters from nominal to calibrated, each with what determined it, and correlations worth knowing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from casacal.calibration.calibration import Calibration
from casacal.calibration.page.markup import Markup, paragraph, section, tag, together
from casacal.calibration.page.numbers import count, fixed, shown_unit
from casacal.calibration.page.table import NUMBER, WORDS, table
from casacal.uncertainty.identifiability import KNOWN_FROM, correlated_pairs

SHOWN_PAIRS = 10


def parameters_section(calibration: Calibration, document: Mapping[str, Any]) -> Markup:
    """Table of free parameters, those held, and correlations."""
    priors = {name: float(calibration.fit.prior_std[j]) for j, name in enumerate(calibration.fit.names)}
    rows, held = [], []
    for row in document["parameters"]:
        if row["note"] == "held at nominal":
            held.append(row["name"])
        else:
            rows.append(_row(row, priors.get(row["name"], math.inf)))
    columns = [("Parameter", WORDS), ("Unit", WORDS), ("Nominal", NUMBER), ("Calibrated", NUMBER), ("Change", NUMBER)]
    columns += [("Std. dev.", NUMBER), ("Of prior", NUMBER), ("Known from", WORDS)]
    return section(
        "parameters",
        "Parameters",
        paragraph(
            f"Standard deviations trust the {calibration.noise_words} and the priors. “Of prior” is the standard "
            "deviation over that of the prior: near 100 % the samples said nothing and the nominal value stands."
        ),
        table("parameter-table", "Parameters, nominal and calibrated", columns, rows, look="wide") if rows else None,
        paragraph(f"Held at nominal: {', '.join(held)}.", style="note") if held else None,
        None if document["verdict"]["level"] == "do not use" else _correlations(calibration),
    )


def _row(row: Mapping[str, Any], prior: float) -> list[object]:
    unit, factor = shown_unit(row["unit"])
    nominal, estimate, std = (factor * row[key] for key in ("nominal", "estimate", "std"))
    if math.isnan(std):  # the verdict denies it
        cells = [row["name"], unit, fixed(nominal), fixed(estimate), fixed(estimate - nominal, signed=True)]
        return [*cells, "–", "–", KNOWN_FROM[row["identifiable"]]]
    share = f"{100 * row['std'] / prior:.0f} %" if math.isfinite(prior) and math.isfinite(std) else "no prior"
    words = tag("span", KNOWN_FROM[row["identifiable"]], at={"class": f"known {row['identifiable']}"})
    return [
        row["name"], unit, fixed(nominal), fixed(estimate), fixed(estimate - nominal, signed=True), fixed(std), share,
        words,
    ]  # fmt: skip


def _correlations(calibration: Calibration) -> Markup:
    """Pairs of the arm's own unknowns: planes are always correlated with each other and with the base."""
    arm = np.flatnonzero(~calibration.seen.datum)
    names = [calibration.seen.names[j] for j in arm]
    pairs = correlated_pairs(calibration.covariance[np.ix_(arm, arm)], names)
    heading = tag("h3", "Correlations")
    if not pairs:
        return together(heading, paragraph("No two parameters of the arm are correlated above 0.95.", style="calm"))
    rows = [[one, two, fixed(value, 3, signed=True)] for one, two, value in pairs[:SHOWN_PAIRS]]
    more = len(pairs) - SHOWN_PAIRS
    columns = [("Parameter", WORDS), ("With", WORDS), ("Correlation", NUMBER)]
    return together(
        heading,
        paragraph(
            "These pairs are known together, not apart: their values trade against each other, and neither should be "
            "used without the other."
        ),
        table("correlations", "Correlations above 0.95", columns, rows, look="small"),
        paragraph(f"{count(more, 'more pair')} in result.json.", style="note") if more > 0 else None,
    )

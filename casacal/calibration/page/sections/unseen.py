"""What the samples cannot tell, what that costs at the tip, what lowers it, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from casacal.calibration.calibration import NOT_NEEDED
from casacal.calibration.page.markup import Markup, paragraph, section, tag, together
from casacal.calibration.page.numbers import count, mm
from casacal.calibration.page.table import NUMBER, WORDS, table

SHOWN = 20
"""Directions of each sort with a line of their own."""


def unseen_section(document: Mapping[str, Any]) -> Markup:
    """Null and weak directions in words, the costly ones first."""
    found = document["identifiability"]
    directions = [*found["null"], *({"kind": "weak", **each} for each in found["weak"])]
    directions.sort(key=lambda each: -each["tip_mm"])
    costly = [each for each in directions if each["cure"] != NOT_NEEDED]
    harmless = [each for each in directions if each["cure"] == NOT_NEEDED]
    opening = (
        f"The samples fix {found['rank']} of {count(found['unknowns'], 'combination')} of unknowns; "
        f"{len(found['null'])} they do not see at all (null), and {len(found['weak'])} less well than the prior (weak)."
    )
    return section(
        "unseen",
        "What the data cannot tell",
        paragraph(opening),
        _next(document) if document["cures"] else None,
        _costly(costly) if costly else None,
        _harmless(harmless) if harmless else None,
    )


def _next(document: Mapping[str, Any]) -> Markup:
    rows = [
        [each["words"], mm(each["expected_rms_mm"]), "yes" if each["recommended"] else "no"]
        for each in document["cures"]
    ]
    rows.append(["As it is", mm(document["tip"]["expected_rms_mm"]), "–"])
    columns = [("Extra touches", WORDS), ("Expected tip error, RMS", NUMBER), ("Recommended", WORDS)]
    return together(
        tag("h3", "What to do next"),
        paragraph(
            "Each was simulated with the arm as calibrated, put on top of the samples there are, and fitted with them. "
            "Planned touches are the best of those that were drawn; casacal plan --after chooses such ones, with new "
            "faces once they are in the problem file. The arm’s size may be known better than its prior and still be "
            "most of what remains. Not recommended is what gains little, or hardly more than 24 planned touches of the "
            "same kind."
        ),
        table("cures", "What to do next, best first, and the tip error to expect after it", columns, rows),
        None
        if any(each["recommended"] for each in document["cures"])
        else paragraph("None of these helps much.", style="note"),
    )


def _costly(directions: Sequence[Mapping[str, Any]]) -> Markup:
    rows = [
        [
            each["words"],
            each["kind"],
            "–" if math.isnan(each["tip_mm"]) else f"{each['tip_mm']:.2g}",
            each["cure"][:1].upper() + each["cure"][1:],
        ]
        for each in directions[:SHOWN]
    ]
    columns = [("What moves unseen", WORDS), ("Kind", WORDS), ("At the tip, mm", NUMBER), ("Cure", WORDS)]
    return together(
        paragraph(
            "Along each of these the arm may still be off by what the prior allows: “at the tip” is what one prior "
            "standard deviation does, RMS over the workspace. A cure is the best of what can be done next, found by "
            "simulating extra touches, that lowers it by half; “in part” lowers it by less."
        ),
        table("directions", "Directions that the samples do not fix", columns, rows, look="stacked"),
        _more(directions),
    )


def _harmless(directions: Sequence[Mapping[str, Any]]) -> Markup:
    items = [tag("li", f"{each['words']} ({each['kind']})") for each in directions[:SHOWN]]
    return together(
        tag("h3", "Without effect on the tip"),
        paragraph(
            "Apart from where the base stands, these change nothing at the tip under the prior, and need no cure:"
        ),
        tag("ul", *items, at={"id": "harmless"}),
        _more(directions),
    )


def _more(directions: Sequence[Mapping[str, Any]]) -> Markup | None:
    left = len(directions) - SHOWN
    return paragraph(f"{count(left, 'more direction')} in result.json.", style="note") if left > 0 else None

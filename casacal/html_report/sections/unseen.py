"""What the samples cannot tell, what that costs at the tip, and the cheapest cure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from casacal.calibration import NOT_NEEDED
from casacal.html_report.markup import Markup, paragraph, section
from casacal.html_report.numbers import count
from casacal.html_report.table import NUMBER, WORDS, table

SHOWN = 20
"""Directions with a line of their own."""
WEAK = "weak"


def unseen_section(document: Mapping[str, Any]) -> Markup:
    """Null and weak directions in words, the costly ones first."""
    found = document["identifiability"]
    directions = [*found["null"], *({"kind": WEAK, **each} for each in found["weak"])]
    directions.sort(key=lambda each: -each["tip_mm"])
    costly = [each for each in directions if each["cure"] != NOT_NEEDED]
    harmless = len(directions) - len(costly)
    opening = (
        f"The samples fix {found['rank']} of {count(found['unknowns'], 'combination')} of unknowns; "
        f"{len(found['null'])} they do not see at all (null), and {len(found['weak'])} less well than the prior (weak)."
    )
    if not costly:
        ending = "None of them moves the tip under the prior." if directions else "Nothing is left to the prior alone."
        return section("unseen", "What the data cannot tell", paragraph(opening), paragraph(ending))
    rows = [
        [each["words"], each["kind"], f"{each['tip_mm']:.2g}", each["cure"][:1].upper() + each["cure"][1:]]
        for each in costly[:SHOWN]
    ]
    columns = [("What moves unseen", WORDS), ("Kind", WORDS), ("At the tip, mm", NUMBER), ("Cheapest cure", WORDS)]
    rest = []
    if len(costly) > SHOWN:
        rest.append(f"{count(len(costly) - SHOWN, 'more direction')} of less weight in result.json.")
    if harmless:
        rest.append(f"{count(harmless, 'further direction')} without effect on the tip not listed.")
    return section(
        "unseen",
        "What the data cannot tell",
        paragraph(opening),
        paragraph(
            "Along each of these the arm may still be off by what the prior allows: “at the tip” is what one prior "
            "standard deviation does, RMS over the workspace. A cure is the cheapest change of the set-up, found by "
            "simulating extra touches, that would let the samples see it."
        ),
        table("directions", "Directions that the samples do not fix", columns, rows, stacked=True),
        paragraph(" ".join(rest), style="note") if rest else None,
    )

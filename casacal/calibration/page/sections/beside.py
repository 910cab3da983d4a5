"""What arm and cell may do beside their geometry: whether the samples show it, how large it is, what it would do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from casacal.calibration.corrections import VERY_STRONG
from casacal.calibration.page.markup import Markup, paragraph, section
from casacal.calibration.page.numbers import mm
from casacal.calibration.page.table import NUMBER, WORDS, table
from casacal.wording import sized


def beside_section(document: Mapping[str, Any]) -> Markup | None:
    """A line for each effect, the likeliest first; None where none was looked for."""
    tests = document["score_tests"]
    if not tests:
        return None
    rows = [
        [
            each["words"][:1].upper() + each["words"][1:],
            each["shown"],
            f"{each['p_holm']:.2g}",
            sized(each["size"], each["unit"]),
            _or_dash(each["expected_size"], each["unit"]),
            "–" if math.isnan(each["tip_mm"]) else mm(each["tip_mm"]),
        ]
        for each in tests
    ]
    columns = [
        ("Effect", WORDS),
        ("Do the samples show it?", WORDS),
        ("Chance without it", NUMBER),
        ("Likeliest size", NUMBER),
        ("To expect of any arm", NUMBER),
        ("At the tip, RMS", NUMBER),
    ]
    return section(
        "beside",
        "What arm and cell may do beside their geometry",
        paragraph(
            "Each was tested as if it were the only one, so that a large effect shows in the lines of others, too: "
            "these are “explained” by those that are shown. The chance is that of rows like these "
            "without any such effect, after all that was looked for. “At the tip” is what an effect of that "
            "size does where only the geometry is fitted."
        ),
        table("effects", "Effects beside the geometry, the likeliest first", columns, rows),
        *_tried(document["discrepancy"]),
    )


def _tried(part: Mapping[str, Any] | None) -> list[Markup]:
    """Which effects could be corrected, and which are."""
    tried = [] if part is None else part["tried"]
    if not tried:
        return []
    splits = list(dict.fromkeys(name for each in tried for name in each["unseen"]))
    rows = [
        [
            each["words"][:1].upper() + each["words"][1:],
            "yes" if each["corrected"] else "no",
            f"{each['evidence']:.1f}",
            *(f"{each['unseen'][name]:.1f}" if name in each["unseen"] else "–" for name in splits),
            {None: "–", True: "yes", False: "no"}[each["helps"]],
        ]
        for each in tried
    ]
    columns = [
        ("Effect", WORDS),
        ("Corrected?", WORDS),
        ("Gain, all rows", NUMBER),
        *((f"left out by {name}", NUMBER) for name in splits),
        ("Tip error smaller?", WORDS),
    ]
    return [
        paragraph(
            "What moves the tip and can be worked out from the joint values alone may be corrected, by "
            "casacal predict, compensate and the C export. That is done where it tells of rows that were left out "
            "of the fit: the logarithm of their density must gain more than "
            f"{VERY_STRONG:g} whatever is left out together, and the tip error to expect must be smaller."
        ),
        table("tried", "Corrections that were tried", columns, rows),
    ]


def _or_dash(value: float, unit: str) -> str:
    return "–" if math.isnan(value) else sized(value, unit)

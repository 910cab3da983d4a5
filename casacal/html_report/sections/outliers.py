"""Rows that fit worst, and those that a robust loss gave less weight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from casacal.html_report.markup import Markup, paragraph, section
from casacal.html_report.numbers import count, fixed, shortened
from casacal.html_report.table import NUMBER, WORDS, table
from casacal.html_report.touches import Part, Touches

SHOWN = 10
"""Rows listed."""
LINES = 60
"""Line numbers of down-weighted rows that are named."""
LARGE = 4.0
"""Whitened residual beyond which fewer than one in ten thousand good rows lie."""


def outliers_section(touches: Touches, document: Mapping[str, Any]) -> Markup:
    """The worst rows, most telling first; then those that the loss ignored."""
    worst: list[tuple[float, int, list[object]]] = []
    beyond = 0
    for part in touches.parts:
        white = np.abs(part.after / part.noise).max(axis=1)
        beyond += int((white > LARGE).sum())
        order = np.argsort(-white, kind="stable")[:SHOWN]
        worst += [(-float(white[i]), int(part.lines[i]), _row(part, int(i), float(white[i]))) for i in order]
    worst.sort(key=lambda entry: entry[:2])
    columns = [("Line", NUMBER), ("Face", WORDS), ("Rows", WORDS), ("Residual, mm", NUMBER), ("Times noise", NUMBER)]
    columns += [("Weight", NUMBER)]
    stands = "stands" if beyond == 1 else "stand"
    opening = f"{count(beyond, 'row')} {stands} more than {LARGE:g} times the stated noise off." if beyond else (
        f"No row stands more than {LARGE:g} times the stated noise off."
    )  # fmt: skip
    return section(
        "outliers",
        "Rows that fit worst",
        paragraph(opening + _hint(touches, beyond)),
        _ignored(touches, document["down_weighted_lines"]),
        table("worst-rows", "The rows with the largest residuals, by line of the file", columns,
              [row for _, _, row in worst[:SHOWN]]),
    )  # fmt: skip


def _hint(touches: Touches, beyond: int) -> str:
    if not beyond or touches.calibration.result.loss is not None:
        return ""
    return " Look at these lines; casacal check names likely causes, and --loss huber keeps gross rows from pulling."


def _row(part: Part, i: int, white: float) -> list[object]:
    component = int(np.argmax(np.abs(part.after[i] / part.noise[i])))
    labels = part.bound.samples[0].labels.get("plane")
    place = "–" if labels is None else shortened(labels[i], 40)
    weight = "–" if part.held else fixed(float(part.weight[i]), 2)
    return [
        f"{part.lines[i]}", place, "held out" if part.held else "fitted",
        fixed(float(part.after[i, component]), signed=True), fixed(white, 1), weight,
    ]  # fmt: skip


def _ignored(touches: Touches, lines: tuple[int, ...]) -> Markup | None:
    loss = touches.calibration.result.loss
    if loss is None:
        return None
    if not lines:
        return paragraph(f"The {loss.name} loss gave every row more than half of its weight.")
    named = ", ".join(str(line) for line in lines[:LINES])
    more = f" and {len(lines) - LINES:,} more" if len(lines) > LINES else ""
    return paragraph(
        f"The {loss.name} loss gave less than half of their weight to {count(len(lines), 'row')}: lines {named}{more}."
    )

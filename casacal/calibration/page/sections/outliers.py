"""Rows that fit worst, those that were set aside, and those that a robust loss gave less weight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casacal.calibration.page.markup import Markup, paragraph, section
from casacal.calibration.page.numbers import count, fixed, shortened
from casacal.calibration.page.table import NUMBER, WORDS, table
from casacal.calibration.page.touches import Part, Touches

SHOWN = 10
"""Rows listed."""
LINES = 60
"""Line numbers of down-weighted rows that are named."""
LARGE = 4.0
"""Whitened residual beyond which fewer than one in ten thousand good rows lie."""


def outliers_section(each: Sequence[Touches], document: Mapping[str, Any]) -> Markup:
    """The worst rows of all instruments, most telling first; then those that the loss ignored."""
    worst: list[tuple[float, int, list[object]]] = []
    beyond, touches = 0, each[0]
    for name, part in ((of.name, part) for of in each for part in of.parts):
        white = np.abs(part.after / part.noise).max(axis=1)
        beyond += int((white > LARGE).sum())
        order = np.argsort(-white, kind="stable")[:SHOWN]
        rows = [(-float(white[i]), int(part.lines[i]), _row(part, int(i), float(white[i]))) for i in order]
        worst += [(size, line, [f"{name} {row[0]}".strip(), *row[1:]]) for size, line, row in rows]
    worst.sort(key=lambda entry: entry[:2])
    columns = [
        ("Line", WORDS),
        (touches.calibration.fit.problem.words.group.capitalize(), WORDS),
        ("Rows", WORDS),
        ("Residual, mm", NUMBER),
        (f"Times {touches.calibration.noise_words}", NUMBER),
    ]
    if touches.calibration.result.loss is not None:
        columns.append(("Weight", NUMBER))
    shown = [row[: len(columns)] for _, _, row in worst[:SHOWN]]
    return section(
        "outliers",
        "Rows that fit worst",
        paragraph(_opening(touches, beyond)),
        _aside(touches.calibration.aside_lines),
        _ignored(touches, document["down_weighted_lines"]),
        table("worst-rows", "Largest residuals, by line of the file", columns, shown),
    )


def _opening(touches: Touches, beyond: int) -> str:
    noise = touches.calibration.noise_words
    if not beyond:
        return f"No row that is fitted or held out stands more than {LARGE:g} times the {noise} off."
    stands = "stands" if beyond == 1 else "stand"
    words = f"{count(beyond, 'row')} {stands} more than {LARGE:g} times the {noise} off."
    if touches.calibration.result.loss is None:
        words += " casacal check names likely causes, and --method lm --loss huber keeps gross rows from pulling."
    return words


def _row(part: Part, i: int, white: float) -> list[object]:
    component = int(np.argmax(np.abs(part.after[i] / part.noise[i])))
    labels = part.labels
    return [
        str(part.lines[i]),
        "–" if labels is None else shortened(labels[i], 40),
        "held\N{NO-BREAK SPACE}out" if part.held else "fitted",
        fixed(float(part.after[i, component]), signed=True),
        fixed(white, 1),
        "–" if part.held else fixed(float(part.weight[i]), 2),
    ]


def _aside(lines: tuple[int | str, ...]) -> Markup | None:
    if not lines:
        return None
    named = ", ".join(str(line) for line in lines[:LINES])
    more = f" and {len(lines) - LINES:,} more" if len(lines) > LINES else ""
    was = "was" if len(lines) == 1 else "were"
    word = "line" if len(lines) == 1 else "lines"
    return paragraph(
        f"{count(len(lines), 'row')} {was} set aside before the fit, and not listed here: {word} {named}{more}."
    )


def _ignored(touches: Touches, lines: tuple[int | str, ...]) -> Markup | None:
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

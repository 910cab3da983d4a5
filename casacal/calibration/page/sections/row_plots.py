"""Each row's residual in file order, face by face: drift, outliers and bad faces show here."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.calibration.page.drawing import Panel, Ticks, axes, dots, figure, line, nice_ceiling, picture
from casacal.calibration.page.markup import Markup
from casacal.calibration.page.numbers import shortened
from casacal.calibration.page.touches import TITLES, Part, Touches, When, spread, thinned

DRAWN = 1500
"""Points of one picture at most, but for the largest of each series."""
LARGEST = 10
"""Rows of each series that thinning must not hide."""
REACH = 8.0
"""Robust standard deviations beyond which a residual stands at the edge, so that it does not flatten all others."""
NAMED = 6
"""Series with their names under the axis."""
MOST_SERIES = 200
"""Series that are drawn; of more, some are, evenly spread."""
LINED = 30
"""Series with lines between them."""


def row_plots(touches: Touches) -> Markup:
    """Before and after, each on a scale of its own."""
    total = sum(part.after.size for part in touches.parts)
    some = f" Some of {total:,} points are drawn: evenly spread ones and the largest." if total > DRAWN else ""
    if len(touches.series) > MOST_SERIES:
        some = f" Of {len(touches.series):,} series {MOST_SERIES} are drawn."
    held = " Blue and grey dots are fitted rows, orange squares held-out ones." if len(touches.parts) > 1 else ""
    group = touches.instrument.words.group
    kind = group if touches.has_faces and len(touches.series) > 1 else "series"
    caption = (
        f"Residual of each row in file order, {kind} by {kind}, before and after on scales of their own: a slope is "
        f"drift, a lone point an outlier. Large black dots at the edge lie beyond it.{held}{some}"
    )
    return figure(caption, *(_by_row(touches, when) for when in TITLES))


def _by_row(touches: Touches, when: When) -> Markup:
    count = len(touches.series)
    everything = np.concatenate([part.residuals(when).ravel() for part in touches.parts])
    largest = float(np.abs(everything).max())
    top = nice_ceiling(min(largest, REACH * spread(everything)))
    panel = Panel((0.0, float(count)), (-top, top))
    drawn, beyond = [], []
    for part in touches.parts:
        x, y = _points(touches, part, when)
        inside = np.abs(y) <= top
        drawn.append(dots(panel, x[inside], y[inside], "dot held" if part.held else f"dot {when}"))
        beyond.append(dots(panel, x[~inside], top * np.sign(y[~inside]), "dot beyond"))
    order = "rows in file order" if touches.has_faces else "rows in file order, coordinate by coordinate"
    between = range(1, count) if count <= LINED else ()
    return picture(
        touches.named(f"rows-{when}"),
        f"{TITLES[when]}: residual of each row",
        f"Residuals row by row in file order for {count} series; the largest is {largest:.4f} mm.",
        panel.height,
        axes(panel, order, f"{TITLES[when]}: residual, mm", x_ticks=_names(touches)),
        *(line(panel, np.array([k, k], float), np.array([-top, top]), "grid") for k in between),
        line(panel, np.array([0.0, count]), np.zeros(2), "zero"),
        *drawn,
        *beyond,
    )


def _points(touches: Touches, part: Part, when: When) -> tuple[Array, Array]:
    """Places along the axis, one unit per series, and residuals of the rows that are drawn."""
    count, values = len(touches.series), part.residuals(when)
    most = max(DRAWN // (count * len(touches.parts)), 2)
    across, up = [np.zeros(0)], [np.zeros(0)]
    for k in np.unique(np.linspace(0, count - 1, MOST_SERIES).astype(int)).tolist():
        rows, component = touches.of_series(part, k)
        if len(rows):
            own = values[rows, component]
            largest = np.argsort(-np.abs(own), kind="stable")[:LARGEST]
            kept = np.union1d(thinned(np.arange(len(rows)), most), largest)
            across.append(k + 0.06 + 0.88 * (kept + 0.5) / len(rows))
            up.append(own[kept])
    return np.concatenate(across), np.concatenate(up)


def _names(touches: Touches) -> Ticks:
    count = len(touches.series)
    longest = max(3, 48 // count)
    return [(k + 0.5, shortened(name, longest)) for k, name in enumerate(touches.series)] if count <= NAMED else []

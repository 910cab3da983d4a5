"""Residuals before and after, on fitted and held-out rows: figures, histograms, row by row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.html_report.drawing import Panel, axes, bars, dots, figure, line, nice_ceiling, picture, steps
from casacal.html_report.markup import Markup, paragraph, section, tag
from casacal.html_report.numbers import fixed, shortened
from casacal.html_report.sections.face_maps import face_maps
from casacal.html_report.table import NUMBER, WORDS, table
from casacal.html_report.touches import Touches, thinned

Array: TypeAlias = NDArray[np.float64]
When: TypeAlias = Literal["before", "after"]

BINS = (15, 41)
"""Fewest and most bars of a histogram, odd, so that one stands about zero."""
DRAWN = 1500
"""Points of one picture at most."""
NAMED = 6
"""Series with their names under the axis."""
FIGURES = (("RMSE", "rmse_mm"), ("MAE", "mae_mm"), ("STD", "std_mm"), ("MAX", "max_mm"))
TITLES: Mapping[When, str] = {"before": "Before", "after": "After"}


def residuals_section(touches: Touches, document: Mapping[str, Any]) -> Markup:
    """Figures, histograms, rows and faces."""
    planes = touches.calibration.touches_planes
    what = "Distance of the touched points from their planes" if planes else "Predicted less measured coordinates"
    alone = "only the planes fitted, the arm as drawn" if planes else "only the station fitted, the arm as drawn"
    return section(
        "residuals",
        "Residuals before and after",
        paragraph(
            f"{what}. Before: {alone}. Small residuals are necessary but not sufficient: an arm can look perfect where "
            "it touched and be wrong elsewhere."
        ),
        _table(document),
        _noise(document["noise"]),
        figure(_histogram_caption(touches), *(_histogram(touches, when) for when in TITLES)),
        figure(_row_caption(touches), *(_by_row(touches, when) for when in TITLES)),
        face_maps(touches),
    )


def _table(document: Mapping[str, Any]) -> Markup:
    rows = []
    for when in TITLES:
        for part, words in (("fit", "fitted rows"), ("heldout", "held-out rows")):
            found = document["metrics"][when][part]
            if found is not None:
                rows.append([f"{TITLES[when]}, {words}", *(fixed(found[key]) for _, key in FIGURES)])
    columns = [("Rows", WORDS), *((f"{name}, mm", NUMBER) for name, _ in FIGURES)]
    return table("residual-figures", "Residuals, not accuracy", columns, rows)


def _noise(noise: Mapping[str, float]) -> Markup:
    ratio, low, high = (fixed(noise[key], 2) for key in ("ratio", "low", "high"))
    return paragraph(
        f"Found over stated noise: {ratio} (95 % {low} to {high}); 1 means that the noise was stated well."
    )


def _values(touches: Touches, when: When) -> list[Array]:
    return [part.before if when == "before" else part.after for part in touches.parts]


def _histogram(touches: Touches, when: When) -> Markup:
    """Shares of fitted rows as bars, of held-out rows as an outline; after, what the stated noise predicts."""
    found = [values.ravel() for values in _values(touches, when)]
    everything = np.concatenate(found)
    half = nice_ceiling(min(float(np.abs(everything).max()), 4.5 * 1.4826 * float(np.median(np.abs(everything)))))
    count = 2 * round(min(max(len(everything) ** (1 / 3), BINS[0] / 2), BINS[1] / 2) - 0.5) + 1
    edges = np.linspace(-half, half, count + 1)
    # rows beyond the axis stand in its outermost bars
    shares = [100 * np.histogram(np.clip(v, -half, half), edges)[0] / len(v) for v in found]
    curve = _expected(touches, edges) if when == "after" else np.zeros(0)
    top = 1.08 * max(float(np.concatenate([*shares, curve]).max()), 1.0)
    panel = Panel((-half, half), (0.0, top))
    middles = (edges[:-1] + edges[1:]) / 2
    beyond = int((np.abs(everything) > half).sum())
    name = f"histogram-{when}"
    says = (
        f"Histogram of {len(everything):,} residuals from {-half:g} to {half:g} mm, {beyond:,} of them beyond; "
        f"median size {np.median(np.abs(everything)):.4f} mm."
    )
    return picture(
        name,
        f"{TITLES[when]}: share of rows by residual",
        says,
        panel.height,
        axes(panel, "residual, mm", f"{TITLES[when]}: % of rows"),
        bars(panel, edges, shares[0], f"bar {when}"),
        steps(panel, edges, shares[1], "outline held") if len(shares) > 1 else None,
        line(panel, middles, curve, "expected") if len(curve) else None,
    )


def _expected(touches: Touches, edges: Array) -> Array:
    """Shares (bins,) that the stated noise of the rows predicts, without what fitting takes away; percent."""
    from scipy.stats import norm

    stds = np.concatenate([thinned(np.sort(part.noise.ravel()), DRAWN) for part in touches.parts])
    return np.asarray(100 * np.diff(norm.cdf(edges[:, None] / stds).mean(axis=1)))


def _histogram_caption(touches: Touches) -> Markup:
    held = (
        " The orange outline is held-out rows, which the fit did not see; it should look like the bars."
        if len(touches.parts) > 1
        else ""
    )
    return tag(
        "span",
        "Histogram of the residuals, before (left or above) and after, each on its own scale; values beyond the axis "
        f"stand in the outermost bars.{held} The dark line is what the stated noise predicts; fitted rows lie a little "
        "inside it.",
    )


def _by_row(touches: Touches, when: When) -> Markup:
    """Each row's residual in file order, series by series: drift, outliers and bad faces show here."""
    values, count = _values(touches, when), len(touches.series)
    most = max(DRAWN // (count * len(values)), 2)
    top = nice_ceiling(max(float(np.abs(v).max()) for v in values))
    panel = Panel((0.0, float(count)), (-top, top))
    drawn = []
    for part, own in zip(touches.parts, values, strict=True):
        across, up = [np.zeros(0)], [np.zeros(0)]
        for k in range(count):
            rows, component = touches.of_series(part, k)
            if not len(rows):
                continue
            size = np.abs(own[rows, component])
            largest = np.sort(np.argsort(-size, kind="stable")[:10])  # thinning must not hide an outlier
            kept = np.union1d(thinned(np.arange(len(rows)), most), largest)
            across.append(k + 0.06 + 0.88 * (kept + 0.5) / len(rows))
            up.append(own[rows[kept], component])
        look = "dot held" if part.held else f"dot {when}"
        drawn.append(dots(panel, np.concatenate(across), np.concatenate(up), look))
    longest = max(3, 48 // count)
    names = [(k + 0.5, shortened(name, longest)) for k, name in enumerate(touches.series)] if count <= NAMED else []
    return picture(
        f"rows-{when}",
        f"{TITLES[when]}: residual of each row",
        f"Residuals row by row in file order for {count} series; the largest is {top:g} mm or less.",
        panel.height,
        axes(panel, "rows in file order" if touches.has_faces else "rows in file order, coordinate by coordinate",
             f"{TITLES[when]}: residual, mm", x_ticks=names),
        *(line(panel, np.array([k, k], float), np.array([-top, top]), "grid") for k in range(1, count) if count < 30),
        line(panel, np.array([0.0, count]), np.zeros(2), "zero"),
        *drawn,
    )  # fmt: skip


def _row_caption(touches: Touches) -> Markup:
    total = sum(part.after.size for part in touches.parts)
    some = f" Some of {total:,} points are drawn: evenly spread ones and the largest." if total > DRAWN else ""
    held = " Blue and grey dots are fitted rows, orange squares held-out ones." if len(touches.parts) > 1 else ""
    kind = "face" if touches.has_faces and len(touches.series) > 1 else "series"
    return tag(
        "span",
        f"Residual of each row in file order, {kind} by {kind}, before and after on scales of their own: a slope is "
        f"drift, a lone point an outlier.{held}{some}",
    )

"""The residual over each face: form error, a loose face or a wrong label show as a pattern."""

from __future__ import annotations

import numpy as np

from casacal.calibration.page.colours import Scale
from casacal.calibration.page.drawing import Panel, axes, cells, dots, figure, picture
from casacal.calibration.page.markup import Markup, tag
from casacal.calibration.page.numbers import shortened
from casacal.calibration.page.squares import Squares, in_squares
from casacal.calibration.page.touches import Places, Touches

POINTS = 150
"""Touches of a face beyond which means over small squares are drawn in place of points."""
SQUARES = 14
"""Squares along the longer side of a face."""
MOST_MAPS = 12


def face_maps(touches: Touches) -> Markup | None:
    """One map per face, all on one scale; None where rows touch no face."""
    if not touches.has_faces or touches.instrument.probe is None:
        return None
    found = [(label, touches.places(label)) for label in touches.faces[:MOST_MAPS]]
    maps = [(label, places, _means(places)) for label, places in found if places is not None]
    if not maps:
        return None
    scale = Scale.of_signs(np.concatenate([p.residuals if m is None else m.values for _, p, m in maps]))
    pictures = [
        _map(touches.named(f"face-{k}"), label, places, means, scale) for k, (label, places, means) in enumerate(maps)
    ]
    some, pointed = any(means for *_, means in maps), any(means is None for *_, means in maps)
    words = ["Residual after the fit over each face; u and v are seen from the tool."]
    if pointed and len(touches.parts) > 1:
        words.append("Square points are held-out rows.")
    if some:
        words.append("Where touches are many, each square is their mean.")
    words.append(
        "Patches of one colour: a face that is not flat or moved, or an effect that the model does not describe."
    )
    if len(touches.faces) > len(maps):
        words.append(f"{len(touches.faces) - len(maps)} more are not drawn.")
    key = scale.key(touches.named("face-key"), "residual after, mm")
    return tag("div", tag("h3", "Over each face"), figure(" ".join(words), *pictures, key=key))


def _means(places: Places) -> Squares | None:
    return in_squares(places.uv, places.residuals, SQUARES) if len(places.uv) > POINTS else None


def _map(name: str, label: str, places: Places, means: Squares | None, scale: Scale) -> Markup:
    low, high = places.uv.min(axis=0), places.uv.max(axis=0)
    edge = 0.08 * float((high - low).max())
    panel = Panel.square((low[0] - edge, high[0] + edge), (low[1] - edge, high[1] + edge), tallest=250.0)
    size = np.abs(places.residuals)
    return picture(
        name,
        f"Residual over face {label}",
        f"{len(size):,} touches; the largest residual is {size.max():.4f} mm.",
        panel.height,
        axes(
            panel,
            "u, mm (level)" if places.upright else "u, mm (along the base's x)",
            f"{shortened(label, 28)}: v, mm" + (" (up)" if places.upright else ""),
            upright=True,
        ),
        *(_points(panel, places, scale) if means is None else _squares(panel, means, scale)),
    )


def _points(panel: Panel, places: Places, scale: Scale) -> list[Markup | None]:
    drawn = []
    for colour, rows in scale.parts(places.residuals):
        for held, look in ((False, "spot"), (True, "spot square")):
            here = rows[places.held[rows] == held]
            drawn.append(dots(panel, places.uv[here, 0], places.uv[here, 1], look, colour=colour))
    return drawn


def _squares(panel: Panel, means: Squares, scale: Scale) -> list[Markup | None]:
    return [
        cells(panel, means.x[rows], means.y[rows], means.side, colour) for colour, rows in scale.parts(means.values)
    ]

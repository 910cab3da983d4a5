"""The residual over each face: form error, a loose face or a wrong label show as a pattern."""

from __future__ import annotations

import numpy as np

from casacal.html_report.colours import Scale
from casacal.html_report.drawing import Panel, axes, dots, figure, picture
from casacal.html_report.markup import Markup, tag
from casacal.html_report.numbers import shortened
from casacal.html_report.touches import Places, Touches

DRAWN = 1200
"""Points of all maps together, at most."""
MOST_MAPS = 12


def face_maps(touches: Touches) -> Markup | None:
    """A map a face, all on one scale; None where rows touch no face."""
    if not touches.has_faces or not touches.calibration.touches_planes:
        return None
    labels = touches.faces[:MOST_MAPS]
    found = [(label, touches.places(label, DRAWN // len(labels))) for label in labels]
    maps = [(label, places) for label, places in found if places is not None]
    if not maps:
        return None
    scale = Scale.of_signs(np.concatenate([places.residuals for _, places in maps]))
    left = len(touches.faces) - len(maps)
    rest = f" {left} more are not drawn." if left else ""
    held = "squares are held-out rows, " if len(touches.parts) > 1 else ""
    caption = (
        f"Residual after the fit over each face, mm; {held}u and v are seen from the tool. Patches of one colour mean "
        f"that a face is not flat, moved, or that the model lacks something.{rest}"
    )
    pictures = [_map(k, label, places, scale) for k, (label, places) in enumerate(maps)]
    return tag(
        "div",
        tag("h3", "Over each face"),
        figure(caption, *pictures, key=scale.key("face-key", "residual after, mm")),
    )


def _map(k: int, label: str, places: Places, scale: Scale) -> Markup:
    low, high = places.uv.min(axis=0), places.uv.max(axis=0)
    edge = 0.06 * float((high - low).max())
    panel = Panel.square((low[0] - edge, high[0] + edge), (low[1] - edge, high[1] + edge), tallest=250.0)
    points = []
    for colour, rows in scale.parts(places.residuals):
        for held, look in ((False, "spot"), (True, "spot square")):
            here = rows[places.held[rows] == held]
            points.append(dots(panel, places.uv[here, 0], places.uv[here, 1], look, colour=colour))
    size = np.abs(places.residuals)
    return picture(
        f"face-{k}",
        f"Residual over face {label}",
        f"{len(size)} touches; the largest residual is {size.max():.4f} mm.",
        panel.height,
        axes(
            panel,
            "u, mm (level)" if places.upright else "u, mm (along the base's x)",
            f"{shortened(label, 28)}: v, mm" + (" (up)" if places.upright else ""),
            upright=True,
        ),
        *points,
    )

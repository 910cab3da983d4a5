"""The tip error to expect, and the correction, over the workspace: figures and maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.calibration.calibration import Calibration
from casacal.calibration.motion import tip_extremes
from casacal.calibration.page.colours import Scale
from casacal.calibration.page.drawing import Panel, axes, cells, dots, figure, line, picture
from casacal.calibration.page.markup import Markup, paragraph, section, tag
from casacal.calibration.page.numbers import count, mm
from casacal.calibration.page.squares import in_squares
from casacal.calibration.page.table import NUMBER, WORDS, table
from casacal.calibration.page.touches import Touches
from casacal.calibration.page.workspace import POSTURES, Workspace, side_view, top_view
from casacal.uncertainty.expectation import Box, accuracy_in_box

SQUARES = 24
"""Squares along the longer side of a view."""
MARKED = 240
"""Touches drawn on the maps, of all faces together."""


def expected_section(each: Sequence[Touches], document: Mapping[str, Any], box: Box | None) -> Markup:
    """Figures, then a side view and a top view of error and correction."""
    title = "Tip error to expect over the workspace"
    if document["verdict"]["level"] == "do not use":
        words = "Not stated: a figure would be worth nothing while the verdict is not to use this result."
        return section("expected", title, paragraph(words))
    calibration = each[0].calibration
    workspace = Workspace.of(calibration)
    faces = [
        touches.places(label, max(MARKED // (len(each) * len(touches.faces)), 3))
        for touches in each
        for label in touches.faces[:MARKED]
    ]
    marks = np.vstack([np.zeros((0, 3)), *(places.tips for places in faces if places is not None)])
    return section(
        "expected",
        title,
        paragraph(
            "This, not the residual, is the arm's accuracy as far as the samples can tell: the standard deviation "
            "of the tip, its three axes together, apart from where the base stands, which the samples cannot see; it "
            f"holds if {calibration.assumed} are right and nothing bends that the model does not know."
        ),
        _figures(calibration, document, box),
        _maps("error", "expected tip error, mm", workspace.tips, workspace.error, marks, box),
        _maps("correction", "distance of the calibrated from the nominal tip, mm", workspace.tips,
              workspace.correction, marks, box),
    )  # fmt: skip


def _figures(calibration: Calibration, document: Mapping[str, Any], box: Box | None) -> Markup:
    tip = document["tip"]
    moved, worst = tip_extremes(calibration.motion, calibration.workspace)
    unseen = f", {count(tip['unseen'], 'direction')} unseen" if tip["unseen"] else ""
    rows = [
        ["Before: priors alone", mm(tip["prior_rms_mm"]), "–"],
        ["After: samples and priors", mm(tip["expected_rms_mm"]), mm(worst)],
        [f"Samples alone, without priors{unseen}", mm(tip["without_prior_rms_mm"]), "–"],
    ]
    if box is not None:
        motion = calibration.motion
        rms, most = accuracy_in_box(motion.arm, motion.x, box, motion.off)
        ranges = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", box, strict=True))
        rows.append([f"After, inside the box {ranges} mm", mm(rms), mm(most)])
    columns = [("Expected tip error", WORDS), ("RMS", NUMBER), ("Worst posture", NUMBER)]
    return tag(
        "div",
        table("tip-figures", "Expected tip error over the workspace", columns, rows, look="small"),
        paragraph(f"The largest correction in the workspace is {mm(moved)}.", style="note"),
    )


def _maps(name: str, words: str, tips: Array, values: Array, marks: Array, box: Box | None) -> Markup:
    finite = bool(np.isfinite(values).all())
    scale = Scale.of_sizes(values)
    title = "Expected tip error" if name == "error" else "Correction"
    caption = {
        "error": f"Expected tip error after calibration, from {POSTURES:,} random postures within the joint limits; "
        "black dots are where it touched. Each square is the RMS over the postures that lead there. Verify where it is "
        "dark before you rely on it.",
        "correction": "How far the calibrated tip lies from the nominal one, apart from where the base stands: what "
        "the calibration changes.",
    }[name]
    if box is not None:
        caption += " The black frame is the box that was asked for."
    return tag(
        "div",
        tag("h3", title),
        figure(
            caption,
            _view(f"{name}-side", f"{title}, side view", side_view, tips, values, marks, None, scale),
            _view(f"{name}-top", f"{title}, top view", top_view, tips, values, marks, box, scale),
            key=scale.key(f"{name}-key", words, unbounded=not finite),
        ),
    )


def _view(
    name: str,
    title: str,
    view: Callable[[Array], Array],
    tips: Array,
    values: Array,
    marks: Array,
    box: Box | None,
    scale: Scale,
) -> Markup:
    points, seen = view(tips), view(marks)
    squares = in_squares(points, values**2, SQUARES)
    panel = Panel.square(
        (float(squares.x.min()), float(squares.x.max()) + squares.side),
        (float(squares.y.min()), float(squares.y.max()) + squares.side),
    )
    parts = [
        cells(panel, squares.x[rows], squares.y[rows], squares.side, colour)
        for colour, rows in scale.parts(np.sqrt(squares.values))
    ]
    frame = None
    if box is not None:
        (x0, x1), (y0, y1), _ = box
        frame = line(panel, np.array([x0, x1, x1, x0, x0]), np.array([y0, y0, y1, y1, y0]), "box")
    titles = ("distance from the base's axis, mm", "height, mm") if view is side_view else ("x, mm", "y, mm")
    return picture(
        name,
        title,
        f"Root mean square by square of {squares.side:.0f} mm; from {mm(values.min())} to {mm(values.max())}.",
        panel.height,
        axes(panel, titles[0], f"{title.partition(', ')[2]}: {titles[1]}", upright=True),
        *parts,
        dots(panel, seen[:, 0], seen[:, 1], "touch-halo"),
        dots(panel, seen[:, 0], seen[:, 1], "touch"),
        frame,
    )

"""The expected tip error and the correction over the workspace: figures and maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from casacal.array_types import Array
from casacal.calibration.calibration import Calibration
from casacal.calibration.motion import tip_extremes
from casacal.calibration.page.touches import Touches
from casacal.pages.drawing import Panel, Scale, axes, cells, count, dots, figure, in_squares, line, mm, picture
from casacal.uncertainty.expectation import Box, accuracy_in_box
from casacal.uncertainty.workspace import tip_stds, up_to_base, workspace_joints
from casacal.wording import METRE

SQUARES = 24  # squares along the longer side of a view
MARKED = 240  # touches drawn on the maps, of all faces together
POSTURES = 8192  # random postures within the joint limits that the map is made of; a multiple of the kernels' block


TITLES = {"error": "Expected tip error", "correction": "Correction"}
CAPTIONS = {
    "error": f"Expected tip error after calibration, from {POSTURES:,} random postures within the joint limits; "
    "black dots are where it touched. Each square is the RMS over the postures that lead there. Verify where it is "
    "dark before you rely on it.",
    "correction": "How far the calibrated tip lies from the nominal one, apart from the position of the base: what "
    "the calibration changes.",
}


def expected_error(each: Sequence[Touches], box: Box | None) -> dict[str, Any]:
    """Rows of the table of figures, the largest correction, and maps of error and correction from two sides."""
    calibration = each[0].calibration
    workspace = Workspace.of(calibration)
    faces = [
        touches.places(label, max(MARKED // (len(each) * len(touches.faces)), 3))
        for touches in each
        for label in touches.faces[:MARKED]
    ]
    marks = np.vstack([np.zeros((0, 3)), *(places.tips for places in faces if places is not None)])
    moved, worst = tip_extremes(calibration.motion, calibration.workspace)
    (before, now), (alone, missed) = calibration.tip_std, calibration.tip_std_without_prior
    unseen = f", {count(missed, 'direction')} unseen" if missed else ""
    rows = [
        ["Before: priors alone", mm(before), "–"],
        ["After: samples and priors", mm(now), mm(worst)],
        [f"Samples alone, without priors{unseen}", mm(alone) if alone < METRE else "unbounded", "–"],
    ]
    if box is not None:
        motion = calibration.motion
        rms, most = accuracy_in_box(motion.arm, motion.x, box, motion.off)
        ranges = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", box, strict=True))
        rows.append([f"After, inside the box {ranges} mm", mm(rms), mm(most)])
    error = _maps("error", "expected tip error, mm", workspace.error, workspace.tips, marks, box)
    words = "distance of the calibrated from the nominal tip, mm"
    correction = _maps("correction", words, workspace.correction, workspace.tips, marks, box)
    return {"rows": rows, "moved": moved, "maps": [(TITLES["error"], error), (TITLES["correction"], correction)]}


def _maps(name: str, words: str, values: Array, tips: Array, marks: Array, box: Box | None) -> Markup:
    """Values (N,) at tips from the side and from the top, where the box is drawn."""
    scale, title = Scale.of_sizes(values), TITLES[name]
    caption = CAPTIONS[name] + (" The black frame is the box that was asked for." if box is not None else "")

    def view(side: str, points: Array, seen: Array, across: str, up: str, *drawn: Box) -> Markup:
        squares = in_squares(points, values**2, SQUARES)
        panel = Panel.square(
            (float(squares.x.min()), float(squares.x.max()) + squares.side),
            (float(squares.y.min()), float(squares.y.max()) + squares.side),
        )
        parts = [
            cells(panel, squares.x[rows], squares.y[rows], squares.side, colour)
            for colour, rows in scale.parts(np.sqrt(squares.values))
        ]
        frames = [
            line(panel, np.array([x0, x1, x1, x0, x0]), np.array([y0, y0, y1, y1, y0]), "box")
            for (x0, x1), (y0, y1), _ in drawn
        ]
        return picture(
            f"{name}-{side}",
            f"{title}, {side} view",
            f"Root mean square by square of {squares.side:.0f} mm; from {mm(values.min())} to {mm(values.max())}.",
            panel.height,
            axes(panel, across, f"{side} view: {up}", upright=True),
            *parts,
            *(dots(panel, seen[:, 0], seen[:, 1], look) for look in ("touch-halo", "touch")),
            *frames,
        )

    of_tips, of_marks = (np.column_stack([np.hypot(*each[:, :2].T), each[:, 2]]) for each in (tips, marks))
    return figure(
        caption,
        view("side", of_tips, of_marks, "distance from the base's axis, mm", "height, mm"),
        view("top", tips[:, :2], marks[:, :2], "x, mm", "y, mm", *([] if box is None else [box])),
        key=scale.key(f"{name}-key", words, unbounded=not bool(np.isfinite(values).all())),
    )


@dataclass(frozen=True)
class Workspace:
    """Tips (N, 3) of random postures, and at each the expected error and the correction (N,), all mm.

    Both apart from the position of the base. The error is the standard deviation, its three axes together; the
    correction is how far the calibrated tip lies from the nominal one.
    """

    tips: Array
    error: Array
    correction: Array

    @staticmethod
    def of(calibration: Calibration) -> Workspace:
        """Over postures of its own; the base frame is that of the postures that the summary's figure is of."""
        motion = calibration.motion
        arm, x = motion.arm, motion.x
        frame_joints, frame_tips, frame_slopes = calibration.workspace
        joints = workspace_joints(arm.problem.robot, poses=POSTURES, seed=1)
        tips, slopes = arm.tips(x, joints), arm.tip_jacobian(x, joints)
        field = up_to_base(slopes, tips, frame_slopes, frame_tips)
        error = np.linalg.norm(tip_stds(motion.covariance, field, motion.off), axis=1)
        moved = (tips - arm.tips(arm.x0, joints)).reshape(-1, 1)
        frame_moved = (frame_tips - arm.tips(arm.x0, frame_joints)).reshape(-1, 1)
        correction = np.linalg.norm(up_to_base(moved, tips, frame_moved, frame_tips).reshape(-1, 3), axis=1)
        return Workspace(tips, error, correction)

"""Pictures of a calibration; each function draws on an axes that is passed in."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from casacal.calibration.calibration import Calibration
from casacal.files import place_whole
from casacal.public import __version__
from casacal.uncertainty.tip_error import tip_stds, without_rigid

FILTER_POINTS = 60  # rows at which a filter's objective is drawn
FLOOR = 1e-9  # added so that the lowest value itself can stand on a logarithmic axis; below rounding
NAMED = 24  # faces named under a picture; of more, some are
LINED = 200  # faces with a line between them
LONGEST = 24  # characters of a label in a picture
BEFORE, AFTER, HELD = "#b8b8b8", "#1f6fb2", "#d1622b"


def plot_residuals(calibration: Calibration, axes: Any) -> None:
    """Distances of the tips from their planes (mm), before and after, row by row, plane by plane."""
    offset, ticks, ends = 0, [], []
    parts = [("", calibration.fit, (calibration.before.x, calibration.used_x), AFTER)]
    if calibration.heldout is not None:
        parts.append((" (held out)", calibration.heldout, calibration.heldout_x, HELD))
    for suffix, bound, pair, colour in parts:
        faces = bound.faces
        before, after = (bound.plain_residual(x) for x in pair)
        order, places = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
        for label, rows in faces.rows().items():
            own = bound.residuals_of(rows)
            count = own.size
            order.append(own)
            places.append(offset + np.arange(count))
            ticks.append((offset + count / 2, f"{_short(label)}{suffix}"))
            offset += count + 4
            ends.append(offset - 2.5)
        here, rows = np.concatenate(places), np.concatenate(order)
        axes.plot(here, before[rows], "o", ms=3, mfc="none", mec=BEFORE, zorder=1)
        axes.plot(here, after[rows], "o", ms=3, color=colour, zorder=2)
    if len(ends) <= LINED:
        axes.vlines(ends, 0, 1, colors="0.9", linewidth=0.8, zorder=0, transform=axes.get_xaxis_transform())
    axes.axhline(0, color="0.5", lw=0.8, zorder=0)
    ticks = [ticks[k] for k in np.unique(np.linspace(0, len(ticks) - 1, NAMED).astype(int))]
    axes.set_xticks([place for place, _ in ticks], [label for _, label in ticks], rotation=20, ha="right", fontsize=8)
    said = calibration.fit.problem.words
    axes.set_ylabel(f"{said.residual}, {said.unit}")
    axes.plot([], [], "o", ms=4, mfc="none", mec=BEFORE, label=f"before: {said.before}")
    axes.plot([], [], "o", ms=4, color=AFTER, label="after, fitted rows")
    if calibration.heldout is not None:
        axes.plot([], [], "o", ms=4, color=HELD, label="after, held-out rows")
    axes.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
    axes.set_title("Residuals, which are not accuracy", fontsize=10, loc="right")


def plot_convergence(calibration: Calibration, axes: Any) -> None:
    """The objective above its lowest value, step by step; a filter's pass over the rows stands before step 0."""
    trace, problem = calibration.result.trace, calibration.fit
    curves: list[tuple[Any, Any, str, str]] = []
    path = trace.get("filter_x", trace.get("x"))
    if path is not None:
        rows = np.unique(np.linspace(0, len(path) - 1, FILTER_POINTS).astype(int))
        costs = np.array([problem.cost(path[row]) for row in rows])
        curves.append((rows / max(len(path) - 1, 1) - 1, costs, "-", "filter, one pass over the rows"))
    if "cost" in trace:
        curves.append((np.arange(trace["cost"].size), trace["cost"], "o-", calibration.method))
    if not curves:
        axes.set_title("Nothing was estimated, so nothing converged", fontsize=10)
        axes.set_axis_off()
        return
    lowest = min(float(costs.min()) for _, costs, _, _ in curves)
    for (places, costs, style, label), colour in zip(curves, (HELD, AFTER)[-len(curves) :], strict=True):
        axes.plot(places, costs - lowest + FLOOR, style, ms=4, color=colour, label=label)
    axes.set_yscale("log")
    axes.set_xlabel("step")
    axes.set_ylabel("objective above its lowest value")
    axes.legend(fontsize=8, frameon=False)
    axes.set_title(f"Convergence of {calibration.method}", fontsize=10)


def plot_tip_std(calibration: Calibration, axes: Any) -> None:
    """Standard deviation of the tip (mm, all axes, apart from the position of the base) over radius and height."""
    _, tips, slopes = calibration.workspace
    spread = np.linalg.norm(
        tip_stds(calibration.motion.covariance, without_rigid(slopes, tips), calibration.motion.off), axis=1
    )
    radius = np.hypot(tips[:, 0], tips[:, 1])
    order = np.argsort(spread)  # the worst on top
    shown = axes.scatter(radius[order], tips[order, 2], c=spread[order], s=18, cmap="viridis")
    axes.figure.colorbar(shown, ax=axes, label="standard deviation of the tip, mm")
    axes.set_xlabel("distance from the first axis, mm")
    axes.set_ylabel("height, mm")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("How uncertain the tip is, apart from the position of the base", fontsize=10)


def _short(label: str) -> str:
    """Label that leaves room for the picture, and of which Matplotlib makes no formula."""
    return (label if len(label) <= LONGEST else f"{label[: LONGEST - 1]}…").replace("$", r"\$")


def save_plots(calibration: Calibration, folder: Path) -> None:
    """Write residuals.png and convergence.png into a folder."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    for name, draw, size in (("residuals", plot_residuals, (10.0, 4.0)), ("convergence", plot_convergence, (6.0, 4.0))):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        draw(calibration, figure.subplots())
        # no date in the file: the same input gives the same bytes
        save = partial(figure.savefig, dpi=150, metadata={"Software": f"casacal {__version__}"})
        place_whole(folder / f"{name}.png", save)

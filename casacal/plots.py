"""Pictures of a calibration; each function draws on an axes that is passed in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from casacal.calibration import Calibration
from casacal.files import place_whole
from casacal.samples import ordered_labels

BEFORE, AFTER, HELD = "#b8b8b8", "#1f6fb2", "#d1622b"


def plot_residuals(calibration: Calibration, axes: Any) -> None:
    """Distances of the tips from their planes (mm), before and after, row by row, plane by plane."""
    offset = 0
    ticks = []
    parts = [("", calibration.fit, AFTER)]
    if calibration.heldout is not None:
        parts.append((" (held out)", calibration.heldout, HELD))
    for suffix, bound, colour in parts:
        labels = np.array(bound.samples[0].labels.get("plane", ("plane",) * len(bound.samples[0])))
        per_row = bound.rows // len(labels)
        before, after = bound.plain_residual(calibration.before.x), bound.plain_residual(calibration.result.x)
        for label in ordered_labels(labels.tolist()):
            rows = np.flatnonzero(np.repeat(labels == label, per_row))
            places = offset + np.arange(len(rows))
            axes.plot(places, before[rows], "o", ms=3, mfc="none", mec=BEFORE, zorder=1)
            axes.plot(places, after[rows], "o", ms=3, color=colour, zorder=2)
            ticks.append((offset + len(rows) / 2, f"{label}{suffix}"))
            offset += len(rows) + 4
            axes.axvline(offset - 2.5, color="0.9", lw=0.8, zorder=0)
    axes.axhline(0, color="0.5", lw=0.8, zorder=0)
    axes.set_xticks([place for place, _ in ticks], [label for _, label in ticks], rotation=20, ha="right", fontsize=8)
    axes.set_ylabel("distance from the plane, mm")
    axes.plot([], [], "o", ms=4, mfc="none", mec=BEFORE, label="before: planes fitted alone")
    axes.plot([], [], "o", ms=4, color=AFTER, label="after, fitted rows")
    if calibration.heldout is not None:
        axes.plot([], [], "o", ms=4, color=HELD, label="after, held-out rows")
    axes.legend(fontsize=8, frameon=False, loc="upper right", ncols=3)
    axes.set_title("Distance from the touched planes (a residual, not accuracy)", fontsize=10)


def plot_convergence(calibration: Calibration, axes: Any) -> None:
    """The objective, step by step; for a filter the innovations, row by row, with their own two-sigma band."""
    trace = calibration.result.trace
    if "cost" in trace:
        steps = np.arange(trace["cost"].size)
        axes.semilogy(steps, trace["cost"], "o-", color=AFTER, ms=4)
        axes.set_xlabel("step")
        axes.set_ylabel("objective, log scale")
    else:
        rows = np.arange(1, trace["innovation"].size + 1)
        band = 2 * trace["innovation_std"]
        axes.fill_between(rows, -band, band, color=BEFORE, alpha=0.4, lw=0, label="two standard deviations expected")
        axes.plot(rows, trace["innovation"], ".", color=AFTER, ms=4, label="innovation")
        axes.set_yscale("symlog", linthresh=3)
        axes.set_xlabel("row")
        axes.set_ylabel("innovation, in standard deviations of the reading")
        axes.legend(fontsize=8, frameon=False)
    axes.set_title(f"Convergence of {calibration.method}", fontsize=10)


def save_plots(calibration: Calibration, folder: Path) -> list[Path]:
    """Write residuals.png and convergence.png into a folder; returns their paths."""
    return [
        _save(folder / "residuals.png", plot_residuals, calibration, (10.0, 4.0)),
        _save(folder / "convergence.png", plot_convergence, calibration, (6.0, 4.0)),
    ]


def _save(path: Path, draw: Any, calibration: Calibration, size: tuple[float, float]) -> Path:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    draw(calibration, figure.subplots())
    # no software or date in the file: the same input gives the same bytes
    place_whole(path, lambda place: figure.savefig(place, dpi=150, metadata={"Software": None}))
    return path

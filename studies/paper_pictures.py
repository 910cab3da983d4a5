"""Figures 3, 4 and 5 of the paper, drawn from records, and the curve of cost over budget."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from casacal.study import Run
from casacal.study.statistics import Interval, mean_interval
from studies import rivals
from studies.paper_tables import best_cost
from studies.reporting import figure, save, save_both, shared_legend

COLOURS = {
    rivals.BEFORE: "#9a9a9a", rivals.PLANES: "#8c8c8c", "M1 annealing": "#d1622b", "M2 swarm": "#e0a030",
    rivals.EKF: "#7a9a3a", "M4 evolution": "#a8577e", rivals.SCKF: "#3aa28f", rivals.LM: "#1f6fb2",
    rivals.BOTH: "#123a63", rivals.IPOPT: "#5b4a9e",
}  # fmt: skip
ROWS = {"heldout_rmse_mm": "plane RMSE", "heldout_std_mm": "plane STD", "heldout_max_mm": "plane MAX",
        "tip_rms_mm": "true tip RMS"}  # fmt: skip
LEAST = 1e-6
"""Objective above the best of a trial that is drawn as the least: rounding."""


def base(method: str) -> str:
    """The method without its budget."""
    return method.split(",")[0]


def headline(run: Run, methods: list[str], settings: tuple[str, str], path: Path) -> None:
    """What one sees beside what one wants, in the paper's cell and in a good one; all methods on the same trials."""
    made, count = figure(9, 3.6), common(run, methods)
    panels = made.subplots(1, 2, sharey=True)
    kinds = {
        "heldout_rmse_mm": ("plane residual of held-out touches, mm", (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)),
        "tip_rms_mm": ("true tip error, mm", (0.5, 1, 2, 5)),
    }
    for axes, (name, (words, ticks)) in zip(panels, kinds.items(), strict=True):
        for setting, marker in zip(settings, ("o", "s"), strict=True):
            found = [mean_interval(finite(run.values(setting, method, name)[:count])) for method in methods]
            spans = np.array([[i.value - i.low, i.high - i.value] for i in found]).T
            shift = 0.14 if marker == "s" else -0.14
            for place, method in enumerate(methods):
                axes.errorbar(found[place].value, place + shift, xerr=spans[:, [place]], fmt=marker, ms=5, lw=1,
                              mfc="white" if marker == "o" else None, color=COLOURS[base(method)])  # fmt: skip
            axes.plot([], [], marker, color="0.3", mfc="white" if marker == "o" else None, label=setting)
        axes.set_xscale("log")
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set_xlabel(words)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_yticks(range(len(methods)), [base(method) for method in methods])
    panels[0].invert_yaxis()
    shared_legend(made, 2)
    save(made, path)


def common(run: Run, methods: list[str]) -> int:
    """Number of first trials in which all these methods took part: what pictures compare."""
    return min(run.study.trials_of(method) for method in methods)


def dotted(axes: Axes, found: list[Interval], methods: list[str], shift: float = 0.0) -> None:
    """Dots with intervals on a log axis, a method each."""
    for place, (interval, method) in enumerate(zip(found, methods, strict=True)):
        span = [[interval.value - interval.low], [interval.high - interval.value]]
        axes.errorbar(place + shift, interval.value, yerr=span, fmt="o", ms=5, lw=1.2, color=COLOURS[base(method)])
    axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", lw=0.4, alpha=0.5)


def dots(run: Run, methods: list[str], path: Path) -> None:
    """Figure 3: RMSE, STD, MAX on held-out touches, and true tip error, with intervals, on the same trials."""
    made, count = figure(3.6 * len(run.study.settings) + 1, 9), common(run, methods)
    panels = made.subplots(len(ROWS), len(run.study.settings), sharex=True, squeeze=False)
    for column, setting in enumerate(run.study.settings):
        for row, (name, words) in enumerate(ROWS.items()):
            axes = panels[row][column]
            dotted(axes, [mean_interval(finite(run.values(setting, m, name)[:count])) for m in methods], methods)
            if column == 0:
                axes.set_ylabel(f"{words}, mm")
            if row == 0:
                axes.set_title(setting, fontsize=10)
        names = [base(method).split(" ")[0] for method in methods]
        panels[-1][column].set_xticks(range(len(methods)), names, rotation=60, fontsize=8)
    save_both(made, path)


def training(run: Run, methods: list[str], path: Path) -> None:
    """Figure 4: (a) M1, M2, M3; (b) M4, M5, M6, M7; (c) time of a calibration."""
    made = figure(12, 3.2 * len(run.study.settings) + 0.5)
    panels = made.subplots(len(run.study.settings), 3, squeeze=False)
    groups = (("M1 annealing", "M2 swarm", rivals.EKF), ("M4 evolution", rivals.SCKF, rivals.LM, rivals.BOTH))
    for row, setting in zip(panels, run.study.settings, strict=True):
        for axes, group in zip(row, groups, strict=False):
            for method in (method for method in methods if base(method) in group):
                curve = median_curve(run, setting, method)
                style = {"ls": "--", "zorder": 3} if method == rivals.SCKF else {}
                axes.loglog(*curve, label=base(method), color=COLOURS[base(method)], lw=1.3, **style)
            axes.set_xlabel("rows of residuals")
        row[0].set_ylabel("objective above the best")
        row[0].set_title(f"(a) {setting}", fontsize=10)
        row[1].set_title("(b)", fontsize=10)
        timed = [method for method in methods if method != rivals.BEFORE]
        for place, method in enumerate(timed):
            low, middle, high = np.nanquantile(run.values(setting, method, "cpu", group="seconds"), (0.05, 0.5, 0.95))
            row[2].errorbar(middle, place, xerr=[[middle - low], [high - middle]], fmt="o", ms=5, lw=1.2,
                            color=COLOURS[base(method)])  # fmt: skip
        row[2].set_yticks(range(len(timed)), [base(method) for method in timed])
        row[2].set_xscale("log")
        row[2].set_xlabel("seconds of one processor")
        row[2].set_title("(c)", fontsize=10)
        row[2].invert_yaxis()
    shared_legend(made, 7)
    save_both(made, path)


def median_curve(run: Run, setting: str, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Median over the detailed trials of the objective above the best of the trial, at common rows."""
    curves = []
    for record in run.of(setting, method):
        if record.get("trace"):
            trace = np.array(record["trace"])
            best = best_cost(run, setting)[record["trial"]]
            curves.append((np.maximum(trace[:, 0], 1), np.maximum(trace[:, 2] - best, LEAST)))
    ends = [rows[-1] for rows, _ in curves]
    grid = np.geomspace(min(rows[0] for rows, _ in curves), max(ends), 120)
    # each curve is a staircase: what was best so far
    found = [costs[np.maximum(np.searchsorted(rows, grid, side="right") - 1, 0)] for rows, costs in curves]
    return grid, np.median(found, axis=0)


def positions(run: Run, budget: int, path: Path) -> None:
    """Figure 5: true tip error at each held-out touch of the first trial, in the paper's three panels."""
    groups = (
        (rivals.BEFORE, "M2 swarm", rivals.EKF),
        ("M1 annealing", "M4 evolution", rivals.LM),
        (rivals.LM, rivals.BOTH),
    )
    made = figure(12, 2.6 * len(run.study.settings) + 0.5)
    panels = made.subplots(len(run.study.settings), 3, squeeze=False, sharex=True)
    for row, setting in zip(panels, run.study.settings, strict=True):
        for axes, group, letter in zip(row, groups, "abc", strict=True):
            for name in group:
                method = rivals.at_budget(name, budget) if name in rivals.POPULATION else name
                errors = run.of(setting, method)[0].get("detail", {}).get("heldout_tip_mm", [])
                style = {rivals.BOTH: "--", rivals.BEFORE: ":"}.get(name, "-")
                axes.plot(range(1, len(errors) + 1), errors, style, lw=1.2, color=COLOURS[name], label=name,
                          zorder=3 if style == ":" else 2)  # fmt: skip
            axes.set_title(f"({letter}) {setting}", fontsize=9)
        row[0].set_ylabel("tip error, mm")
    for axes in panels[-1]:
        axes.set_xlabel("held-out touch")
    shared_legend(made, 7)
    save_both(made, path)


def over_budget(run: Run, path: Path) -> None:
    """What a budget of rows buys: population methods run at each budget, local methods where they end."""
    made = figure(3.6 * len(run.study.settings) + 1, 4)
    for axes, setting in zip(made.subplots(1, len(run.study.settings), sharey=True, squeeze=False)[0],
                             run.study.settings, strict=True):  # fmt: skip
        for name in rivals.POPULATION:
            runs = [rivals.at_budget(name, budget) for budget in rivals.BUDGETS]
            points = [end(run, setting, method) for method in runs if method in run.study.methods]
            axes.loglog(*zip(*points, strict=True), "o-", ms=4, lw=1.2, color=COLOURS[name], label=name)
        for name in rivals.LOCAL:
            axes.loglog(*end(run, setting, name), "D", ms=6, color=COLOURS[name], label=name)
        axes.set_title(setting, fontsize=10)
        axes.set_xlabel("rows of residuals")
        axes.spines[["top", "right"]].set_visible(False)
    made.axes[0].set_ylabel("objective above the best, median")
    made.axes[-1].legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    save(made, path)


def end(run: Run, setting: str, method: str) -> tuple[float, float]:
    """Median rows spent and median objective above the best of the trial, over trials that all took part in."""
    count = min(run.study.trials_of(name) for name in run.study.methods)
    records = [record for record in run.of(setting, method)[:count] if record["error"] is None]
    best = best_cost(run, setting)
    above = [record["figures"]["cost"] - best[record["trial"]] for record in records]
    rows = [record["counts"]["residual_rows"] for record in records]
    return float(np.median(rows)), max(float(np.median(above)), LEAST)


def finite(values: np.ndarray) -> np.ndarray:
    """The finite ones."""
    return values[np.isfinite(values)]

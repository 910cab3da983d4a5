"""What the paper printed beside what its experiment gives when it is repeated, and a real arm beside the simulated."""

import math
from pathlib import Path

import numpy as np

from casacal import Problem
from casacal.study import Run
from casacal.study.description import Record, read_records
from casacal.study.statistics import mean_interval, paired, quantiles
from studies import rivals
from studies.paper_pictures import COLOURS, base, common, dotted, finite
from studies.paper_ranking import PAPER
from studies.reporting import figure, number, save, table

TABLE_V = {
    "alpha": (-89.9960, -0.0232, 90.0073, -90.0214, 90.0094, 0.0),
    "a": (249.7252, 893.9318, -210.7932, 4.6549, -0.3347, -0.0534),
    "d": (654.2394, -0.1907, -0.1926, 1034.0154, 0.1219, 199.8700),
}
"""Table V of arXiv:2208.02652: twists in degrees, lengths in mm, after calibration by M7. Its angles of joints are
those of the drawing, 0, -90, 180, 0, 90 and 0 degrees to the last digit."""
TABLE_I = {
    "alpha": (-90.0, 0.0, 90.0, -90.0, 90.0, 0.0),
    "a": (249.85003, 900.32123, -0.20614449, 0.0, 0.0, 0.0),
    "d": (653.5, 0.0, 0.0, 1030.37534, 0.0, 200.6),
}
"""Table I, the drawing."""
KINDS = {"heldout_rmse_mm": "RMSE", "heldout_std_mm": "STD", "heldout_max_mm": "MAX"}
REAL = Path(__file__).parent / "real_arm" / "records.jsonl"
TRACKED = ("tracker_free_mm", "tracker_wall_mm")


def ours(name: str, budget: int) -> str:
    """What a row of the paper's tables is called among our methods."""
    return rivals.at_budget(name, budget) if name in rivals.POPULATION else name


def tables(run: Run, problem: Problem, budget: int, settings: tuple[str, str]) -> list[str]:
    """Tables III, IV and V, the paper's and ours, and where Figures 3 to 5 are."""
    count = common(run, [ours(name, budget) for name in PAPER])
    rows = rivals.at_budget("", budget).removeprefix(", ")
    return [
        "Left the printed figures (arXiv:2208.02652, Tables III and IV): one run on one real arm, a comment and no",
        "target. Its STD is a mean absolute error (E17), its M7 time is the sum of M5's and M6's plus ten seconds",
        "exactly (E20), and whether its 35 samples were held out is not said (E21). Right ours, in the paper's own",
        f"cell (*{settings[0]}*): medians over the same {count} trials for all methods,",
        f"population methods with {rows} rows; time is that of one processor.",
        "",
        *accuracy_and_cost(run, settings[0], budget, count),
        "",
        "![printed figures and ours](beside.png)",
        "",
        "*Figures 3 and 4 (c) of the paper, crosses, beside ours, dots with 95 % intervals (time: 5 to 95 % of",
        "trials). Its Figures 4 (a, b) and 5 print no numbers; ours are below:",
        "[figure 3](figure3.png), [figure 4](figure4.png), [figure 5](figure5.png).*",
        "",
        "Table V, the paper's M7 on its arm and ours on the first simulated arm, each as it differs from the",
        "drawing; ours with the standard deviation that it states, and the truth, which a real arm does not tell.",
        "The paper's joint angles are those of the drawing, and its a3 is 211 mm from that of its Table I.",
        "",
        *parameters(run, problem, settings),
        "",
    ]


def accuracy_and_cost(run: Run, setting: str, budget: int, count: int) -> list[str]:
    """Tables III and IV, method by method."""
    rows = []
    for name, (rmse, std, most, seconds, iterations) in PAPER.items():
        method = ours(name, budget)
        plane = [number(quantiles(run.values(setting, method, kind)[:count])[0]) for kind in KINDS]
        tip = mean_interval(finite(run.values(setting, method, "tip_rms_mm")[:count]))
        cpu = quantiles(run.values(setting, method, "cpu", group="seconds")[:count])[0]
        steps = quantiles(run.values(setting, method, "steps", group="counts")[:count])[0]
        cost = (number(cpu), f"{steps:.0f}") if name != rivals.BEFORE else ("", "")
        rows.append((name, rmse, std, most, seconds, iterations, *plane, f"**{tip}**", *cost))
    header = ("mm, s", "paper: RMSE", "STD", "MAX", "time", "iterations",
              "ours: RMSE", "STD", "MAX", "true tip error", "time", "steps")  # fmt: skip
    return table(header, rows)


def parameters(run: Run, problem: Problem, settings: tuple[str, str]) -> list[str]:
    """Table V: deviations from the drawing."""
    details = [run.of(setting, rivals.BOTH)[0]["detail"] for setting in settings]
    rows = []
    for key, values in TABLE_V.items():
        unit = "deg" if problem.robot.parameters[key].unit == "rad" else "mm"
        factor = 180 / math.pi if unit == "deg" else 1.0
        for k, (drawn, found) in enumerate(zip(TABLE_I[key], values, strict=True)):
            name = f"{key}{k + 1}"
            cells = []
            for each in details:
                i = each["names"].index(name)
                cells.append(f"{factor * each['x'][i]:.4f} +- {factor * each['std'][i]:.4f}")
            i = details[0]["names"].index(name)
            rows.append((name, unit, f"{found - drawn:.4f}", *cells, f"{factor * details[0]['truth'][i]:.4f}"))
    return table(("", "unit", "paper, M7", *(f"ours, {setting}" for setting in settings), "truth of ours"), rows)


def draw(run: Run, setting: str, budget: int, path: Path) -> None:
    """Figures 3 and 4 (c): printed figures as crosses, ours as dots with intervals."""
    methods = [ours(name, budget) for name in PAPER]
    made, count = figure(13, 3.6), common(run, methods)
    panels = made.subplots(1, len(KINDS) + 1)
    for column, (axes, (kind, word)) in enumerate(zip(panels, KINDS.items(), strict=False)):
        dotted(axes, [mean_interval(finite(run.values(setting, m, kind)[:count])) for m in methods], methods, 0.15)
        axes.plot(np.arange(len(PAPER)) - 0.15, [figures[column] for figures in PAPER.values()], "x", color="0.2")
        axes.set_title(f"plane {word}, mm", fontsize=10)
        axes.set_xticks(range(len(methods)), [base(m).split(" ")[0] for m in methods], rotation=60, fontsize=8)
    axes, timed = panels[-1], [name for name in PAPER if name != rivals.BEFORE]
    for place, name in enumerate(timed):
        seconds = run.values(setting, ours(name, budget), "cpu", group="seconds")[:count]
        low, middle, high = np.nanquantile(seconds, (0.05, 0.5, 0.95))
        axes.errorbar(place + 0.15, middle, yerr=[[middle - low], [high - middle]], fmt="o", ms=5, color=COLOURS[name])
        axes.plot(place - 0.15, PAPER[name][3], "x", color="0.2")
    axes.set_yscale("log")
    axes.set_title("time, s", fontsize=10)
    axes.set_xticks(range(len(timed)), [name.split(" ")[0] for name in timed], rotation=60, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    save(made, path)


def real_arm(run: Run, settings: tuple[str, ...], budget: int) -> list[str]:
    """M0 to M7 on the simulated arm and on a real one, each over LM's on the same trials or splits.

    The real arm's figures are those recorded by studies/real_arm.
    """
    records = read_records(REAL)
    priors = list(dict.fromkeys(str(record["setting"]) for record in records))[:2]
    rows = []
    for name in (rivals.BEFORE, rivals.PLANES, *PAPER):
        if name == rivals.BEFORE and rows:
            continue
        cells: list[object] = []
        for setting in (s for s in settings if s in run.study.settings):
            for kind in ("heldout_rmse_mm", "tip_rms_mm"):
                both = (run.values(setting, method, kind) for method in (ours(name, budget), rivals.LM))
                cells.append(paired(*both).ratio)
        for prior in priors:
            for kinds in (("heldout_rmse_mm",), TRACKED):
                cells.append(paired(*(judged(records, prior, method, kinds) for method in (name, rivals.LM))).ratio)
        rows.append((name, *cells))
    header = ["over LM's"]
    for setting in (s for s in settings if s in run.study.settings):
        header += [f"simulated, {setting}: plane", "tip"]
    for prior in priors:
        header += [f"real, {prior}: plane", "tracker"]
    return [
        "## A wrong prior, and a real arm",
        "",
        "Every figure over LM's on the same trials or splits: geometric means with bootstrap 95 % intervals. The",
        "real arm is a Yaskawa Motoman MA1400 that touched plates and was watched by a laser tracker: see",
        "[studies/real_arm](../real_arm/report.md), where population methods had 1e6 rows. *Tracker*: geometric",
        "mean of its two runs. Where the prior is too narrow, the box that population methods search is, too.",
        "",
        *table(header, rows),
    ]


def judged(records: list[Record], prior: str, name: str, kinds: tuple[str, ...]) -> np.ndarray:
    """Geometric mean (splits,) of figures of the real arm, by split."""
    mine = [r for r in records if r["setting"] == prior and base(r["method"]) == name]
    mine.sort(key=lambda record: int(record["trial"]))
    found = [[record["figures"].get(kind, math.nan) for kind in kinds] for record in mine]
    return np.exp(np.log(np.array(found, dtype=np.float64)).mean(axis=1))

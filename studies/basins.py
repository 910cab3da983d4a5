"""From how far away does each method still find the minimum, and when is the filter worth its rows?

True errors and priors of the simulated HSR-JR680 grow by 1, 3, 10, 30 and 100; all methods start at the drawing, with
planes fitted to it. One face with the tool nearly normal, and three faces.

    casacal study studies/basins.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from casacal import ipopt, lm, load_problem, plate, sckf_lm
from casacal.fit import scipy_least_squares
from casacal.simulation import Simulated
from casacal.study import Method, Run, Study
from casacal.study.statistics import holm, mean_interval, paired, quantiles, success_rate
from studies import rivals
from studies.paper_pictures import COLOURS, base
from studies.paper_tables import FOUND, best_cost
from studies.reporting import PROBLEMS, figure, number, percent, save, script, table
from studies.starts import widened

SOURCE = load_problem(PROBLEMS / "hsr_jr680")
CELLS = {
    "three faces": SOURCE.cell,
    "one face": dataclasses.replace(SOURCE.cell, faces=plate((1350.0, 0.0, 500.0)), tilt=math.radians(5)),
}
FACTORS = (1, 3, 10, 30, 100)
STEPS = 1000
"""Steps that LM and its like may take, so that what is seen is the basin and not the patience."""
SURE = 0.05
NEAR = 0.5
"""Objective above the best, per unknown, below which an estimate is as good as the minimum for most uses: on average
it then lies within one posterior standard deviation of it."""


def described(trials: int, factors: tuple[int, ...], ipopt_trials: int, budget: int, population: int) -> Study:
    """The study, with fewer trials of what takes long."""
    methods = {
        rivals.LM: Method(lm, {"max_steps": STEPS}),
        rivals.BOTH: Method(sckf_lm, {"max_steps": STEPS}),
        rivals.EKF: rivals.LOCAL[rivals.EKF],
        rivals.SCKF: rivals.LOCAL[rivals.SCKF],
        rivals.SCIPY: Method(scipy_least_squares, {"max_evaluations": STEPS}),
        rivals.IPOPT: Method(ipopt, {"max_steps": STEPS // 2}, trials=ipopt_trials),
        **rivals.population(population, (budget,)),
    }
    settings = {
        f"{cell}, errors x{factor}": Simulated(widened(SOURCE.problem, factor), around)
        for cell, around in CELLS.items()
        for factor in factors
    }
    return Study("basins", settings, methods, trials=trials, details=0)


study = described(200, FACTORS, 30, 1_000_000, 10)
quick = described(4, (1, 10, 100), 1, 10_000, 1)


def report(run: Run) -> list[str]:
    """The answer, one table per setting, and rates over the size of the errors."""
    draw(run, run.out / "success.png")
    lines = [
        "# From how far away is the minimum found?",
        "",
        f"Simulated HSR-JR680, 85 touches fitted; {run.study.trials} trials per setting (fewer where the table says",
        "so). Errors x1 are 0.7 mm and 1 mrad. The priors, the standard deviations with which planes start, and the",
        "box of the population methods grow with the errors, as they would for someone who knows how little the",
        "drawing says.",
        f"*Found*: the objective is within {FOUND:g} of the lowest that any minimiser found. *Near*: within {NEAR} per",
        "unknown of it, which filters reach without iterating. Rates with Clopper and Pearson's 95 % intervals.",
        "",
        "## When is SCKF+LM worth it over LM?",
        "",
        *answer(run),
        "",
        "![rate of success over the size of the errors](success.png)",
        "",
    ]
    for setting in run.study.settings:
        lines += [f"## {setting}", "", *setting_table(run, setting), ""]
    return lines[:-1]


def outcomes(run: Run, setting: str, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Whether each trial (trials,) found the minimum, and whether it came near."""
    cost = run.values(setting, method, "cost")
    best = best_cost(run, setting)[: len(cost)]
    unknowns = 24 + 3 * len(run.study.settings[setting].cell.faces)
    return cost <= best * (1 + FOUND), cost - best <= NEAR * unknowns


def answer(run: Run) -> list[str]:
    """Rates, steps and rows of the two, and the sentence that follows, by the size of the errors."""
    rows, cheaper, alone = [], [], {}
    for setting in run.study.settings:
        found = {name: outcomes(run, setting, name)[0] for name in (rivals.LM, rivals.BOTH)}
        one, other = found[rivals.LM], found[rivals.BOTH]
        rates = {name: success_rate(int(hits.sum()), len(hits)) for name, hits in found.items()}
        only = np.array([(other & ~one).sum(), (one & ~other).sum()])
        factor = setting.rpartition(" ")[2]
        alone[factor] = alone.get(factor, 0) + only
        columns = []
        for name in ("steps", "residual_rows"):
            values = [run.values(setting, m, name, group="counts") for m in (rivals.BOTH, rivals.LM)]
            columns.append(paired(*(np.where(one & other, each, np.nan) for each in values)).ratio)
        rows.append((setting, percent(rates[rivals.LM]), percent(rates[rivals.BOTH]), *only, *columns))
        if columns[1].high < 1:
            cheaper.append(setting)
    header = ("setting", "LM finds it", "SCKF+LM finds it", "only SCKF+LM", "only LM", "steps, ratio", "rows, ratio")
    return [
        *by_factor(alone),
        *farthest(run),
        f"- Fewer rows of residuals than LM, the filter's pass included: {'; '.join(cheaper) or 'nowhere here'}.",
        "",
        *table(header, rows),
        "",
        "Ratios of SCKF+LM to LM: geometric means with bootstrap 95 % intervals over trials in which both found it.",
    ]


def farthest(run: Run) -> list[str]:
    """How another trust region fares from the same start where the errors are largest."""
    largest = max(FACTORS if not run.quick else (100,))
    lines = []
    for setting in (name for name in run.study.settings if name.endswith(f" x{largest}")):
        rates = []
        for method in (rivals.LM, rivals.BOTH, rivals.SCIPY):
            hits = outcomes(run, setting, method)[0]
            rates.append(f"{method} {percent(success_rate(int(hits.sum()), len(hits)))}")
        lines.append(f"- {setting}, found by {'; '.join(rates)}.")
    return lines


def by_factor(alone: dict[str, np.ndarray]) -> list[str]:
    """Where one of the two finds more minima, over both cells; exact p adjusted by Holm for the number of sizes."""
    p = holm({f: float(binomtest(int(a[0]), int(a.sum())).pvalue) if a.sum() else 1.0 for f, a in alone.items()})
    lines = []
    for factor, (both, lm_alone) in alone.items():
        sure = p[factor] < SURE
        word = ("worth it" if both > lm_alone else "worse") if sure else "no difference that these data show"
        lines.append(
            f"- Errors {factor}: {both} minima are found by SCKF+LM alone, {lm_alone} by LM alone (exact p, adjusted "
            f"by Holm, {p[factor]:.2g}): **{word}**."
        )
    return lines


def setting_table(run: Run, setting: str) -> list[str]:
    """Rates, excess, steps, rows and tip error of all methods in one setting."""
    rows = []
    best = best_cost(run, setting)
    for method in run.study.methods:
        found, near = outcomes(run, setting, method)
        excess = run.values(setting, method, "cost") - best[: len(found)]
        counts = [quantiles(run.values(setting, method, n, group="counts"))[0] for n in ("steps", "residual_rows")]
        tip = run.values(setting, method, "tip_rms_mm")
        rows.append((method, len(found), percent(success_rate(int(found.sum()), len(found))),
                     percent(success_rate(int(near.sum()), len(near))), number(quantiles(excess)[0]),
                     *(f"{count:,.0f}" for count in counts), mean_interval(tip[np.isfinite(tip)]),
                     len(run.failures(setting, method))))  # fmt: skip
    header = ("method", "trials", "found", "near", "objective above the best, median", "steps", "rows",
              "tip RMS, mm, mean", "failures")  # fmt: skip
    return table(header, rows)


def draw(run: Run, path: Path) -> None:
    """Rate of success over the size of the errors, with intervals."""
    made = figure(11, 7)
    panels = made.subplots(2, len(CELLS), sharex=True, sharey=True)
    for column, cell in enumerate(CELLS):
        chosen = [setting for setting in run.study.settings if setting.startswith(f"{cell},")]
        factors = np.array([float(setting.rpartition("x")[2]) for setting in chosen])
        for row, words in enumerate(("found the minimum", "came near")):
            axes = panels[row][column]
            for place, method in enumerate(run.study.methods):
                hits = [outcomes(run, setting, method)[row] for setting in chosen]
                rates = [success_rate(int(hit.sum()), len(hit)) for hit in hits]
                values = np.array([rate.value for rate in rates])
                spans = np.array([[rate.value - rate.low, rate.high - rate.value] for rate in rates]).T
                shift = 1.05 ** (place - len(run.study.methods) / 2)
                axes.errorbar(factors * shift, values, yerr=np.maximum(spans, 0), fmt="o-", ms=3, lw=1, elinewidth=0.7,
                              color=COLOURS.get(base(method), "#444444"), label=base(method))  # fmt: skip
            axes.set_xscale("log")
            axes.set_title(f"{cell}: {words}", fontsize=10)
    for axes in panels[-1]:
        axes.set_xlabel("errors, times 0.7 mm and 1 mrad")
    panels[0][-1].legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    save(made, path)


if __name__ == "__main__":
    script(__file__)

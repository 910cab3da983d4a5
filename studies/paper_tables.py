"""The tables of the repeated experiment, made from records."""

import math

import numpy as np

from casacal import Problem
from casacal.study import Run
from casacal.study.statistics import holm, mean_interval, paired, quantiles
from casacal.uncertainty.identifiability import known_from
from studies import rivals
from studies.reporting import number, table

MINIMISERS = (rivals.LM, rivals.BOTH, rivals.IPOPT, rivals.SCIPY)
FOUND = 1e-6
"""Relative excess of the objective, over the best of a trial, below which a minimum counts as found."""
SMALL = 1e-10


def best_cost(run: Run, setting: str) -> np.ndarray:
    """Lowest objective (trials,) that any minimiser found."""
    best = np.full(run.study.trials, np.inf)
    for name in MINIMISERS:
        found = run.values(setting, name, "cost")
        best[: len(found)] = np.fmin(best[: len(found)], found)
    return best


def found_minimum(run: Run, setting: str, method: str) -> np.ndarray:
    """Whether a method ended at the lowest objective known (trials,)."""
    cost = run.values(setting, method, "cost")
    return cost <= best_cost(run, setting)[: len(cost)] * (1 + FOUND)


def accuracy(run: Run, setting: str) -> list[str]:
    """RMSE, STD and MAX by their right definitions on held-out touches, beside the true tip error and LM's."""
    rows = []
    for method in run.study.methods:
        plane = [run.values(setting, method, f"heldout_{name}_mm") for name in ("rmse", "std", "max")]
        tip = run.values(setting, method, "tip_rms_mm")
        cells = [number(quantiles(values)[0]) for values in plane]
        beside = [run.values(setting, rivals.LM, name)[: len(tip)] for name in ("heldout_rmse_mm", "tip_rms_mm")]
        cells.insert(1, number(quantiles(beside[0])[0]))
        mean, theirs = (mean_interval(values[np.isfinite(values)]) for values in (tip, beside[1]))
        worst = quantiles(run.values(setting, method, "tip_max_mm"))[0]
        spread = map(number, quantiles(tip))
        rows.append((method, len(tip), *cells, f"**{mean}**", number(theirs.value), *spread, number(worst)))
    header = ["method", "trials", "plane RMSE", "LM's, same trials", "plane STD", "plane MAX"]
    header += ["tip RMS, mean (95 %)", "LM's, same trials", "median", "p95", "max", "worst pose"]
    return [
        "All in mm. Plane columns and worst pose: medians over trials. LM's squared tip error is on average",
        f"{mean_interval(over_bound(run, setting, rivals.LM))} times the square of the Bayesian bound, which is what",
        "noise and prior allow: one, apart from chance, where it is reached.",
        "",
        *table(header, rows),
    ]


def over_bound(run: Run, setting: str, method: str) -> np.ndarray:
    """Squared tip error over the mean of the squared bound (trials,): its mean is one where the bound is reached."""
    bound = run.values(setting, method, "bound_mm")
    return run.values(setting, method, "tip_rms_mm") ** 2 / np.nanmean(bound**2)


def headline(run: Run, methods: list[str], settings: tuple[str, str]) -> list[str]:
    """What one sees, what one wants and what it takes, for the paper's cell and the good one; each over LM's."""
    price = jacobian_price(run)
    rows = []
    for method in methods:
        cells: list[object] = []
        for setting in settings:
            for name, mark in (("heldout_rmse_mm", ""), ("tip_rms_mm", "**")):
                values = run.values(setting, method, name)
                ratio = paired(values, run.values(setting, rivals.LM, name)).ratio
                cells += [f"{mark}{mean_interval(values[np.isfinite(values)])}{mark}", ratio]
        counts = [run.values(settings[1], method, f"{kind}_rows", group="counts") for kind in ("residual", "jacobian")]
        rows.append((method, len(values), *cells, f"{quantiles(counts[0] + price * counts[1])[0]:,.0f}"))
    header = ["mm", "trials"]
    for setting in settings:
        header += [f"{setting}: plane residual", "over LM's", "tip error", "over LM's"]
    return table([*header, "rows evaluated"], rows)


def against_lm(run: Run) -> list[str]:
    """Ratio to LM's tip error and plane residual, with Holm-adjusted p values."""
    lines = [
        "Geometric mean of ratios to LM's figure with bootstrap 95 % interval; p of Wilcoxon's signed-rank test,",
        "adjusted by Holm over the methods of a setting. Above 1: worse than LM.",
        "",
    ]
    others = [method for method in run.study.methods if method != rivals.LM]
    for setting in run.study.settings:
        columns = []
        for name in ("tip_rms_mm", "heldout_rmse_mm"):
            lm = run.values(setting, rivals.LM, name)
            found = {method: paired(run.values(setting, method, name), lm) for method in others}
            columns.append((found, holm({method: compared.p for method, compared in found.items()})))
        (tip, tip_p), (plane, plane_p) = columns
        rows = [(m, tip[m].pairs, tip[m].ratio, p_value(tip_p[m]), plane[m].ratio, p_value(plane_p[m])) for m in others]
        header = ("method", "pairs", "tip error / LM's", "p", "plane residual / LM's", "p")
        lines += [f"### {setting}", "", *table(header, rows), ""]
    return lines


def p_value(p: float) -> str:
    """A p value, or that it is small."""
    return f"< {SMALL:g}" if p < SMALL else f"{p:.2g}"


def cost(run: Run) -> list[str]:
    """Time, iterations and evaluations, and the measured price of a Jacobian row."""
    price = jacobian_price(run)
    lines = [
        "Medians. Rows: evaluations of forward kinematics and plane for one touch, a row of the Jacobian counted as",
        f"{price:.2g} rows, the ratio measured while warming up. Steps are iterations of LM and IPOPT,",
        "evaluations of",
        "SciPy's least squares, rows of a filter, candidates of annealing, generations of the other two.",
        "Time is that",
        "of the processor, median and 5 to 95 % of the trials: what else runs on the machine is not in it;",
        "its ratio to",
        "LM's is over the same trials.",
        "",
    ]
    for setting in run.study.settings:
        rows = []
        lm = run.values(setting, rivals.LM, "cpu", group="seconds")
        for method in run.study.methods:
            residual, jacobian, steps = (
                run.values(setting, method, name, group="counts")
                for name in ("residual_rows", "jacobian_rows", "steps")
            )
            seconds = run.values(setting, method, "cpu", group="seconds")
            rows.append(
                (
                    method,
                    spread(1000 * seconds),
                    number(quantiles(seconds / lm[: len(seconds)])[0]),
                    f"{quantiles(steps)[0]:.0f}",
                    f"{quantiles(residual + price * jacobian)[0]:,.0f}",
                )
            )
        header = ("method", "time, ms (5 to 95 %)", "time / LM's", "steps", "rows")
        lines += [f"### {setting}", "", *table(header, rows), ""]
    return lines


def spread(values: np.ndarray) -> str:
    """Median, and 5 to 95 % of the finite values."""
    low, middle, high = np.nanquantile(values, (0.05, 0.5, 0.95)) if np.isfinite(values).any() else [np.nan] * 3
    return f"{number(middle)} ({number(low)} to {number(high)})"


def jacobian_price(run: Run) -> float:
    """Median time of a Jacobian row over that of a residual row."""
    measured = [record["seconds"] for record in run.records if "residual_row" in record["seconds"]]
    return float(np.median([seconds["jacobian_row"] / seconds["residual_row"] for seconds in measured]))


def over_budget(run: Run) -> list[str]:
    """Median objective above the trial's best, by budget, beside the local methods; who never left the drawing."""
    methods = [m for m in run.study.methods if m.split(",")[0] in rivals.POPULATION]
    rows = []
    for method in (*methods, rivals.LOCAL_SEARCH, *rivals.LOCAL):
        cells, spent = [], []
        for setting in run.study.settings:
            found = run.values(setting, method, "cost")
            least = best_cost(run, setting)[: len(found)]
            lm = run.values(setting, rivals.LM, "cost")[: len(found)]
            cells.append(f"{number(quantiles(found - least)[0])} ({number(quantiles(lm - least)[0])})")
            spent.append(run.values(setting, method, "residual_rows", group="counts"))
        trials = len(run.of(setting, method))
        unmoved = sum(r["status"] == "UNMOVED" for s in run.study.settings for r in run.of(s, method))
        rows.append((method, trials, unmoved, f"{quantiles(np.concatenate(spent))[0]:,.0f}", *cells))
    return [
        "Median of the objective above the best of each trial, in brackets that of LM on the same trials;",
        "differences",
        "below about one are smaller than what the noise of the touches does to it. Rows of residuals alone,",
        "over all",
        "settings; Table IV adds Jacobians. *Never better*: runs, over all settings, that found nothing",
        "better than the",
        "arm as drawn with its planes fitted, and say so.",
        "",
        *table(("method", "trials", "never better", "residual rows", *run.study.settings), rows),
    ]


def parameters(run: Run, problem: Problem, settings: tuple[str, str]) -> list[str]:
    """Truth, estimate and verdict for the parameters, from one face and from three."""
    details = [run.of(setting, rivals.BOTH)[0]["detail"] for setting in settings]
    rows = []
    for i, name in enumerate(name for name in details[0]["names"] if not name.startswith("plane")):
        key = name.rstrip("0123456789")
        unknown, place = problem.robot.parameters[key], int(name.removeprefix(key)) - 1
        factor = 180 / math.pi if unknown.unit == "rad" else 1.0
        start, prior = unknown.values[place], float(unknown.prior_stds[place])
        cells = []
        for found in details:
            known = known_from(found["std"][i], prior)
            cells += [f"{factor * (start + found['x'][i]):.4f}", f"{factor * found['std'][i]:.4f}", known]
        true = start + details[0]["truth"][i]
        unit = "deg" if unknown.unit == "rad" else unknown.unit
        rows.append((name, unit, f"{factor * start:.4f}", f"{factor * true:.4f}", *cells))
    header = ("", "unit", "nominal", "truth", "one face", "std", "known from", "three faces", "std", "known from")
    return [
        "Estimates of SCKF+LM. Known from *samples*: standard deviation below half of the prior's; *prior",
        "alone*: the",
        "prior's value stands.",
        "",
        *table(header, rows),
    ]


def failures(run: Run) -> list[str]:
    """What failed, how often, and the first message; nothing when nothing did."""
    said = {(s, m): run.failures(s, m) for s in run.study.settings for m in run.study.methods}
    rows = [(setting, method, len(texts), texts[0]) for (setting, method), texts in said.items() if texts]
    return ["", "## Failures", "", *table(("setting", "method", "trials", "first message"), rows)] if rows else []

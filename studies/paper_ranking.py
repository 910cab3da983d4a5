"""How much of the paper's ranking of M1 to M7 is found again, and how sure that is."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import kendalltau

from casacal.study import Run
from casacal.study.statistics import Interval, holm, paired
from studies import rivals
from studies.reporting import table

PAPER = {
    "before": (2.28, 2.15, 4.09, "", ""),
    "M1 annealing": (0.72, 0.65, 1.83, 106.23, 69),
    "M2 swarm": (0.65, 0.56, 1.71, 135.36, 45),
    "M3 EKF": (0.97, 0.83, 2.23, 22.15, 20),
    "M4 evolution": (0.60, 0.55, 1.57, 120.21, 31),
    "M5 SCKF": (0.69, 0.54, 1.72, 39.66, 35),
    "M6 LM": (0.58, 0.49, 1.31, 106.24, 63),
    "M7 SCKF+LM": (0.49, 0.40, 1.18, 155.90, 45),
}
"""Tables III and IV of arXiv:2208.02652: RMSE, STD, MAX in mm; seconds; iterations."""
FIGURES = {"heldout_rmse_mm": "held-out plane residual", "tip_rms_mm": "true tip error"}
RESAMPLES = 1000
SURE = 0.05


@dataclass(frozen=True)
class Survival:
    """Pairs of M1 to M7 that surely keep the paper's order, that surely turn it round, and the rest; Kendall's tau."""

    kept: tuple[str, ...]
    turned: tuple[str, ...]
    undecided: tuple[str, ...]
    tau: Interval
    trials: int
    ratios: dict[str, Interval]
    """Each method's figure over that of M6."""


def survival(run: Run, setting: str, figure: str, budget: int) -> Survival:
    """Compare the order of M1 to M7 in one figure with that of the paper's RMSE, over trials that all took part in."""
    names = sorted((name for name in PAPER if name != "before"), key=lambda name: PAPER[name][0])
    ours = {name: rivals.at_budget(name, budget) if name in rivals.POPULATION else name for name in names}
    columns = {name: run.values(setting, ours[name], figure) for name in names}
    count = min(len(column) for column in columns.values())
    values = {name: column[:count] for name, column in columns.items()}
    tau = _tau(np.log(np.array(list(values.values()))), np.array([PAPER[name][0] for name in names]))
    ratios = {name: paired(values[name], values[rivals.LM]).ratio for name in names}
    return Survival(*_pairs(values), tau, count, ratios)


def sentence(run: Run, setting: str, budget: int) -> str:
    """What survives in one setting, by the paper's own figure and by accuracy."""
    plane, tip = (survival(run, setting, figure, budget) for figure in FIGURES)
    ratios = ", ".join(f"{short(name)} {ratio}" for name, ratio in tip.ratios.items() if name != rivals.LM)
    return (
        f"In the paper's own cell, of the 21 pairs of M1 to M7 {len(plane.kept)} keep their order by plane residual "
        f"and {len(plane.turned)} turn round (Kendall's tau with the printed RMSE {plane.tau}); by true tip error "
        f"{len(tip.kept)} keep it ({listed(tip.kept)}), {len(tip.turned)} turn round ({listed(tip.turned)}), and "
        f"{len(tip.undecided)} cannot be told apart ({listed(tip.undecided)}), tau {tip.tau}, over {tip.trials} "
        f"trials. Tip errors over that of M6: {ratios}."
    )


def short(name: str) -> str:
    """M1 to M7."""
    return name.split(" ")[0]


def listed(pairs: tuple[str, ...]) -> str:
    """Pairs in words, the paper's winner first."""
    return ", ".join(pairs) or "none"


def ranking_table(run: Run, budget: int) -> list[str]:
    """All settings and both figures."""
    rows = []
    for setting in run.study.settings:
        for figure, words in FIGURES.items():
            found = survival(run, setting, figure, budget)
            counts = [len(pairs) for pairs in (found.kept, found.turned, found.undecided)]
            rows.append((setting, words, found.trials, *counts, found.tau))
    header = ("setting", "ranked by", "trials", "pairs kept", "turned round", "undecided", "Kendall's tau (95 %)")
    return [
        "The 21 pairs of M1 to M7 in the order of the paper's RMSE (M7, M6, M4, M2, M5, M1, M3); a pair counts as kept",
        f"or turned round when Wilcoxon's p, adjusted by Holm, is below {SURE}. Population methods with "
        f"1e{len(str(budget)) - 1} rows.",
        "",
        *table(header, rows),
    ]


def _pairs(values: dict[str, np.ndarray]) -> tuple[tuple[str, ...], ...]:
    """Pairs that surely keep the paper's order, that surely turn it round, and the rest; names in the paper's order."""
    found = {(a, b): paired(values[a], values[b]) for a, b in combinations(values, 2)}
    adjusted = holm({f"{short(a)}/{short(b)}": compared.p for (a, b), compared in found.items()})
    kept, turned, undecided = [], [], []
    for (name, p), compared in zip(adjusted.items(), found.values(), strict=True):
        (undecided if p >= SURE else kept if compared.ratio.value < 1 else turned).append(name)
    return tuple(kept), tuple(turned), tuple(undecided)


def _tau(logs: np.ndarray, paper: np.ndarray) -> Interval:
    """Kendall's tau of mean log figures with the paper's RMSE, and its bootstrap 95 % interval over trials."""
    logs = logs[:, np.isfinite(logs).all(axis=0)]
    rng, found = np.random.default_rng(0), []
    for _ in range(RESAMPLES):
        chosen = rng.integers(logs.shape[1], size=logs.shape[1])
        found.append(kendalltau(np.round(logs[:, chosen].mean(axis=1), 6), paper).statistic)
    low, high = np.quantile(found, (0.025, 0.975))
    return Interval(float(kendalltau(np.round(logs.mean(axis=1), 6), paper).statistic), float(low), float(high))

"""Are casacal's annealing, swarm and evolution as good as published ones, on the same objective with the same budget?

SciPy's differential evolution, pymoo's evolution and swarm and the swarm of pyswarms search the objective that
casacal's own do (`casacal.fit.population.Search`: faces placed, not searched; first points drawn from the prior), and
stop where the same budget is spent. Everything is compared with LM on the same arms.

    pip install "casacal[population]"
    casacal study studies/population.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import contextlib
import importlib.util
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from casacal import annealing, evolution, lm, swarm
from casacal.errors import CasacalError
from casacal.fit.least_squares import LeastSquares, Result
from casacal.fit.population import Search, SearchEndedError
from casacal.simulation import Simulated
from casacal.study import Method, Run, Study
from casacal.study.statistics import Interval, paired
from studies import rivals
from studies.paper import CORNER, FACE, ONE, SOURCE, THREE
from studies.reporting import figure, number, palette, save, script, shared_legend, table
from studies.rivals import at_budget

LM = "LM"
BUDGETS: tuple[int | None, ...] = (*rivals.BUDGETS, None)
"""Rows of residuals that a search may evaluate; None: until it stops."""
WEIGHT, PULL = 0.7298, 1.49618
"""Clerc and Kennedy, The particle swarm: explosion, stability and convergence, 2002."""


def ended(search: Search, run: Callable[[], object], name: str) -> Result:
    """What a search found when the program that drives it was ended by the budget, or ended itself."""
    with contextlib.suppress(SearchEndedError):
        run()
    return search.result(name, search.evaluations)


def scipys(problem: LeastSquares, *, seed: int, budget: int | None) -> Result:
    """SciPy's differential evolution, best/1/bin with its own constants, 5 candidates per unknown or a tenth of all."""
    from scipy.optimize import differential_evolution

    search, rng = Search(problem, budget=budget), np.random.default_rng(seed)
    size = int(max(min(5 * search.unknowns, search.allowed // 10), 5))
    run = partial(
        differential_evolution,
        lambda points: search.costs(np.asarray(points).T),
        [(-search.width, search.width)] * search.unknowns,
        init=search.drawn(rng, size),
        maxiter=10**6,
        tol=0,
        polish=False,
        vectorized=True,
        updating="deferred",
        rng=rng,
    )
    return ended(search, run, "SciPy DE")


def pymoos(problem: LeastSquares, *, algorithm: str, size: int, seed: int, budget: int | None) -> Result:
    """An algorithm of pymoo at its defaults: DE (rand/1/bin with dither) or PSO (which adapts its constants)."""
    wanted("pymoo")
    from pymoo.algorithms.soo.nonconvex.de import DE
    from pymoo.algorithms.soo.nonconvex.pso import PSO
    from pymoo.core.problem import Problem
    from pymoo.optimize import minimize

    search = Search(problem, budget=budget)
    walls = np.full(search.unknowns, search.width)

    class Objective(Problem):  # type: ignore[misc]
        def _evaluate(self, points: np.ndarray, out: dict[str, np.ndarray], *_: object, **__: object) -> None:
            out["F"] = search.costs(points)

    first = search.drawn(np.random.default_rng(seed), size)
    chosen = {"DE": DE, "PSO": PSO}[algorithm](pop_size=size, sampling=first)
    objective = Objective(n_var=search.unknowns, n_obj=1, xl=-walls, xu=walls)
    return ended(
        search, partial(minimize, objective, chosen, ("n_gen", 10**6), seed=seed % 2**32), f"pymoo {algorithm}"
    )


def pyswarms_swarm(problem: LeastSquares, *, seed: int, budget: int | None) -> Result:
    """The swarm of pyswarms in which all inform all, 25 particles with Clerc and Kennedy's constants."""
    wanted("pyswarms")
    from pyswarms.single import GlobalBestPSO

    search = Search(problem, budget=budget)
    np.random.seed(seed % 2**32)  # noqa: NPY002  it draws from the common ones
    walls = np.full(search.unknowns, search.width)
    constants = {"c1": PULL, "c2": PULL, "w": WEIGHT}
    first = search.drawn(np.random.default_rng(seed), 25)
    theirs = GlobalBestPSO(25, search.unknowns, constants, bounds=(-walls, walls), init_pos=first)
    return ended(search, partial(theirs.optimize, search.costs, 10**6, verbose=False), "pyswarms PSO")


def wanted(package: str) -> None:
    """Raise CasacalError where a package is not installed."""
    if importlib.util.find_spec(package) is None:
        raise CasacalError(f"{package} is not installed", "Install it with pip install 'casacal[population]'")


OURS = {"casacal annealing": annealing, "casacal swarm": swarm, "casacal evolution": evolution}
PUBLISHED = {
    "SciPy DE": scipys,
    "pymoo DE": partial(pymoos, algorithm="DE", size=50),
    "pymoo PSO": partial(pymoos, algorithm="PSO", size=25),
    "pyswarms PSO": pyswarms_swarm,
}
RIVALS = {"casacal evolution": ("SciPy DE", "pymoo DE"), "casacal swarm": ("pymoo PSO", "pyswarms PSO")}


def described(trials: int, late: int, budgets: tuple[int | None, ...]) -> Study:
    """The study; searches without a budget in fewer trials."""
    methods = {LM: Method(lm)} | {
        at_budget(name, budget): Method(estimate, {"budget": budget}, seeded=True, trials=trials if budget else late)
        for name, estimate in {**OURS, **PUBLISHED}.items()
        for budget in budgets
    }
    cells = {ONE: Simulated(SOURCE.problem, FACE), THREE: Simulated(SOURCE.problem, CORNER)}
    return Study("population", cells, methods, trials=trials)


study, quick, skipped = described(5, 1, BUDGETS), described(2, 1, BUDGETS[:2]), None
if missing := [name for name in ("pymoo", "pyswarms") if importlib.util.find_spec(name) is None]:
    skipped = f"{' and '.join(missing)} not installed; install with pip install 'casacal[population]'"


def report(run: Run) -> list[str]:
    """Plane residual and objective of every search over those of LM, budget by budget."""
    draw(run, run.out / "over_lm.png")
    lines = [
        "# Annealing, swarm and evolution beside published ones",
        "",
        "Simulated HSR-JR680 as in the [paper's experiment](../paper/report.md): 85 touches fitted, 35 held out. All",
        "search one objective: what is known of the arm is searched, 24 unknowns in a box of four prior standard",
        "deviations; planes are placed where they fit each candidate best. First points are drawn from the prior. A",
        "budget counts rows of residuals, rows of a Jacobian three times. *Until it stops*: until 3,000 evaluations",
        "lowered the objective by less than 0.01. Ratios are geometric means over the same arms, with bootstrap 95 %",
        "intervals.",
        "",
        *(f"- {sentence}" for sentence in in_short(run)),
        "",
        "![objective over LM's](over_lm.png)",
        "",
    ]
    kinds = (("heldout_rmse_mm", "Plane residual, held out, over LM's"), ("cost", "Objective over LM's"),
             ("tip_rms_mm", "True tip error over LM's"))  # fmt: skip
    budgets = used(run)
    for setting in run.study.settings:
        for name, words in kinds:
            rows = [
                (search, *(over_lm(run, setting, at_budget(search, budget), name) for budget in budgets))
                for search in (*OURS, *PUBLISHED)
            ]
            lines += [f"## {words}: {setting}", "", *table(("search", *map(spoken, budgets)), rows), ""]
    header = ("search", "trials", "never better than the drawing", "rows spent, median", "time, s")
    lines += ["## How they ended", "", *table(header, ends(run))]
    return lines


def used(run: Run) -> list[int | None]:
    """Budgets of the study, in order."""
    return [budget for budget in BUDGETS if at_budget("casacal swarm", budget) in run.study.methods]


def spoken(budget: int | None) -> str:
    """A budget in words."""
    return at_budget("", budget).removeprefix(", ")


def over_lm(run: Run, setting: str, method: str, figure_name: str) -> Interval:
    """A figure over that of LM on the same trials."""
    return paired(run.values(setting, method, figure_name), run.values(setting, LM, figure_name)).ratio


def in_short(run: Run) -> list[str]:
    """Ours against LM, and against those of their kind."""
    said, last = [], [budget for budget in used(run) if budget][-1]
    near = ", ".join(f"{name} {over_lm(run, ONE, at_budget(name, last), 'heldout_rmse_mm')}" for name in OURS)
    said.append(f"In the paper's cell, plane residual over LM's with {spoken(last)} rows: {near}.")
    for ours, theirs in RIVALS.items():
        cells = []
        for other in theirs:
            for budget in used(run):
                one, two = (
                    np.concatenate([run.values(s, at_budget(n, budget), "cost") for s in run.study.settings])
                    for n in (ours, other)
                )
                cells.append(f"{other} {spoken(budget)} {paired(one, two).ratio}")
        said.append(f"Objective of {ours} over that of, both cells: {'; '.join(cells)}.")
    return said


def ends(run: Run) -> list[tuple[object, ...]]:
    """How many searches never improved on the drawing, and what they spent."""
    rows = []
    for method in run.study.methods:
        records = [record for setting in run.study.settings for record in run.of(setting, method)]
        good = [record for record in records if record["error"] is None]
        rows_spent = [record["counts"]["residual_rows"] for record in good]
        seconds = [record["seconds"]["solve"] for record in good]
        never = sum(record["status"] == "UNMOVED" for record in records)
        middle = [float(np.median(values)) if values else math.nan for values in (rows_spent, seconds)]
        rows.append((method, len(records), never, f"{middle[0]:,.0f}", number(middle[1])))
    return rows


def draw(run: Run, path: Path) -> None:
    """Objective over LM's, dots with 95 % intervals on log axes."""
    made = figure(10, 4.2)
    budgets, names = used(run), [*OURS, *PUBLISHED]
    for axes, setting in zip(made.subplots(1, len(run.study.settings), sharey=True), run.study.settings, strict=True):
        for k, (name, colour) in enumerate(zip(names, palette(len(names)), strict=True)):
            found = [over_lm(run, setting, at_budget(name, budget), "cost") for budget in budgets]
            values = np.array([each.value for each in found])
            spans = np.abs(np.array([[each.low, each.high] for each in found]).T - values)
            places = np.arange(len(budgets)) + 0.1 * (k - len(names) / 2)
            axes.errorbar(places, values, yerr=spans, fmt="o" if name in OURS else "s", ms=5, lw=1, color=colour,
                          mfc=None if name in OURS else "white", label=name)  # fmt: skip
        axes.set_yscale("log")
        axes.set_xticks(range(len(budgets)), [spoken(budget) for budget in budgets])
        axes.set_xlabel("rows of residuals")
        axes.set_title(setting, fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    made.axes[0].set_ylabel("objective over LM's")
    shared_legend(made, 4)
    save(made, path)


if __name__ == "__main__":
    script(__file__)

"""The benchmark: every method on every split of every set, and its table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.bench.benchmark_set import BLOCKED, RANDOM, STATED, BenchmarkSet, folds
from casacal.bench.methods import WAYS, Told, Way, squares_of
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.least_squares.result import Result, Status
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.study.description import Method, Run, Study

KINDS = (STATED, RANDOM, BLOCKED)
QUICK_ROWS = 100  # rows at most of a set in the quick form


@dataclass(frozen=True)
class Fold:
    """One fold of one split of a set."""

    bench: BenchmarkSet
    data: str
    kind: str
    number: int
    quick: bool = False

    def trial(self, seed: int) -> FoldTrial:
        """The same whatever the seed: the split has its own."""
        del seed
        problem = self.bench.problem
        samples = rows_of(self.bench, self.data, problem, quick=self.quick)
        fitted, unseen = folds(samples, self.kind, self.bench.blocks, self.bench.stated)[self.number]
        return FoldTrial(problem, samples.take(fitted), samples.take(unseen), self.bench.metric)


def rows_of(bench: BenchmarkSet, data: str | Path, problem: Problem, *, quick: bool = False) -> Samples:
    """The rows of a set; in the quick form some of them, evenly spread."""
    samples = bench.read(Path(data), problem)
    if not quick or len(samples) <= QUICK_ROWS:
        return samples
    return samples.take(np.unique(np.linspace(0, len(samples) - 1, QUICK_ROWS).astype(int)))


@dataclass(frozen=True)
class FoldTrial:
    """Rows to fit, rows that are not seen, and how what is left of these counts."""

    arm: Problem
    fitted: Samples
    unseen: Samples
    metric: str

    @cached_property
    def problem(self) -> BoundProblem:
        """The rows that are fitted, under the geometry; its name says the rest to methods."""
        return UnseenToo(bind(self.arm.without_effects, self.fitted), self)

    def judge(self, result: Result) -> dict[str, float]:
        """Sum of the squares of what is left, how many rows were not seen, and whether the method denied itself."""
        squares = result.trace["squares"]
        figures = {"squares": float(squares.sum()), "rows": float(squares.size)}
        return figures | {"refused": float(result.trace["refused"][0])}

    def detail(self, result: Result) -> Mapping[str, Any]:
        """Nothing more."""
        del result
        return {}


class UnseenToo(BoundProblem):
    """A bound problem that knows which rows it has not seen."""

    def __init__(self, bound: BoundProblem, fold: FoldTrial) -> None:
        super().__init__(bound.problem, bound.slots, bound.samples, surveys=bound.surveys)
        self.fold = fold


def estimate(metered: Any, way: Way) -> Result:
    """What a way to calibrate leaves of the unseen rows, in place of a trace."""
    problem: UnseenToo = metered.problem  # what the harness counts evaluations of
    fold = problem.fold
    told = way(fold.arm, fold.fitted, fold.unseen)
    residuals = np.asarray(told.residuals if isinstance(told, Told) else told, dtype=np.float64)
    refused = isinstance(told, Told) and told.verdict == "do not use"
    trace = {"squares": squares_of(residuals, fold.metric), "refused": np.array([float(refused)])}
    return Result("bench", problem, problem.x0.copy(), Status.UNSAID, trace, 0, 0, 0)


def benchmark(
    sets: Sequence[BenchmarkSet], data: str | Path, ways: Mapping[str, Way] = WAYS, *, quick: bool = False
) -> Study:
    """A study of these sets and methods; its quick form has few rows and one block of each set.

    Raises CasacalError where a set's measurements are missing, or cannot be split as it says.
    """
    settings = {}
    for each in sets:
        samples = rows_of(each, data, each.problem, quick=quick)
        for kind in (BLOCKED,) if quick else KINDS:
            count = len(folds(samples, kind, each.blocks, each.stated))
            for number in range(min(count, 1) if quick else count):
                settings[setting_name(each.name, kind, number)] = Fold(each, str(data), kind, number, quick)
    methods = {name: Method(partial(estimate, way=way)) for name, way in ways.items()}
    return Study("bench", settings, methods, trials=1, details=0)


def setting_name(name: str, kind: str, number: int) -> str:
    """A fold's name among the settings."""
    return f"{name} / {kind} / {number + 1}"


def mean_squares(squares: Array, rows: Array) -> tuple[float, float, float]:
    """Root mean square over folds, with its 95 % interval by bootstrap over them; of one fold alone it has none."""
    total = float(np.sqrt(squares.sum() / rows.sum()))
    if squares.size < 2:
        return total, float("nan"), float("nan")
    drawn = np.random.default_rng(0).integers(squares.size, size=(2000, squares.size))
    values = np.sqrt(squares[drawn].sum(axis=1) / rows[drawn].sum(axis=1))
    low, high = np.quantile(values, [0.025, 0.975])
    return total, float(low), float(high)


LEAKS = 1.5  # blocked over random from which a method is said to live on neighbours
REPRODUCED = 0.05  # part of a published figure within which it counts as reproduced

MARK = "†"


def bench_lines(run: Run, sets: Sequence[BenchmarkSet]) -> list[str]:
    """The page, as lines."""
    lines = [
        "# Benchmark",
        "",
        "Root mean square of what a method leaves of rows that it has not seen, in mm; of poses, of their positions.",
        "*Stated*: the split that the set's own page names. *Random*: five folds. *Blocked*: regions of postures, or",
        "contiguous rows. Intervals are 95 %, by bootstrap over folds. *Leak*: blocked over random; a method that is",
        f"much worse on blocks ({LEAKS:g} and more are bold) knows the neighbours of a row rather than the arm.",
        f"{MARK}: the method's own verdict, in some fold, is not to use its result; the figure stands all the same.",
        "Published figures are of the stated split where a set names one; *yes* within 5 %.",
        "",
    ]
    for each in sets:
        rows = [_row(run, each, method) for method in _methods(run)]
        lines += [f"## {each.title}", "", f"`{each.name}`; {each.source}; licence: {each.licence}.", ""]
        header = ("method", STATED, RANDOM, BLOCKED, "leak", "published", "reproduced")
        lines += ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
        lines += ["| " + " | ".join(row) + " |" for row in rows]
        asked = product(_settings(run, each.name), _methods(run))
        said = sorted({f"`{method}`: {words}" for one, method in asked for words in run.failures(one, method)})
        lines += ["", *(f"- {words}" for words in said)] if said else []
        lines += [""]
    return lines[:-1]


def _row(run: Run, each: BenchmarkSet, method: str) -> list[str]:
    found = {kind: _figure(run, each.name, method, kind) for kind in KINDS}
    refused = any((run.values(setting, method, "refused") == 1).any() for setting in _settings(run, each.name))
    cells = [f"{method}{' ' + MARK if refused else ''}", *(_shown(*found[kind]) for kind in KINDS)]
    leak = found[BLOCKED][0] / found[RANDOM][0]
    shown = "–" if not math.isfinite(leak) else f"**{leak:.2f}**" if leak >= LEAKS else f"{leak:.2f}"
    theirs = next((published for published in each.published if published.method == method), None)
    if theirs is None or run.quick:  # whose few rows are not those of the published figure
        return [*cells, shown, "–" if theirs is None else f"{theirs.figure:g} ({theirs.by})", "–"]
    mine = found[STATED][0] if math.isfinite(found[STATED][0]) else found[RANDOM][0]
    same = abs(mine / theirs.figure - 1) <= REPRODUCED
    better = mine < theirs.figure
    return [*cells, shown, f"{theirs.figure:g} ({theirs.by})", "yes" if same else "better" if better else "no"]


def _figure(run: Run, name: str, method: str, kind: str) -> tuple[float, float, float]:
    """Root mean square and its interval; not numbers where a fold failed or there is none."""
    chosen = [setting for setting in _settings(run, name) if f" / {kind} / " in setting]
    if not chosen:
        return math.nan, math.nan, math.nan
    squares, rows = (
        np.concatenate([run.values(setting, method, figure) for setting in chosen]) for figure in ("squares", "rows")
    )
    if not squares.size or not np.isfinite(squares).all():
        return math.nan, math.nan, math.nan
    return mean_squares(squares, rows)


def _settings(run: Run, name: str) -> list[str]:
    settings = run.study.settings if run.study is not None else ()
    return [setting for setting in settings if setting.split(" / ")[0] == name]


def _methods(run: Run) -> list[str]:
    return list(run.study.methods) if run.study is not None else []


def _shown(value: float, low: float, high: float) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{value:.3f}" + (f" ({low:.3f} to {high:.3f})" if math.isfinite(low) else "")

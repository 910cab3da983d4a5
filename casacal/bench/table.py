"""The benchmark's report: one table for all sets, every random figure beside one of blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from casacal.bench.benchmark import KINDS, mean_squares
from casacal.bench.benchmark_set import BenchmarkSet
from casacal.bench.splits import BLOCKED, RANDOM, STATED
from casacal.study.runs import Run

LEAKS = 1.5
"""Blocked over random from which a method is said to live on neighbours."""

REPRODUCED = 0.05
"""Part of a published figure within which it counts as reproduced."""

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
        rows = [_row(run, each, method) for method in (run.study.methods if run.study is not None else ())]
        lines += [f"## {each.title}", "", f"`{each.name}`; {each.source}; licence: {each.licence}.", ""]
        header = ("method", STATED, RANDOM, BLOCKED, "leak", "published", "reproduced")
        lines += ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
        lines += ["| " + " | ".join(row) + " |" for row in rows]
        said = sorted({f"`{name}`: {words}" for name, words in _failures(run, each)})
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


def _failures(run: Run, each: BenchmarkSet) -> list[tuple[str, str]]:
    methods = run.study.methods if run.study is not None else ()
    return [
        (method, words)
        for setting in _settings(run, each.name)
        for method in methods
        for words in run.failures(setting, method)
    ]


def _shown(value: float, low: float, high: float) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{value:.3f}" + (f" ({low:.3f} to {high:.3f})" if math.isfinite(low) else "")

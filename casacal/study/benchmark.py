"""Public data sets as a study: each is split several ways, and methods are judged on rows that they have not seen.

A set is a folder with set.toml and problem.py, whose measurements stand elsewhere. A method is a function (problem,
fitted, unseen) of a file that defines `methods`. It returns the residuals (N, m) that it leaves of the unseen rows, in
the unit of the instrument, alone or with the verdict that it gives of its own result (`Told`). It may look at the joint
values of these rows, as whoever corrects a target does, and not at what was read there, but for what stands elsewhere
anew: a socket at another place.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from casacal.data.columns import Labels
from casacal.data.holdout import REGIONS, splits
from casacal.data.samples import Samples
from casacal.errors import CasacalError, UnknownNameError, refuse_unknown
from casacal.fit.arm_alone import bind_further, extended
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.least_squares import Result, Status
from casacal.model.problem import Problem
from casacal.model.problem_file import load_problem
from casacal.study.description import Method, Run, Study
from casacal.study.statistics import Interval
from casacal.study.study_file import names_of
from casacal.values import Array, FrozenMapping, Index

DESCRIPTION, METHODS = "set.toml", "methods.py"
METRICS = ("distance", "position", "rms")
STATED, RANDOM, BLOCKED = KINDS = ("stated", "random", "blocked")
FOLDS = 5
MOST_BLOCKS = 12
QUICK_ROWS = 100  # rows at most of a set in the quick form
LEAKS = 1.5  # blocked over random from which a method is said to live on neighbours
REPRODUCED = 0.05  # part of a published figure within which it counts as reproduced
REFUSED = "†"


@dataclass(frozen=True)
class Published:
    """A published figure: the method, its value in the unit of the set's metric, and the source."""

    method: str
    figure: float
    by: str


@dataclass(frozen=True)
class BenchmarkSet:
    """Description of a public data set, as set.toml holds it.

    metric: "distance" is the root mean square of the length of a row's residual, "position" that of its first three
    components, "rms" that of all components.
    blocks: what is left out together in the blocked split: "order" (of the rows), "regions" (of postures), or a column.
    stated: how the set's own page splits it, as `folds` takes it.
    """

    name: str
    folder: str
    title: str
    source: str
    licence: str
    file: str
    sha256: str
    metric: str
    blocks: str
    stated: Mapping[str, Any]
    published: tuple[Published, ...]

    @property
    def problem(self) -> Problem:
        """Its arm and instrument."""
        return load_problem(self.folder).problem

    def read(self, data: str | Path, problem: Problem, *, quick: bool = False) -> Samples:
        """Its rows among the data, in the quick form some of them; CasacalError unless they are there as they were."""
        path = Path(data) / self.file
        if not path.is_file():
            raise CasacalError(f"The measurements of '{self.name}' are not at {path}", f"Get them from {self.source}")
        if hashlib.sha256(path.read_bytes()).hexdigest() != self.sha256:
            fix = "Fetch it again, or correct its hash"
            raise CasacalError(f"{path} is not the file that '{self.name}' describes", fix)
        samples = problem.read(path)
        if not quick or len(samples) <= QUICK_ROWS:
            return samples
        return samples.take(np.unique(np.linspace(0, len(samples) - 1, QUICK_ROWS).astype(int)))


def read_sets(folder: str | Path) -> tuple[BenchmarkSet, ...]:
    """The set that a folder describes, or all sets below it, by name; raises CasacalError as `read_set` does."""
    if (Path(folder) / DESCRIPTION).is_file():
        return (read_set(folder),)
    found = sorted(path.parent for path in Path(folder).glob(f"*/{DESCRIPTION}"))
    if not found:
        fix = f"Give a folder of folders with {DESCRIPTION}"
        raise CasacalError(f"There is no set of the benchmark in '{folder}'", fix)
    return tuple(read_set(each) for each in found)


def read_set(folder: str | Path) -> BenchmarkSet:
    """The set that a folder describes; raises CasacalError where a part is missing or of the wrong kind."""
    path = Path(folder) / DESCRIPTION
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # no TOML, or no UTF-8
        raise CasacalError(f"{path} is no TOML: {error}", "Mend it") from None
    words = ("title", "source", "licence", "file", "sha256", "metric", "blocks")
    for word in words:
        if not isinstance(table.get(word), str):
            raise CasacalError(f"{path} does not say its {word}", f'Add {word} = "..."')
    if table["metric"] not in METRICS:
        raise CasacalError(f"The metric of {path} is '{table['metric']}'", f"Use {' or '.join(METRICS)}")
    if not isinstance(stated := table.get("stated", {}), Mapping):
        raise _no_split(stated, str(path))
    try:
        found = tuple(Published(str(p["method"]), float(p["figure"]), str(p["by"])) for p in table.get("published", ()))
    except (KeyError, TypeError, ValueError):
        raise CasacalError(f"A published figure of {path} lacks a part", "Say method, figure and by") from None
    place, parts = Path(folder), {word: table[word] for word in words}
    return BenchmarkSet(place.resolve().name, place.as_posix(), **parts, stated=FrozenMapping(stated), published=found)


def folds(samples: Samples, kind: str, blocks: str, stated: Mapping[str, Any]) -> list[tuple[Index, Index]]:
    """Rows to fit and rows that are not seen, fold by fold: "stated", "random" or "blocked".

    stated: {"part": 0.3, "seed": 0}, the last of a permutation, of so many "rows" of it where these are said;
    {"folds": 5, "seed": 0}; {"column": "split", "value": "test"}; or nothing.

    Raises CasacalError where the set cannot be split so.
    """
    rows = np.arange(len(samples))
    if kind == STATED:
        rows, unseen = _stated(samples, stated)
    elif kind == BLOCKED:
        unseen = _blocks(samples, blocks)
    else:
        unseen = np.array_split(np.random.default_rng(0).permutation(rows), FOLDS)
    return [(np.setdiff1d(rows, part), np.sort(part)) for part in unseen]


def _stated(samples: Samples, stated: Mapping[str, Any]) -> tuple[Index, list[Index]]:
    """The rows that take part, and the unseen ones of each fold."""
    seed, needed = stated.get("seed", 0), stated.get("rows", 2)
    if not all(type(number) is int and number >= least for number, least in ((seed, 0), (needed, 2))):
        raise _no_split(stated, samples.file)
    order, unseen = np.random.default_rng(seed).permutation(len(samples)), list[Index]()
    match {key: value for key, value in stated.items() if key not in ("seed", "rows")}:
        case {"part": float(part), **others} if 0 < part < 1 and not others:
            order = order[: stated.get("rows")]
            unseen = [order[round((1 - part) * len(order)) :]]
        case {"folds": int(needed), **others} if needed >= 2 and not others and "rows" not in stated:
            unseen = np.array_split(order, needed)
        case {"column": str(column), "value": str(value), **others} if not others and len(stated) == 2:
            labels = _labels(samples, column)
            refuse_unknown(f"value of '{column}' in {samples.file}", [value], labels.names)
            unseen = [np.flatnonzero(labels.codes == labels.names.index(value))]
        case _ if stated:
            raise _no_split(stated, samples.file)
    if needed > len(samples):
        raise CasacalError(f"{samples.file} has {len(samples)} rows, and its split needs {needed}", "State another")
    return order, unseen


def _no_split(stated: object, place: str) -> CasacalError:
    ways = 'part = 0.3, seed = 0 (of so many "rows"); folds = 5, seed = 0; or column = "split", value = "test"'
    split = ", ".join(f"{k} = {v!r}" for k, v in stated.items()) if isinstance(stated, Mapping) else repr(stated)
    return CasacalError(f"The stated split of {place} is {split}", f"Use a table with {ways}")


def _blocks(samples: Samples, blocks: str) -> list[Index]:
    if blocks == "order":
        return np.array_split(np.arange(len(samples)), FOLDS)
    if blocks == "regions":
        return splits(samples, None)[REGIONS]
    labels = _labels(samples, blocks)
    groups = np.array_split(np.arange(len(labels.names)), min(MOST_BLOCKS, len(labels.names)))
    if len(groups) < 2:
        raise CasacalError(f"The column '{blocks}' of {samples.file} has one value", "Name one with several")
    return [np.flatnonzero(np.isin(labels.codes, group)) for group in groups]


def _labels(samples: Samples, column: str) -> Labels:
    if column in samples.labels:
        return samples.labels[column]
    if column in samples.extra:
        return Labels.of(map(str, samples.extra[column]))
    raise UnknownNameError("column", column, [*samples.labels, *samples.extra])


@dataclass(frozen=True)
class Fold:
    """One fold of one split of a set: a setting of the study."""

    bench: BenchmarkSet
    data: str
    kind: str
    number: int
    quick: bool = False

    def trial(self, seed: int) -> FoldTrial:
        """Trial of this set; the seed is ignored, as the split has its own."""
        del seed
        problem = self.bench.problem
        samples = self.bench.read(self.data, problem, quick=self.quick)
        fitted, unseen = folds(samples, self.kind, self.bench.blocks, self.bench.stated)[self.number]
        return FoldTrial(UnseenToo(problem, samples.take(fitted), samples.take(unseen)), self.bench.metric)


class UnseenToo(BoundProblem):
    """Fitted rows with the geometry alone, for the harness; methods get the whole arm and all rows."""

    def __init__(self, arm: Problem, fitted: Samples, unseen: Samples) -> None:
        bound = bind(arm.without_terms, fitted)
        super().__init__(bound.problem, bound.slots, bound.samples, surveys=bound.surveys)
        self.arm, self.fitted, self.unseen = arm, fitted, unseen


@dataclass(frozen=True)
class FoldTrial:
    """Rows to fit, unseen rows, and the metric of their residuals."""

    problem: UnseenToo
    metric: str

    def judge(self, result: Result) -> dict[str, float]:
        """Sum of squared residuals, number of unseen rows, and whether the method's own verdict refused its result."""
        squares = squares_of(result.trace["left"], self.metric)
        refused = float(result.trace["refused"][0])
        return {"squares": float(squares.sum()), "rows": float(squares.size), "refused": refused}

    def detail(self, result: Result) -> Mapping[str, Any]:
        """No further data."""
        del result
        return {}


def squares_of(residuals: Array, metric: str) -> Array:
    """Squared error (N,) of each unseen row's residuals (N, m) by the set's metric; CasacalError where not finite."""
    if residuals.ndim != 2 or not np.isfinite(residuals).all():
        raise CasacalError(f"Residuals came in the shape {residuals.shape}, or not finite", "Return (N, m) of them")
    if metric == "rms":
        return np.asarray((residuals**2).mean(axis=1))
    return np.asarray((residuals[:, : 3 if metric == "position" else None] ** 2).sum(axis=1))


@dataclass(frozen=True)
class Told:
    """Residuals (N, m) of the unseen rows, and the method's own verdict on its result."""

    residuals: Array
    verdict: str


def left(bound: BoundProblem, x: Array, unseen: Samples) -> Array:
    """Residuals (N, m) of unseen rows at x (n,); unknowns of labels that were not fitted are fitted to their rows."""
    further = bind_further(bound, unseen)
    return further.plain_residual(extended(further, x)).reshape(len(unseen), -1)


Way = Callable[[Problem, Samples, Samples], Array | Told]


def estimate(metered: Any, way: Way) -> Result:
    """Residuals of a method on unseen rows, in place of a trace."""
    problem: UnseenToo = metered.problem  # the problem whose evaluations the harness counts
    answer = way(problem.arm, problem.fitted, problem.unseen)
    answer = answer if isinstance(answer, Told) else Told(answer, "")
    residuals, refused = np.asarray(answer.residuals, dtype=np.float64), answer.verdict == "do not use"
    trace = {"left": residuals, "refused": np.array([float(refused)])}
    return Result("bench", problem, problem.x0.copy(), Status.UNSAID, trace)


def read_ways(files: Iterable[str | Path]) -> dict[str, Way]:
    """The methods that files define, by name; raises CasacalError where one defines none."""
    ways = dict[str, Way]()
    for file in files:
        if not Path(file).is_file():
            raise CasacalError(f"There is no file '{file}'", "Name one that defines `methods`: --methods FILE")
        found = names_of(Path(file)).get("methods")
        if not isinstance(found, dict) or not found or not all(callable(way) for way in found.values()):
            raise CasacalError(f"{file} defines no `methods`", 'Add methods = {"mine": mine}, functions by name')
        ways |= {str(name): way for name, way in found.items()}
    return ways


def benchmark(sets: Sequence[BenchmarkSet], data: str | Path, ways: Mapping[str, Way], *, quick: bool = False) -> Study:
    """A study of these sets and methods; its quick form has few rows and one block of each set.

    Raises CasacalError where a set's measurements are missing, or cannot be split as it says.
    """
    settings = {}
    for each in sets:
        samples = each.read(data, each.problem, quick=quick)
        for kind in (BLOCKED,) if quick else KINDS:
            count = len(folds(samples, kind, each.blocks, each.stated))
            for number in range(min(count, 1) if quick else count):
                settings[f"{each.name} / {kind} / {number + 1}"] = Fold(each, str(data), kind, number, quick)
    methods = {name: Method(partial(estimate, way=way)) for name, way in ways.items()}
    return Study("bench", settings, methods, trials=1, details=0)


def bench_lines(run: Run, sets: Sequence[BenchmarkSet]) -> list[str]:
    """The page, as lines."""
    lines = [
        "# Benchmark",
        "",
        "Root mean square of what a method leaves of rows that it has not seen, in mm; of poses, of their positions.",
        "*Stated*: the split that the set's own page names. *Random*: five folds. *Blocked*: regions of postures, or",
        "contiguous rows. Intervals are 95 %, by bootstrap over folds. *Leak*: blocked over random; a method that is",
        f"much worse on blocks ({LEAKS:g} and more are bold) knows the neighbours of a row rather than the arm.",
        f"{REFUSED}: the method's own verdict, in some fold, is not to use its result; the figure stands all the same.",
        "Published figures are of the stated split where a set names one; *yes* within 5 %.",
    ]
    assert run.study is not None
    for each in sets:
        header = ("method", *KINDS, "leak", "published", "reproduced")
        rows = [_row(run, each, method) for method in run.study.methods]
        lines += ["", f"## {each.title}", "", f"`{each.name}`; {each.source}; licence: {each.licence}.", ""]
        lines += ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
        lines += ["| " + " | ".join(row) + " |" for row in rows]
        pairs = [(setting, method) for setting in _settings(run, each.name) for method in run.study.methods]
        failed = {f"- `{method}`: {words}" for setting, method in pairs for words in run.failures(setting, method)}
        lines += ["", *sorted(failed)] if failed else []
    return lines


def _row(run: Run, each: BenchmarkSet, method: str) -> list[str]:
    found = {}
    for kind in KINDS:
        folds_of = _settings(run, each.name, kind)
        squares, rows = (
            np.concatenate([np.zeros(0), *(run.values(setting, method, figure) for setting in folds_of)])
            for figure in ("squares", "rows")
        )
        found[kind] = root_mean_square(squares, rows)
    refused = any((run.values(setting, method, "refused") == 1).any() for setting in _settings(run, each.name))
    leak = found[BLOCKED].value / found[RANDOM].value
    shown = "–" if not math.isfinite(leak) else f"**{leak:.2f}**" if leak >= LEAKS else f"{leak:.2f}"
    cells = [f"{method} {REFUSED}" if refused else method, *map(_shown, found.values()), shown]
    theirs = next((published for published in each.published if published.method == method), None)
    if theirs is None:
        return [*cells, "–", "–"]
    mine = found[STATED].value if math.isfinite(found[STATED].value) else found[RANDOM].value
    same = "yes" if abs(mine / theirs.figure - 1) <= REPRODUCED else "better" if mine < theirs.figure else "no"
    # the few rows of the quick form are not those of the published figure
    return [*cells, f"{theirs.figure:g} ({theirs.by})", "–" if run.quick else same]


def root_mean_square(squares: Array, rows: Array) -> Interval:
    """RMS from sums of squares and row counts of folds, with a bootstrap interval over folds (NaN for one fold).

    Not a number where there is no fold, or a figure of one is none.
    """
    if not squares.size or not np.isfinite(squares).all():
        return Interval(math.nan, math.nan, math.nan)
    total = float(np.sqrt(squares.sum() / rows.sum()))
    if squares.size < 2:
        return Interval(total, math.nan, math.nan)
    drawn = np.random.default_rng(0).integers(squares.size, size=(2000, squares.size))
    values = np.sqrt(squares[drawn].sum(axis=1) / rows[drawn].sum(axis=1))
    low, high = np.quantile(values, [0.025, 0.975])
    return Interval(total, float(low), float(high))


def _settings(run: Run, name: str, kind: str = "") -> list[str]:
    assert run.study is not None
    return [setting for setting in run.study.settings if setting.startswith(f"{name} / {kind}")]


def _shown(figure: Interval) -> str:
    if not math.isfinite(figure.value):
        return "–"
    return f"{figure.value:.3f}" + (f" ({figure.low:.3f} to {figure.high:.3f})" if math.isfinite(figure.low) else "")

"""A public data set, and how its rows are split into fitted and unseen ones."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.errors import CasacalError, UnknownNameError, refuse_unknown
from casacal.problem.problem import Problem
from casacal.problem.problem_file import load_problem
from casacal.samples.samples import Samples
from casacal.tables.columns import Labels
from casacal.uncertainty.transfer import REGIONS, splits
from casacal.values import FrozenMapping, Value

Rows = NDArray[np.intp]

FOLDS = 5
MOST_BLOCKS = 12

STATED, RANDOM, BLOCKED = "stated", "random", "blocked"


def folds(samples: Samples, kind: str, blocks: str, stated: Mapping[str, Any]) -> list[tuple[Rows, Rows]]:
    """Rows to fit and rows that are not seen, fold by fold: "stated", "random" or "blocked".

    stated: {"part": 0.3, "seed": 0}, the last of a permutation, of so many "rows" of it where these are said;
    {"folds": 5, "seed": 0}; {"column": "split", "value": "test"}; or nothing.

    Raises CasacalError where the set cannot be split so.
    """
    everything = np.arange(len(samples))
    if kind == RANDOM:
        return _against(everything, _folds(np.random.default_rng(0).permutation(len(samples)), FOLDS))
    if kind == BLOCKED:
        return _against(everything, _blocks(samples, blocks))
    order = np.random.default_rng(stated.get("seed", 0)).permutation(len(samples))
    if "column" in stated:
        labels, value = _labels(samples, stated["column"]), stated["value"]
        refuse_unknown(f"value of '{stated['column']}' in {samples.file}", [value], labels.names)
        return _against(everything, [np.flatnonzero(labels.codes == labels.names.index(value))])
    asked = max(stated.get("folds", 2), stated.get("rows", 2))
    if asked > len(samples):
        raise CasacalError(f"{samples.file} has {len(samples)} rows, and its split needs {asked}", "State another")
    if "folds" in stated:
        return _against(everything, _folds(order, stated["folds"]))
    if "part" not in stated:
        return []
    order = order[: stated.get("rows", len(order))]
    return _against(order, [order[round((1 - stated["part"]) * len(order)) :]])


def _against(rows: Rows, unseen: list[Rows]) -> list[tuple[Rows, Rows]]:
    """Each of the unseen with the others of these rows."""
    return [(np.setdiff1d(rows, part), np.sort(part)) for part in unseen]


def _blocks(samples: Samples, blocks: str) -> list[Rows]:
    if blocks == "order":
        return _folds(np.arange(len(samples)), FOLDS)
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


def _folds(order: Rows, count: int) -> list[Rows]:
    return [np.sort(part) for part in np.array_split(order, count)]


WAYS_TO_SPLIT = 'part = 0.3, seed = 0 (of so many "rows"); folds = 5, seed = 0; or column = "split", value = "test"'


def checked_split(stated: object, place: str) -> Mapping[str, Any]:
    """The [stated] of a description, where it is one of the ways to split; nothing is one.

    Raises CasacalError that names the `place` where something else came.
    """
    if not isinstance(stated, Mapping):
        raise CasacalError(f"The stated split of {place} is {stated!r}", f"Use a table with {WAYS_TO_SPLIT}")
    if not stated:
        return stated
    way = next((name for name in FORMS if name in stated), "")
    known = FORMS.get(way, {})
    lost = sorted(known.keys() - stated.keys() - OPTIONAL)
    strange = [name for name in stated if name not in known or not known[name](stated[name])]
    if not way or lost or strange:
        told = f"has {strange[0]} = {stated[strange[0]]!r}" if strange else f"lacks {lost[0]}"
        raise CasacalError(f"The stated split of {place} {told}", f"Use {WAYS_TO_SPLIT}")
    return stated


def _whole(least: int) -> Callable[[object], bool]:
    return lambda value: isinstance(value, int) and not isinstance(value, bool) and value >= least


def _label(value: object) -> bool:
    return isinstance(value, str)


FORMS: Mapping[str, Mapping[str, Callable[[object], bool]]] = {
    "part": {"part": lambda value: isinstance(value, float) and 0 < value < 1, "seed": _whole(0), "rows": _whole(2)},
    "folds": {"folds": _whole(2), "seed": _whole(0)},
    "column": {"column": _label, "value": _label},
}
"""What each way to split says, and which values it takes."""

OPTIONAL = {"seed", "rows"}


DESCRIPTION = "set.toml"
METRICS = ("distance", "position", "rms")


@dataclass(frozen=True)
class Published:
    """A figure that somebody stated: of which way to calibrate, in the unit of the set's metric, and by whom."""

    method: str
    figure: float
    by: str


@dataclass(frozen=True, eq=False)
class BenchmarkSet(Value):
    """A folder with set.toml and problem.py, and measurements that stand elsewhere.

    metric: "distance" is the root mean square of the length of a row's residual, "position" that of its first three
    components, "rms" that of all components.
    blocks: what is left out together in the blocked split: "order" (of the rows), "regions" (of postures), or a column.
    stated: how the set's own page splits it, as `folds` takes it.
    """

    name: str
    title: str
    source: str
    licence: str
    file: str
    sha256: str
    metric: str
    blocks: str
    stated: Mapping[str, Any]
    published: tuple[Published, ...]
    folder: str

    @property
    def problem(self) -> Problem:
        """Its arm and instrument."""
        return load_problem(self.folder).problem

    def read(self, data: Path, problem: Problem) -> Samples:
        """Its rows among the data; raises CasacalError unless they are there as they were."""
        path = data / self.file
        if not path.is_file():
            raise CasacalError(f"The measurements of '{self.name}' are not at {path}", f"Get them from {self.source}")
        if hashlib.sha256(path.read_bytes()).hexdigest() != self.sha256:
            fix = "Fetch it again, or correct its hash"
            raise CasacalError(f"{path} is not the file that '{self.name}' describes", fix)
        return problem.read(path)


def read_set(folder: str | Path) -> BenchmarkSet:
    """The set that a folder describes; raises CasacalError where a part is missing or of the wrong kind."""
    path = Path(folder) / DESCRIPTION
    try:
        told = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise CasacalError(f"There is no {DESCRIPTION} in '{folder}'", "Describe the set there") from None
    except ValueError as error:  # no TOML, or no UTF-8
        raise CasacalError(f"{path} is no TOML: {error}", "Mend it") from None
    words = ("title", "source", "licence", "file", "sha256", "metric", "blocks")
    for word in words:
        if not isinstance(told.get(word), str):
            raise CasacalError(f"{path} does not say its {word}", f'Add {word} = "..."')
    if told["metric"] not in METRICS:
        raise CasacalError(f"The metric of {path} is '{told['metric']}'", f"Use {' or '.join(METRICS)}")
    try:
        found = tuple(Published(str(p["method"]), float(p["figure"]), str(p["by"])) for p in told.get("published", ()))
    except (KeyError, TypeError, ValueError):
        raise CasacalError(f"A published figure of {path} lacks a part", "Say method, figure and by") from None
    title, source, licence, file, sha256, metric, blocks = (told[word] for word in words)
    stated, place = FrozenMapping(checked_split(told.get("stated", {}), str(path))), Path(folder)
    name = place.resolve().name
    return BenchmarkSet(name, title, source, licence, file, sha256, metric, blocks, stated, found, place.as_posix())


def read_sets(folder: str | Path) -> tuple[BenchmarkSet, ...]:
    """All sets below a folder, by name; raises CasacalError where there is none."""
    found = sorted(path.parent for path in Path(folder).glob(f"*/{DESCRIPTION}"))
    if not found:
        fix = f"Give a folder of folders with {DESCRIPTION}"
        raise CasacalError(f"There is no set of the benchmark in '{folder}'", fix)
    return tuple(read_set(each) for each in found)

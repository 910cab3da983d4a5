"""A data set of the benchmark: where it comes from, its arm, how its rows are split, and what others published."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from casacal.bench.splits import checked_split
from casacal.errors import CasacalError
from casacal.problem.problem import Problem
from casacal.problem.problem_file import load_problem
from casacal.samples.samples import Samples
from casacal.values import FrozenMapping, Value

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

    def place(self, data: Path) -> Path:
        """Where its measurements are among the data; raises CasacalError unless they are there as they were."""
        path = data / self.file
        if not path.is_file():
            raise CasacalError(f"The measurements of '{self.name}' are not at {path}", f"Get them from {self.source}")
        if hashlib.sha256(path.read_bytes()).hexdigest() != self.sha256:
            raise CasacalError(
                f"{path} is not the file that '{self.name}' describes", "Fetch it again, or correct its hash"
            )
        return path

    def read(self, data: Path, problem: Problem) -> Samples:
        """Its rows; raises CasacalError as `place` does."""
        return problem.read(self.place(data))


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
        raise CasacalError(
            f"There is no set of the benchmark in '{folder}'", f"Give a folder of folders with {DESCRIPTION}"
        )
    return tuple(read_set(each) for each in found)

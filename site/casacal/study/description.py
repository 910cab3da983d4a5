"""What a study is, settings, methods, trials and a seed, and what it is once it has run; values that run nothing."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np

from casacal.array_types import Array
from casacal.errors import StudyError
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result
from casacal.study.fingerprint import code_fingerprint, fingerprint
from casacal.study.records import Record, records_digest

Estimator: TypeAlias = Callable[..., Result | Array]
"""A function of a `LeastSquares` that returns a `Result`, or the estimate x (n,) alone."""


class Trial(Protocol):
    """One problem that all methods of a trial solve, and how an answer is judged."""

    @property
    def problem(self) -> LeastSquares:
        """What every method gets."""

    def judge(self, result: Result) -> Mapping[str, float]:
        """Figures of merit by name; called by the harness, untimed."""

    def detail(self, result: Result) -> Mapping[str, Any]:
        """What the first trial keeps besides: numbers, texts and lists of them."""


class Setting(Protocol):
    """Where trials come from: a problem in a cell, a file of measurements split at random, ..."""

    def trial(self, seed: int) -> Trial:
        """The trial of a seed; the same for the same seed, whoever asks."""


@dataclass(frozen=True)
class Method:
    """An estimator with its options.

    Args:
        estimate: the function.
        options: keyword arguments of every call.
        seeded: whether it takes `seed`, which then differs from trial to trial.
        trials: in how many trials it takes part, the first ones; None for all.

    """

    estimate: Estimator
    options: Mapping[str, Any] = field(default_factory=dict)
    seeded: bool = False
    trials: int | None = None

    def __call__(self, problem: LeastSquares, seed: int) -> Result | Array:
        """Estimate, with options of its own, and the seed where the function takes one."""
        return self.estimate(problem, **copy.deepcopy(dict(self.options)), **({"seed": seed} if self.seeded else {}))


@dataclass(frozen=True)
class Study:
    """Every method on every trial of every setting, on the same truth, poses and noise.

    Args:
        name: a word.
        settings: by name, such as `Simulated(problem, cell)`.
        methods: by name, a `Method` or a plain function of a `LeastSquares`.
        trials: how many per setting.
        seed: of all of them; trial k of every setting gets the same child of it.
        details: how many trials, the first ones, also keep the objective on the way; the very first its estimates too.

    Raises StudyError when a part is missing.

    """

    name: str
    settings: Mapping[str, Setting]
    methods: Mapping[str, Method | Estimator]
    trials: int = 200
    seed: int = 0
    details: int = 1

    def __post_init__(self) -> None:
        if not self.settings or not self.methods:
            raise StudyError(f"The study '{self.name}' has no setting or no method", "Give at least one of each")
        for name, what in self.methods.items():
            if not callable(what):
                fix = "Give a function"
                raise StudyError(f"Method '{name}' of the study '{self.name}' is a {type(what).__name__}", fix)
        if self.trials < 1:
            raise StudyError(f"The study '{self.name}' has {self.trials} trials", "Give at least one")

    def method(self, name: str) -> Method:
        """A method by name."""
        found = self.methods[name]
        return found if isinstance(found, Method) else Method(found)

    def trials_of(self, method: str) -> int:
        """In how many trials of a setting a method takes part."""
        most = self.method(method).trials
        return self.trials if most is None else min(most, self.trials)

    def trial_seed(self, trial: int) -> int:
        """Seed of a trial: a child of the study's, whatever else runs."""
        return _spawned(self.seed, trial)

    def method_seed(self, trial: int, method: str) -> int:
        """Seed of a method in a trial."""
        return _spawned(self.seed, trial, *method.encode())

    def fingerprint(self, setting: str, method: str) -> str:
        """Key of what determines the records of a setting and a method, all but the trial's number."""
        how = self.method(method)
        what = [setting, self.settings[setting], method, how.estimate, how.options, how.seeded]
        return fingerprint([self.name, what, self.seed, self.details, code_fingerprint()])


@dataclass(frozen=True)
class Run:
    """What a report is made from: the study, its records in order, and the folder for its pictures."""

    study: Study | None
    records: tuple[Record, ...]
    out: Path
    quick: bool = False

    def of(self, setting: str, method: str) -> list[Record]:
        """Records of a method in a setting, by trial."""
        return list(self._sorted.get((setting, method), []))

    @cached_property
    def _sorted(self) -> dict[tuple[str, str], list[Record]]:
        found: dict[tuple[str, str], list[Record]] = {}
        for record in self.records:
            found.setdefault((record["setting"], record["method"]), []).append(record)
        return found

    def values(self, setting: str, method: str, name: str, *, group: str = "figures") -> Array:
        """One figure (trials,) by trial; not a number where the method failed or has no such figure.

        group: "figures", "counts" or "seconds".
        """
        found = (record[group].get(name) for record in self.of(setting, method))
        return np.array([np.nan if value is None else value for value in found], dtype=np.float64)

    def failures(self, setting: str, method: str) -> list[str]:
        """What the failures of a method in a setting said."""
        return [record["error"] for record in self.of(setting, method) if record["error"] is not None]

    @property
    def digest(self) -> str:
        """SHA-256 of the records, timings aside: the same wherever and in whatever order they were made."""
        return records_digest(self.records)


def _spawned(seed: int, *key: int) -> int:
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint64)[0])

"""Where each unknown stands in x, and what each row sees of it: settled once, when samples are bound."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.enough_rows import check_rows, instances
from casacal.binding.nominal import nominal_sight
from casacal.discrepancy.effect import Site
from casacal.errors import ProblemError, came
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.unknowns import Parameter, Unknown
from casacal.values import Value, read_only

ENOUGH = 20_000
"""Rows of a face that propose where it is."""


@dataclass(frozen=True, eq=False)
class Slot(Value):
    """One instance of an unknown, and where its local coordinates stand in x."""

    key: str
    unknown: Unknown
    label: str | None
    nominal: Array
    first: int
    datum: bool
    beside: str = ""
    """The effect beside the geometry that it belongs to, by its key."""

    @property
    def name(self) -> str:
        """Key, with the label where there is one instance per label."""
        return self.key if self.label is None else f"{self.key}.{self.label}"

    @property
    def columns(self) -> range:
        """Its positions in x."""
        return range(self.first, self.first + self.unknown.size)

    def sized(self, times: float) -> Slot:
        """The same with all prior standard deviations multiplied."""
        return (
            self
            if times == 1
            else replace(self, unknown=self.unknown.with_prior([float(std) * times for std in self.unknown.prior_stds]))
        )

    def value(self, x: Array) -> Any:
        """Its value at x (n,)."""
        return self.unknown.at(self.nominal, x[self.first : self.first + self.unknown.size])

    def numbers(self) -> Iterator[tuple[str, str, float, int | None]]:
        """Every number of a parameter: name, unit, nominal, position in x (None when held); none of another kind."""
        if isinstance(self.unknown, Parameter):
            free = dict(zip(self.unknown.names(self.name), self.columns, strict=True))
            names = self.unknown.component_names(self.name)
            for name, nominal in zip(names, self.nominal, strict=True):
                yield name, self.unknown.unit, float(nominal), free.get(name)


def nominals(slots: Sequence[Slot]) -> dict[str, Array]:
    """Nominal values by name, of what does not differ by label."""
    return {slot.name: slot.nominal for slot in slots if slot.label is None}


@dataclass(frozen=True)
class Coordinates:
    """What is known of each coordinate of x (n,) beforehand; `beside` names the effect that it belongs to, or none."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    beside: tuple[str, ...]
    x0: Array
    prior_std: Array
    start_std: Array
    datum: NDArray[np.bool_]


def coordinates(slots: Sequence[Slot]) -> Coordinates:
    """Of all slots, in their order."""
    seen = [slot for slot in slots if slot.unknown.size]
    sizes, none = [slot.unknown.size for slot in seen], np.zeros(0)
    return Coordinates(
        tuple(name for slot in seen for name in slot.unknown.names(slot.name)),
        tuple(unit for slot in seen for unit in slot.unknown.units),
        tuple(slot.beside for slot, size in zip(seen, sizes, strict=True) for _ in range(size)),
        read_only(np.zeros(sum(sizes))),
        read_only(np.concatenate([none, *(slot.unknown.prior_stds for slot in seen)])),
        read_only(np.concatenate([none, *(slot.unknown.start_stds for slot in seen)])),
        read_only(np.repeat([slot.datum for slot in seen], sizes).astype(bool)),
    )


def make_slots(problem: Problem, samples: Sequence[Samples], known: Mapping[str, Array] | None = None) -> list[Slot]:
    """Lay out x: the robot's parameters, then each instrument's unknowns, those that differ by label last.

    What is known, by name of its slot, has that nominal however few rows see it. Raises ProblemError as `bind` does.
    """
    if not isinstance(problem, Problem):
        raise ProblemError(f"Got {came(problem)} as the problem", "Give a Problem; load_problem(path).problem is one")
    for some in samples:
        if not isinstance(some, Samples):
            raise ProblemError(f"Got {came(some)} as samples", "Give Samples; problem.read(path) returns them")
    if len(samples) != len(problem.instruments):
        raise ProblemError(
            f"Got {len(samples)} sets of samples for {len(problem.instruments)} instruments", "Give one set each"
        )
    slots: list[Slot] = []
    taken: set[str] = set()
    fits_all, known = known is None, known or {}

    def add(key: str, unknown: Unknown, label: str | None, nominal: Array, datum: bool, beside: str = "") -> None:
        first = slots[-1].first + slots[-1].unknown.size if slots else 0
        slots.append(Slot(key, unknown, label, read_only(nominal), first, datum, beside))
        taken.add(slots[-1].name)

    for key, unknown in problem.robot.parameters.items():
        if unknown.nominal is None:
            raise ProblemError(f"Robot parameter '{key}' has no nominal value", "Declare one")
        add(key, unknown, None, unknown.nominal, False)
    for i, instrument in enumerate(problem.instruments):
        for key, unknown in sorted(instrument.unknowns.items(), key=lambda item: item[1].per is not None):
            for label, rows in instances(instrument, key, unknown, samples[i]):
                full = problem.full_names[i][key]
                name = full if label is None else f"{full}.{label}"
                if name in taken:  # shared with an instrument before
                    continue
                nominal = known.get(name, unknown.nominal)
                if name not in known:
                    check_rows(problem, i, key, unknown, label, rows, samples[i], fits_all=fits_all)
                if nominal is None:
                    few = rows[:: -(-len(rows) // ENOUGH) or 1]
                    nominal = instrument.propose(key, nominal_sight(problem, i, samples[i].take(few)))
                add(full, unknown, label, nominal, key in instrument.datum)
        for effect in problem.models[i].effects:
            for key, unknown in effect.unknowns(Site(problem.robot, instrument)).items():
                for label, _ in instances(instrument, key, unknown, samples[i]):
                    full = key if effect.moves else problem.prefix(i) + key
                    if (full if label is None else f"{full}.{label}") not in taken:
                        add(full, unknown, label, np.zeros(unknown.nominal_size), False, effect.key)
    return slots

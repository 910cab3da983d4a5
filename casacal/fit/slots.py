"""Layout of x: the place of each unknown, its nominal, and whether rows suffice; settled when samples are bound."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casacal.data.columns import Labels
from casacal.data.samples import Samples
from casacal.errors import CasacalError, ProblemError, came, said
from casacal.fit.nominal import Place, nominal_sight, sought
from casacal.model.instrument import Instrument, NoProposalError, Sight
from casacal.model.problem import Problem
from casacal.model.unknown import Parameter, Unknown
from casacal.values import Array, Index, Value, read_only, short
from casacal.wording import counted


def instances(instrument: Instrument, key: str, unknown: Unknown, samples: Samples) -> list[tuple[str | None, Index]]:
    """Labels of an unknown's instances (None when there is one for all), with the rows of each."""
    if unknown.per is None:
        return [(None, np.arange(len(samples)))]
    labels = samples.labels[unknown.per]
    have = Labels.coded((instrument.instance(key, label) for label in labels.names), labels.codes)
    return list(have.rows().items())


def _check_arguments(problem: object, samples: Sequence[object]) -> None:
    """Raise ProblemError for what is no problem, no samples, or not a set for each instrument."""
    if not isinstance(problem, Problem):
        raise ProblemError(f"Got {came(problem)} as the problem", "Give a Problem; load_problem(path).problem is one")
    for some in samples:
        if not isinstance(some, Samples):
            raise ProblemError(f"Got {came(some)} as samples", "Give Samples; problem.read(path) returns them")
    if len(samples) != len(problem.instruments):
        raise ProblemError(
            f"Got {len(samples)} sets of samples for {len(problem.instruments)} instruments", "Give one set each"
        )


def _check_rows(
    problem: Problem, i: int, unknown: Unknown, which: str, rows: int, samples: Samples, *, fits_all: bool
) -> None:
    """Raise ProblemError where a datum of instrument `i` has no more rows than flat unknowns of its own.

    fits_all: whether the arm is to be fitted to these rows too, so that the sentence says how many that takes.
    """
    components = problem.models[i].components
    flat = int((~np.isfinite(unknown.prior_stds)).sum())
    if rows * components > flat:
        return
    fix, instrument = f"Take at least {flat // components + 1} rows there", problem.instruments[i]
    if fits_all and len(problem.instruments) > 1:
        fix += ", and many more to learn about the arm"
    elif fits_all:
        own = sum(u.size * len(instances(instrument, key, u, samples)) for key, u in instrument.unknowns.items())
        total = own + sum(unknown.size for unknown in problem.robot.parameters.values())
        for_all = f"at least {-(-total // components)} in all for {counted(total, 'unknown')}"
        fix += f", and {for_all}, better twice as many; or hold parameters with --fix"
    raise ProblemError(
        f"{samples.file}: '{which}' has {counted(rows, 'row')} for {counted(flat, 'unknown')} of its own", fix
    )


def proposed(instrument: Instrument, key: str, unknown: Unknown, sight: Sight) -> Array | None:
    """Nominal value that an instrument proposes, None to search for it; raises ProblemError for an invalid one."""
    whose = f"`propose` of {type(instrument).__name__}"
    try:
        found = np.asarray(instrument.propose(key, sight), dtype=np.float64)
    except NoProposalError:
        return None
    except CasacalError:
        raise
    except Exception as error:
        fix = "Mend it, or leave it out: the residuals then find where it stands"
        raise ProblemError(f"{whose} failed for '{key}': {said(error)}", fix) from error
    if found.shape != (unknown.nominal_size,) or not np.isfinite(found).all():
        what = f"{whose} gave {short(np.ravel(found).tolist())} for '{key}'"
        raise ProblemError(what, f"Give {unknown.nominal_size} finite numbers, as `encode` of its kind does")
    return found


ENOUGH = 20_000  # rows of a face that propose where it is


@dataclass(frozen=True, eq=False)
class Slot(Value):
    """One instance of an unknown, and the place of its local coordinates in x."""

    key: str
    unknown: Unknown
    label: str | None
    nominal: Array
    first: int
    datum: bool
    term: str = ""
    """Key of the term beside the geometry that it belongs to; empty for the geometry."""

    @property
    def name(self) -> str:
        """Key, with the label where there is one instance per label."""
        return self.key if self.label is None else f"{self.key}.{self.label}"

    @property
    def columns(self) -> range:
        """Its positions in x."""
        return range(self.first, self.first + self.unknown.size)

    @property
    def held_as_drawn(self) -> bool:
        """Whether it, or part of it, is held where the samples have it if the arm is as drawn: it has no nominal."""
        if self.unknown.nominal is not None or not getattr(self.unknown, "held_as_proposed", False):
            return False
        return self.unknown.size < self.unknown.freed().size

    def sized(self, times: float) -> Slot:
        """Slot with prior standard deviations scaled."""
        stds = [float(std) * times for std in self.unknown.prior_stds]
        return self if times == 1 else replace(self, unknown=self.unknown.with_prior(stds))

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
    """Nominal values, by name, of unknowns that do not differ by label."""
    return {slot.name: slot.nominal for slot in slots if slot.label is None}


def make_slots(problem: Problem, samples: Sequence[Samples], known: Mapping[str, Array] | None = None) -> list[Slot]:
    """Lay out x: the robot's parameters, then each instrument's unknowns, those that differ by label last.

    known: nominals by name of the slot, kept however few rows see them. Raises ProblemError as `bind` does.
    """
    _check_arguments(problem, samples)
    slots: list[Slot] = []
    taken: set[str] = set()
    fits_all, known = known is None, known or {}

    def add(key: str, unknown: Unknown, label: str | None, nominal: Array, datum: bool, term: str = "") -> None:
        first = slots[-1].first + slots[-1].unknown.size if slots else 0
        slots.append(Slot(key, unknown, label, read_only(nominal), first, datum, term))
        taken.add(slots[-1].name)

    for key, unknown in problem.robot.parameters.items():
        add(key, unknown, None, np.asarray(unknown.nominal), False)
    for i, instrument in enumerate(problem.instruments):
        places: list[Place] = []
        whole: Sight | None = None  # of all rows, unless they are many
        for key, unknown in sorted(instrument.unknowns.items(), key=lambda item: item[1].per is not None):
            for label, rows in instances(instrument, key, unknown, samples[i]):
                full = problem.full_names[i][key]
                name = full if label is None else f"{full}.{label}"
                if name in taken:  # shared with an instrument before
                    there = next(slot.nominal for slot in slots if slot.name == name)
                    places.append(Place(name, key, unknown, rows, there))
                    continue
                nominal = known.get(name)
                nominal = unknown.nominal if nominal is None else nominal
                if name not in known and key in instrument.datum:
                    _check_rows(problem, i, unknown, label or key, len(rows), samples[i], fits_all=fits_all)
                if nominal is None:
                    few = rows[:: -(-len(rows) // ENOUGH) or 1]
                    if whole is None and len(samples[i]) <= ENOUGH:
                        whole = nominal_sight(problem, i, samples[i])
                    sight = nominal_sight(problem, i, samples[i].take(few)) if whole is None else whole.of(few)
                    nominal = proposed(instrument, key, unknown, sight)
                places.append(Place(name, key, unknown, rows, nominal))
                add(full, unknown, label, np.zeros(0) if nominal is None else nominal, key in instrument.datum)
        if any(place.nominal is None for place in places):
            found = sought(problem, i, samples[i], places)
            slots[:] = [replace(slot, nominal=read_only(found.get(slot.name, slot.nominal))) for slot in slots]
        for term, unknowns in problem.symbols_of(i).of_terms:
            for key, unknown in unknowns.items():
                for label, _ in instances(instrument, key, unknown, samples[i]):
                    full = key if term.moves else problem.prefix(i) + key
                    if (full if label is None else f"{full}.{label}") not in taken:
                        add(full, unknown, label, np.zeros(unknown.nominal_size), False, term.key)
    return slots

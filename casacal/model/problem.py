"""A problem: a robot with one or more instruments; bound to samples it becomes a least-squares problem."""

from __future__ import annotations

import hashlib
import math
import operator
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from casacal.data.samples import Layout, Samples, read_any_table
from casacal.data.text import KEY, joined_tables
from casacal.errors import ProblemError, SamplesError, UnknownNameError, came, refuse_unknown
from casacal.model.constraint import Constraint, Correlation
from casacal.model.instrument import Instrument, Words, check_declaration, with_setting, with_unknown
from casacal.model.robot import Robot
from casacal.model.term import Term
from casacal.model.trace import RowModel, Symbols
from casacal.model.unknown import Unknown
from casacal.values import EMPTY, FrozenMapping, Value
from casacal.wording import html_table

NAME = re.compile("[A-Za-z][A-Za-z0-9_-]*")

Shared = Mapping[str, tuple[str, ...]]  # keys of unknowns that instruments have in common, and the names of these
Compiled = list[tuple[tuple[Term, ...], tuple[RowModel, ...]]]
"""Terms, and the compiled functions of each instrument with these: one list of problems that differ in priors alone."""


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Problem(Value):
    """A robot and the instruments that measured it; a value, without state of its own.

    Raises ProblemError for what is none of these, when names collide, or when an instrument declares no noise.
    """

    robot: Robot
    instruments: tuple[Instrument, ...]
    terms: tuple[Term, ...]
    """Non-geometric terms that rows may show."""
    names: tuple[str, ...]
    """Names of the instruments."""
    shared: Shared
    """Keys of unknowns that some instruments have in common, and the names of these."""
    constraints: tuple[Constraint | Correlation, ...]
    """What is known of the unknowns beside rows and their own priors; expressions are graphs."""

    def __init__(
        self,
        robot: Robot,
        *instruments: Instrument | Mapping[str, Instrument],
        terms: Sequence[Term] = (),
        shared: Mapping[str, Sequence[str]] = EMPTY,
        constraints: Sequence[Constraint | Correlation] = (),
        compiled: Compiled | None = None,
    ) -> None:
        """Put a problem together.

        Args:
            robot: the arm.
            instruments: one; or several, in a mapping by name, such as {"dial": ..., "tracker": ...}.
            terms: what rows may show beside the geometry, such as `casacal.discrepancy` has; without any, `calibrate`
                takes those that any arm is expected to have.
            shared: which unknowns some instruments have in common, such as {"tool": ("dial", "spike")} where one tip
                touches plates and a spike. All others are an instrument's own.
            constraints: what the unknowns are known to meet, by `equal` and `between`, such as two lengths out of one
                mould, which estimators keep exactly; and what was measured of them, by `certified`.
            compiled: of a problem that differs in terms and priors alone; by default nothing is compiled yet.

        """
        named: dict[str, Any] = {f"instrument{i}": instrument for i, instrument in enumerate(instruments, 1)}
        if len(instruments) == 1 and isinstance(instruments[0], Mapping):
            named = dict(instruments[0])
            for name in named:
                if not isinstance(name, str) or not NAME.fullmatch(name):
                    fix = "Use letters, digits, - and _, a letter first, such as 'tracker'"
                    raise ProblemError(f"An instrument is called {name!r}", fix)
        _check_parts(robot, tuple(named.values()), terms)
        object.__setattr__(self, "terms", tuple(terms))
        object.__setattr__(self, "robot", robot)
        object.__setattr__(self, "instruments", tuple(named.values()))
        object.__setattr__(self, "names", tuple(named))
        object.__setattr__(self, "shared", _shared_by(shared, named))
        object.__setattr__(self, "constraints", self._traced(constraints))
        if compiled is not None:
            object.__setattr__(self, "_compiled", compiled)

    def __eq__(self, other: object) -> bool:
        """Whether both are about the same arm and instruments, to the last operation of their residuals."""
        if self is other or not isinstance(other, Problem):
            return self is other
        alike = self.names == other.names or len(self.instruments) == 1  # an only one needs no name
        known = self.shared == other.shared and self.constraints == other.constraints
        return alike and known and self._symbols == other._symbols

    def __hash__(self) -> int:
        return hash((self.robot, tuple(type(instrument).__qualname__ for instrument in self.instruments)))

    def __repr__(self) -> str:
        return f"<Problem: {self.robot!r} measured by {self._said}>"

    def _repr_html_(self) -> str:
        """Table for notebooks: free unknowns with unit and prior."""
        rows = [
            (name, unit, f"{std:.3g}" if math.isfinite(std) else "flat")
            for key, unknown in self._named()
            for name, unit, std in zip(unknown.names(key), unknown.units, unknown.prior_stds, strict=True)
        ]
        return html_table(repr(self), ("unknown", "unit", "prior standard deviation"), rows)

    @property
    def instrument(self) -> Instrument:
        """The only instrument; raises ProblemError where there are several."""
        if len(self.instruments) > 1:
            what = f"'{self.robot.name}' is measured by {len(self.instruments)} instruments ({self._said})"
            fix = f"Take one of them, such as problem.measured_by('{self.names[0]}')"
            raise ProblemError(f"{what}, and this takes one", fix)
        return self.instruments[0]

    @property
    def words(self) -> Words:
        """Words for reports: those of the only instrument, or what several have in common."""
        each = [instrument.words for instrument in self.instruments]
        if len(each) == 1:
            return each[0]
        units = " or ".join(dict.fromkeys(said.unit for said in each))
        alone = " and ".join(dict.fromkeys(said.before.removesuffix(" fitted alone") for said in each))
        trusted = " and ".join(dict.fromkeys(said.trusted for said in each if said.trusted))
        return Words(unit=units, before=f"{alone} fitted alone", trusted=trusted)

    def measured_by(self, name: str) -> Problem:
        """A copy with one of its instruments, and what is known of the arm; UnknownNameError where it has none such."""
        of_arm = self.robot.parameters.items()
        arms = {each for key, unknown in of_arm for each in (key, *unknown.component_names(key))}
        kept = [each for each in self.constraints if arms.issuperset(each.names)]
        only = {name: self.instruments[self.number(name)]}
        return Problem(self.robot, only, terms=self.terms, constraints=kept)

    def number(self, name: str) -> int:
        """Which instrument has a name, from 0; raises UnknownNameError where none has it."""
        refuse_unknown("instrument", [name], self.names)
        return self.names.index(name)

    def prefix(self, instrument: int) -> str:
        """Prefix of an instrument's own unknowns; empty when there is only one instrument."""
        return "" if len(self.instruments) == 1 else f"{self.names[instrument]}."

    @cached_property
    def full_names(self) -> tuple[Mapping[str, str], ...]:
        """For each instrument the full name of each of its unknowns, by key: "tracker.station", or "tool" if shared."""
        return tuple(
            {key: key if name in self.shared.get(key, ()) else self.prefix(i) + key for key in instrument.unknowns}
            for i, (name, instrument) in enumerate(zip(self.names, self.instruments, strict=True))
        )

    def with_parts(
        self,
        robot: Robot,
        instruments: Sequence[Instrument],
        *,
        terms: Sequence[Term] | None = None,
        constraints: Sequence[Constraint | Correlation] | None = None,
        compiled: Compiled | None = None,
    ) -> Problem:
        """A copy with another robot, other instruments of the same names, perhaps other terms; see `Problem`."""
        together = dict(zip(self.names, instruments, strict=True))
        terms, known = self.terms if terms is None else terms, self.constraints if constraints is None else constraints
        return Problem(robot, together, terms=terms, shared=self.shared, constraints=known, compiled=compiled)

    @property
    def model(self) -> RowModel:
        """Compiled functions of the only instrument; raises ProblemError where there are several."""
        _ = self.instrument
        return self.models[0]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of what it computes, of its priors and of what its instruments read."""
        parts = [f"{self.layout(i)!r}\n{model.text}" for i, model in enumerate(self.models)]
        parts += [f"{key} {unknown!r}" for key, unknown in self._named()] + [repr(term) for term in self.terms]
        parts += [repr(each) for each in self.constraints]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    @cached_property
    def _compiled(self) -> Compiled:
        return []

    @cached_property
    def models(self) -> tuple[RowModel, ...]:
        """Compiled functions, one set per instrument; built on first use, for all that differ in priors alone."""
        for terms, models in self._compiled:
            if len(terms) == len(self.terms) and all(map(operator.is_, terms, self.terms)):
                return models
        made = tuple(symbols.model for symbols in self._symbols)
        self._compiled.append((self.terms, made))
        return made

    @property
    def symbols(self) -> Symbols:
        """The robot with its only instrument as CasADi expressions; raises ProblemError where there are several."""
        _ = self.instrument
        return self._symbols[0]

    def symbols_of(self, instrument: int) -> Symbols:
        """The robot with one of its instruments, by number from 0; raises ProblemError where there is no such one."""
        if not 0 <= instrument < len(self._symbols):
            fix = f"Give 0 to {len(self._symbols) - 1}, there are {len(self._symbols)}"
            raise ProblemError(f"There is no instrument {instrument} of '{self.robot.name}'", fix)
        return self._symbols[instrument]

    @cached_property
    def _symbols(self) -> tuple[Symbols, ...]:
        return tuple(Symbols(self.robot, instrument, self.terms) for instrument in self.instruments)

    def layout(self, instrument: int = 0) -> Layout:
        """Columns a samples file of one instrument must have."""
        chosen = self.instruments[instrument]
        labels = dict.fromkeys(unknown.per for unknown in chosen.unknowns.values() if unknown.per is not None)
        labels |= dict.fromkeys([chosen.known_by] if chosen.known_columns else [])
        return Layout(
            joints=tuple("angle" if joint.turns else "length" for joint in self.robot.axes),
            columns=FrozenMapping(dict(chosen.columns)),
            labels=tuple(labels),
            refused=FrozenMapping(dict(chosen.refused_columns)),
            further=tuple(dict.fromkeys(name for term in self.terms for name in term.further)),
        )

    def read(
        self,
        path: str | Path,
        instrument: int = 0,
        *,
        readings: str | Path | None = None,
        key: str = KEY,
        absurd: bool = False,
    ) -> Samples:
        """Read a samples file of one instrument, CSV, .xlsx, .npy or .npz: rows in rad and mm, validated.

        readings: a second file, with a reading for each pose of the first, where that holds joint values alone. key:
        column of both that says which reading belongs to which pose. absurd: whether values pass that no robot has.
        Raises SamplesError.
        """
        layout = self.layout(instrument)
        if not isinstance(path, (str, Path)):
            fix = "Give a path; Samples.from_frame takes a frame"
            raise SamplesError("samples", f"Got {came(path)} as the file", fix)
        if readings is None:
            return Samples.from_file(path, layout, absurd=absurd)
        together = joined_tables(read_any_table(path), read_any_table(readings), key=key)
        return Samples.from_table(together, layout, absurd=absurd)

    def fix(self, *names: str) -> Problem:
        """Copy with unknowns held at nominal, by key ("alpha") or component ("a3"); UnknownNameError for others."""
        changed = self
        for name in names:
            key, unknown, meant = changed._meant(name)
            changed = changed._with(key, unknown.with_free([not hit for hit in meant]))
        return changed

    def free(self, *names: str) -> Problem:
        """Copy with unknowns estimated that were held, with their priors: by key or component; or UnknownNameError."""
        changed = self
        for name in names:
            known = dict(changed._named())
            key = next((key for key, unknown in known.items() if name in (key, *unknown.component_names(key))), None)
            if key is None:
                every = (each for key, unknown in known.items() for each in (key, *unknown.component_names(key)))
                raise UnknownNameError("unknown", name, list(dict.fromkeys(every)))
            freed = known[key].freed(None if name == key else name.removeprefix(key))
            if freed.size != known[key].size:  # what is free already keeps what was compiled
                changed = changed._with(key, freed)
        return changed

    def with_prior(
        self, stds: Mapping[str, float] = EMPTY, *, covariance: Mapping[tuple[str, ...], Any] = EMPTY
    ) -> Problem:
        """Copy with other prior standard deviations, mm or rad, by key or component; `math.inf` is flat.

        covariance: matrices (k, k) of prior errors that belong together, by the names of these components, such as
        {("a2", "a3"): [[0.4, 0.1], [0.1, 0.4]]}. Standard deviations that are given later keep the correlation.

        Raises UnknownNameError for a name that does not exist or is held, ProblemError for what is no covariance, and
        for names in two of them or with a standard deviation beside it.
        """
        if not isinstance(covariance, Mapping):
            fix = 'Give a dict of matrices by names, such as {("a2", "a3"): [[0.4, 0.1], [0.1, 0.4]]}'
            raise ProblemError(f"Got {came(covariance)} as the covariance", fix)
        changed, known = self, list(self.constraints)
        for names, matrix in covariance.items():
            one, own = Correlation.of(names, matrix)
            known = [each for each in known if each.name != one.name]
            if both := {n for each in known if isinstance(each, Correlation) for n in each.names}.intersection(names):
                raise ProblemError(f"'{min(both)}' is known together with others", "Give one covariance of all")
            if both := set(own).intersection(stds):
                fix = "Give its standard deviation by the covariance alone"
                raise ProblemError(f"'{min(both)}' has a standard deviation and a covariance", fix)
            known, stds = [*known, one], {**stds, **own}
        for name, std in stds.items():
            key, unknown, meant = changed._meant(name)
            units = sorted({unit for unit, hit in zip(unknown.units, meant, strict=True) if hit})
            if len(units) > 1:
                what = f"'{name}' has components in {' and '.join(units)}, so one standard deviation does not fit all"
                raise ProblemError(what, f"Name a component: {', '.join(unknown.names(name))}")
            each = zip(unknown.prior_stds, meant, strict=True)
            changed = changed._with(key, unknown.with_prior([std if hit else float(before) for before, hit in each]))
        return changed.with_parts(changed.robot, changed.instruments, constraints=known, compiled=self._compiled)

    def with_settings(self, values: Mapping[str, float | tuple[float, float]]) -> Problem:
        """Copy with other numbers of its instrument, such as {"sign": -1}, {"noise_std": 0.02}, {"travel": (-5, 5)}.

        Of several instruments after its name: {"dial.sign": -1}. Raises UnknownNameError for what is none of its
        numbers, ProblemError for a value that it refuses.
        """
        changed = list(self.instruments)
        for name, value in values.items():
            of, _, setting = name.rpartition(".")
            i = self.number(of or name) if len(changed) > 1 else 0
            changed[i] = with_setting(changed[i], setting if len(changed) > 1 else name, value)
        return self.with_parts(self.robot, changed)

    def with_terms(self, *terms: Term) -> Problem:
        """Copy with these terms beside the geometry, in the place of those it had; of one key the last."""
        known = {getattr(term, "key", term): term for term in terms}
        return self.with_parts(self.robot, self.instruments, terms=tuple(known.values()), compiled=self._compiled)

    @cached_property
    def without_terms(self) -> Problem:
        """Its geometry alone."""
        return self.with_terms() if self.terms else self

    def free_names(self) -> list[str]:
        """Keys and components that `fix` and `with_prior` understand."""
        free = ((key, unknown.names(key)) for key, unknown in self._named() if unknown.size)
        return list(dict.fromkeys(name for key, names in free for name in (key, *names)))

    def _named(self) -> Iterator[tuple[str, Unknown]]:
        """Every unknown by its name, once: those of the robot, then of each instrument."""
        yield from self.robot.parameters.items()
        found: dict[str, Unknown] = {}
        for instrument, full in zip(self.instruments, self.full_names, strict=True):
            for key, unknown in instrument.unknowns.items():
                found.setdefault(full[key], unknown)
        yield from found.items()

    @property
    def exact(self) -> tuple[Constraint, ...]:
        """The constraints that hold exactly."""
        return tuple(each for each in self.constraints if isinstance(each, Constraint) and not each.std)

    def _traced(self, constraints: Any) -> tuple[Constraint | Correlation, ...]:
        """Constraints with their expressions as graphs; ProblemError for what is none, or has another's name."""
        if not isinstance(constraints, (tuple, list)):
            raise ProblemError(f"Got {came(constraints)} as the constraints", "Give them in a tuple")
        unknowns = dict(self._named()) if constraints else {}
        for k, each in enumerate(constraints):
            if not isinstance(each, (Constraint, Correlation)):
                raise ProblemError(f"Got {came(each)} as a constraint", "Give what equal, between or certified makes")
            if each.name in (other.name for other in constraints[:k]):
                raise ProblemError(f"Two constraints are called '{each.name}'", "Give each a name of its own")
        return tuple(each.traced(unknowns) for each in constraints)

    @property
    def _said(self) -> str:
        kinds = [type(instrument).__name__ for instrument in self.instruments]
        return ", ".join(map(": ".join, zip(self.names, kinds, strict=True))) if len(kinds) > 1 else kinds[0]

    def _meant(self, name: str) -> tuple[str, Unknown, list[bool]]:
        """The unknown that a name means, and which of its free components: all by its key, or one."""
        for key, unknown in self._named():
            meant = [name in (key, component) for component in unknown.names(key)]
            if any(meant):
                return key, unknown, meant
        raise UnknownNameError("free unknown", name, self.free_names())

    def _with(self, name: str, unknown: Unknown) -> Problem:
        """Copy with another unknown in the place of the one of that full name, wherever it is shared."""
        robot, changed = self.robot, []
        if name in robot.parameters:
            robot = replace(robot, parameters={**robot.parameters, name: unknown})
        for instrument, full in zip(self.instruments, self.full_names, strict=True):
            key = next((key for key, known in full.items() if known == name), None)
            changed.append(instrument if key is None else with_unknown(instrument, key, unknown))
        return self.with_parts(robot, changed)


def _check_parts(robot: Any, instruments: Sequence[Any], terms: Sequence[Any]) -> None:
    """Raise ProblemError for what is no robot, instrument or term, for names that collide, and without any noise."""
    if not isinstance(robot, Robot):
        raise ProblemError(f"Got {came(robot)} as the robot", "Give a Robot, such as Robot.from_dh(...) makes")
    if not instruments:
        raise ProblemError(f"Problem '{robot.name}' has no instrument", "Give at least one, such as DialOnPlane")
    if not isinstance(terms, (tuple, list)):
        raise ProblemError(f"Got {came(terms)} as the terms", "Give them in a tuple")
    for term in terms:
        if not isinstance(term, Term):
            raise ProblemError(f"Got {came(term)} as a term", "Give what casacal.discrepancy has, or one's own")
        term.check()
    keys = [term.key for term in terms]
    if twice := next((key for key in keys if keys.count(key) > 1), ""):
        raise ProblemError(f"The term '{twice}' came twice", "Give each once")
    noisy_joints = any(joint.repeatability_std > 0 for joint in robot.axes)
    for instrument in instruments:
        check_declaration(instrument)
        name = type(instrument).__name__
        if both := sorted(set(robot.parameters) & set(instrument.unknowns)):
            raise ProblemError(f"Robot and {name} both name '{both[0]}'", "Rename one of them")
        noisy = noisy_joints or instrument.blocks or any(std > 0 for std in instrument.column_stds.values())
        if instrument.residual_std <= 0 and not noisy:
            fix = "Give it a residual_std, or column_stds of what it reads: standard deviations"
            raise ProblemError(f"{name} declares no noise", fix)


def _shared_by(shared: Any, instruments: Mapping[str, Instrument]) -> Shared:
    """Shared unknowns as declared; refused where instruments lack one, or declare it differently."""
    if not isinstance(shared, Mapping):
        fix = 'Name it and the instruments, such as shared={"tool": ("dial", "spike")}'
        raise ProblemError(f"Got {came(shared)} as what instruments share", fix)
    found: dict[str, tuple[str, ...]] = {}
    for key, names in shared.items():
        if isinstance(names, str) or not isinstance(names, Sequence) or len(set(names)) < 2:
            fix = f'Name two instruments or more, such as shared={{"{key}": ("dial", "spike")}}'
            raise ProblemError(f"'{key}' is shared by {names!r}", fix)
        refuse_unknown("instrument", names, instruments)
        for name in names:
            if key not in instruments[name].unknowns:
                have = ", ".join(instruments[name].unknowns) or "none"
                raise ProblemError(f"'{name}' has no unknown '{key}' to share", f"It has: {have}")
        first, *others = (instruments[name].unknowns[key] for name in names)
        if any(other != first for other in others):
            what = f"'{key}' is declared in different ways by {' and '.join(names)}, which share it"
            raise ProblemError(what, "Declare it once, and give the same to each")
        found[str(key)] = tuple(names)
    return FrozenMapping(found)

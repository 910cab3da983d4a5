"""What a problem is put together from: a robot, instruments by name, what these share, effects beside the geometry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

from casacal.discrepancy import Effect
from casacal.errors import ProblemError, UnknownNameError
from casacal.instruments import Instrument, Words
from casacal.problem.edits import all_unknowns
from casacal.problem.named_instruments import Shared, full_names, named, shared_by
from casacal.problem.parts import check_parts
from casacal.robots.robot import Robot
from casacal.unknowns import Unknown
from casacal.values import FrozenMapping, Value

NOTHING: Shared = FrozenMapping({})


@dataclass(frozen=True, init=False, eq=False, repr=False)
class MeasuredArm(Value):
    """A robot and what measures it; instruments and their unknowns have names."""

    robot: Robot
    instruments: tuple[Instrument, ...]
    effects: tuple[Effect, ...]
    """What arm and cell do beside their geometry."""
    names: tuple[str, ...]
    """Of the instruments."""
    shared: Shared
    """Keys of unknowns that some instruments have in common, and the names of these."""

    def __init__(
        self,
        robot: Robot,
        *instruments: Instrument | Mapping[str, Instrument],
        effects: Sequence[Effect] = (),
        shared: Mapping[str, Sequence[str]] = NOTHING,
    ) -> None:
        """Put a problem together.

        Args:
            robot: the arm.
            instruments: one; or several, in a mapping by name, such as {"dial": ..., "tracker": ...}.
            effects: what arm and cell do beside their geometry; none takes those that any arm is expected to have.
            shared: which unknowns some instruments have in common, such as {"tool": ("dial", "spike")} where one tip
                touches plates and a spike. All others are an instrument's own.

        """
        names, each = named(instruments)
        check_parts(robot, each, effects)
        object.__setattr__(self, "effects", tuple(effects))
        object.__setattr__(self, "robot", robot)
        object.__setattr__(self, "instruments", each)
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "shared", shared_by(shared, dict(zip(names, each, strict=True))))

    @property
    def instrument(self) -> Instrument:
        """The only instrument; raises ProblemError where there are several."""
        if len(self.instruments) > 1:
            raise ProblemError(
                f"'{self.robot.name}' is measured by {len(self.instruments)} instruments ({self._said}), and this "
                "takes one",
                f"Take one of them, such as problem.measured_by('{self.names[0]}')",
            )
        return self.instruments[0]

    @property
    def words(self) -> Words:
        """How reports call what the only instrument measures, or what several have in common."""
        each = [instrument.words for instrument in self.instruments]
        if len(each) == 1:
            return each[0]
        units, trusted = dict.fromkeys(said.unit for said in each), dict.fromkeys(said.trusted for said in each)
        alone = " and ".join(dict.fromkeys(said.before.removesuffix(" fitted alone") for said in each))
        return Words(
            unit=" or ".join(units),
            before=f"{alone} fitted alone",
            trusted=" and ".join(said for said in trusted if said),
        )

    def measured_by(self, name: str) -> Self:
        """The same arm with one of its instruments; raises UnknownNameError where there is no such one."""
        return type(self)(self.robot, {name: self.instruments[self.number(name)]}, effects=self.effects)

    def number(self, name: str) -> int:
        """Which instrument has a name, from 0; raises UnknownNameError where none has it."""
        if name not in self.names:
            raise UnknownNameError("instrument", str(name), list(self.names))
        return self.names.index(name)

    def prefix(self, instrument: int) -> str:
        """How the names of an instrument's own unknowns begin: with nothing when there is only one."""
        return "" if len(self.instruments) == 1 else f"{self.names[instrument]}."

    @cached_property
    def full_names(self) -> tuple[Mapping[str, str], ...]:
        """For each instrument the full name of each of its unknowns, by key: "tracker.station", or "tool" if shared."""
        return tuple(full_names(self.names, self.instruments, self.shared))

    def with_parts(self, robot: Robot, instruments: Sequence[Instrument]) -> Self:
        """The same with another robot and other instruments of the same names."""
        return self._copy(robot, instruments, self.effects)

    def _copy(self, robot: Robot, instruments: Sequence[Instrument], effects: Sequence[Effect]) -> Self:
        together = dict(zip(self.names, instruments, strict=True))
        return type(self)(robot, together, effects=effects, shared=self.shared)

    def _named(self) -> Iterator[tuple[str, Unknown]]:
        return all_unknowns(self.robot, self.instruments, self.full_names)

    @property
    def _named_alike(self) -> tuple[str, ...]:
        return self.names if len(self.instruments) > 1 else ()

    @property
    def _said(self) -> str:
        kinds = (type(instrument).__name__ for instrument in self.instruments)
        named = zip(self.names, kinds, strict=True)
        return ", ".join(kind if len(self.names) == 1 else f"{name}: {kind}" for name, kind in named)

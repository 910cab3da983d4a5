"""What a problem is put together from: a robot, instruments by name, what these share, effects beside the geometry."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

from casacal.discrepancy import Effect
from casacal.errors import ProblemError, came, refuse_unknown
from casacal.instruments import Instrument, Words
from casacal.instruments.instrument import check_declaration
from casacal.robots.robot import Robot
from casacal.unknowns import Unknown
from casacal.values import FrozenMapping, Value, is_real


def _check_parts(robot: Any, instruments: Sequence[Any], effects: Sequence[Any]) -> None:
    """Raise ProblemError for what is no robot, instrument or effect, for names that collide, and without any noise."""
    if not isinstance(robot, Robot):
        raise ProblemError(f"Got {came(robot)} as the robot", "Give a Robot, such as Robot.from_dh(...) makes")
    if not instruments:
        raise ProblemError(f"Problem '{robot.name}' has no instrument", "Give at least one, such as DialOnPlane")
    if not isinstance(effects, (tuple, list)):
        raise ProblemError(f"Got {came(effects)} as the effects", "Give them in a tuple, such as kit() makes")
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ProblemError(f"Got {came(effect)} as an effect", "Give what casacal.discrepancy has, or one's own")
        for what, least in (("size", 0.0), ("doubt", 1.0), ("most", 1.0)):
            value = getattr(effect, what)
            if not is_real(value) or not least <= value < math.inf or value == 0:
                fix = f"Give a positive number, {least:g} or more" if least else "Give a positive number"
                raise ProblemError(f"The {what} of {type(effect).__name__} is {value!r}", fix)
    keys = [effect.key for effect in effects]
    if twice := next((key for key in keys if keys.count(key) > 1), ""):
        raise ProblemError(f"The effect '{twice}' came twice", "Give each once")
    noisy_joints = any(joint.repeatability_std > 0 for joint in robot.axes)
    for instrument in instruments:
        check_declaration(instrument)
        name = type(instrument).__name__
        if both := sorted(set(robot.parameters) & set(instrument.unknowns)):
            raise ProblemError(f"Robot and {name} both name '{both[0]}'", "Rename one of them")
        noisy = noisy_joints or instrument.blocks or any(std > 0 for std in instrument.column_stds.values())
        if instrument.residual_std <= 0 and not noisy:
            raise ProblemError(f"{name} declares no noise", "Give the standard deviation of its measurements")


NAME = re.compile("[A-Za-z][A-Za-z0-9_-]*")

Shared = Mapping[str, tuple[str, ...]]
"""Keys of unknowns that instruments have in common, and the names of these."""


def _named(given: Sequence[Any]) -> dict[str, Any]:
    """Instruments by name: of a mapping as it says, else "instrument1" and so on."""
    if len(given) != 1 or not isinstance(given[0], Mapping):
        return {f"instrument{i}": instrument for i, instrument in enumerate(given, 1)}
    for name in given[0]:
        if not isinstance(name, str) or not NAME.fullmatch(name):
            fix = "Use letters, digits, - and _, a letter first, such as 'tracker'"
            raise ProblemError(f"An instrument is called {name!r}", fix)
    return dict(given[0])


def _shared_by(shared: Any, instruments: Mapping[str, Instrument]) -> Shared:
    """What was declared as shared; refused where instruments do not have it, or not alike."""
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
            raise ProblemError(
                f"'{key}' is declared in different ways by {' and '.join(names)}, which share it",
                "Declare it once, and give the same to each",
            )
        found[str(key)] = tuple(names)
    return FrozenMapping(found)


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
        named = _named(instruments)
        _check_parts(robot, tuple(named.values()), effects)
        object.__setattr__(self, "effects", tuple(effects))
        object.__setattr__(self, "robot", robot)
        object.__setattr__(self, "instruments", tuple(named.values()))
        object.__setattr__(self, "names", tuple(named))
        object.__setattr__(self, "shared", _shared_by(shared, named))

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
        refuse_unknown("instrument", [name], self.names)
        return self.names.index(name)

    def prefix(self, instrument: int) -> str:
        """How the names of an instrument's own unknowns begin: with nothing when there is only one."""
        return "" if len(self.instruments) == 1 else f"{self.names[instrument]}."

    @cached_property
    def full_names(self) -> tuple[Mapping[str, str], ...]:
        """For each instrument the full name of each of its unknowns, by key: "tracker.station", or "tool" if shared."""
        return tuple(
            {key: key if name in self.shared.get(key, ()) else self.prefix(i) + key for key in instrument.unknowns}
            for i, (name, instrument) in enumerate(zip(self.names, self.instruments, strict=True))
        )

    def with_parts(
        self, robot: Robot, instruments: Sequence[Instrument], effects: Sequence[Effect] | None = None
    ) -> Self:
        """The same with another robot, other instruments of the same names, perhaps other effects."""
        together = dict(zip(self.names, instruments, strict=True))
        effects = self.effects if effects is None else effects
        return type(self)(robot, together, effects=effects, shared=self.shared)

    def _named(self) -> Iterator[tuple[str, Unknown]]:
        """Every unknown by its name, once: those of the robot, then of each instrument."""
        yield from self.robot.parameters.items()
        found: dict[str, Unknown] = {}
        for instrument, full in zip(self.instruments, self.full_names, strict=True):
            for key, unknown in instrument.unknowns.items():
                found.setdefault(full[key], unknown)
        yield from found.items()

    @property
    def _said(self) -> str:
        kinds = (type(instrument).__name__ for instrument in self.instruments)
        named = zip(self.names, kinds, strict=True)
        return ", ".join(kind if len(self.names) == 1 else f"{name}: {kind}" for name, kind in named)

"""The unknowns of a robot and its instruments by name, and copies in which one of them is another."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from casacal.errors import ProblemError
from casacal.instruments import Instrument
from casacal.instruments.instrument import with_unknown
from casacal.robots.robot import Robot
from casacal.unknowns import Unknown

Names = Sequence[Mapping[str, str]]
"""For each instrument the full name of each of its unknowns, by key."""


def all_unknowns(robot: Robot, instruments: Sequence[Instrument], names: Names) -> Iterator[tuple[str, Unknown]]:
    """Every unknown by its name, once: those of the robot, then of each instrument."""
    yield from robot.parameters.items()
    told: set[str] = set()
    for instrument, full in zip(instruments, names, strict=True):
        for key, unknown in instrument.unknowns.items():
            if full[key] not in told:
                yield full[key], unknown
            told.add(full[key])


def replaced(
    robot: Robot, instruments: Sequence[Instrument], names: Names, name: str, unknown: Unknown
) -> tuple[Robot, list[Instrument]]:
    """Robot and instruments with another unknown in the place of the one of that full name, wherever it is shared."""
    if name in robot.parameters:
        robot = dataclasses.replace(robot, parameters={**robot.parameters, name: unknown})
    changed = []
    for instrument, full in zip(instruments, names, strict=True):
        key = next((key for key, known in full.items() if known == name), None)
        changed.append(instrument if key is None else with_unknown(instrument, key, unknown))
    return robot, changed


def chosen(name: str, key: str, unknown: Unknown) -> list[bool]:
    """Which free components of an unknown a name means: all by its key, or one."""
    return [name in (key, component) for component in unknown.names(key)]


def with_std(name: str, std: float, unknown: Unknown, chosen: list[bool]) -> Unknown:
    """An unknown with another prior standard deviation of the components that a name means.

    Raises ProblemError where these are of different units.
    """
    units = sorted({unit for unit, hit in zip(unknown.units, chosen, strict=True) if hit})
    if len(units) > 1:
        raise ProblemError(
            f"'{name}' has components in {' and '.join(units)}, so one standard deviation does not fit all",
            f"Name a component: {', '.join(unknown.names(name))}",
        )
    pairs = zip(unknown.prior_stds, chosen, strict=True)
    return unknown.with_prior([std if hit else float(before) for before, hit in pairs])

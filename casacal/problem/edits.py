"""The unknowns of a robot and its instruments by name, and copies in which one of them is another."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import TypeAlias

from casacal.errors import ProblemError
from casacal.instruments import Instrument
from casacal.instruments.declaration import with_unknown
from casacal.robots.robot import Robot
from casacal.unknowns import Unknown

Prefixed: TypeAlias = Mapping[str, Instrument]
"""Instruments by what the names of their unknowns begin with."""


def all_unknowns(robot: Robot, instruments: Prefixed) -> Iterator[tuple[str, Unknown]]:
    """Every unknown by its name: those of the robot, then of each instrument."""
    yield from robot.parameters.items()
    for prefix, instrument in instruments.items():
        for key, unknown in instrument.unknowns.items():
            yield prefix + key, unknown


def replaced(robot: Robot, instruments: Prefixed, name: str, unknown: Unknown) -> tuple[Robot, list[Instrument]]:
    """Robot and instruments with another unknown in the place of the one of that name, prefix included."""
    if name in robot.parameters:
        robot = dataclasses.replace(robot, parameters={**robot.parameters, name: unknown})
    changed = []
    for prefix, instrument in instruments.items():
        key = name.removeprefix(prefix)
        of_it = name.startswith(prefix) and key in instrument.unknowns
        changed.append(with_unknown(instrument, key, unknown) if of_it else instrument)
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

"""One trace of a robot with an instrument: the expressions that row functions, public symbols and C code are made of.

`pose` and `residual` are run once on symbols. Coordinates of a row:

    z  local coordinates of the robot's parameters and the instrument's unknowns, in that order
    c  numbers that fix those nominal values which differ by label or are proposed by the data
    d  the row itself: joint values, then the instrument's columns, then those known from labels
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import casadi as ca

from casacal.discrepancy.effect import Effect, Here, Site
from casacal.errors import ProblemError
from casacal.instruments import Instrument
from casacal.kinematics import Expression, Product
from casacal.robots.robot import Robot
from casacal.unknowns import Unknown


@dataclass(frozen=True)
class Seen:
    """What `pose`, `tip` and `residual` build of values p, joint values q and a row's columns."""

    pose: Expression
    """4x4, mm; a `Product` where the robot's function returns one."""
    tip: ca.SX
    residual: ca.SX
    plunger: ca.SX | None


@dataclass(frozen=True)
class Trace:
    """Symbols of one robot with one instrument, and the expressions that its functions build of them."""

    robot: Robot
    instrument: Instrument
    effects: tuple[Effect, ...]
    unknowns: Mapping[str, Unknown]
    """Of the robot, then of the instrument, then of the effects."""
    constants: tuple[str, ...]
    """Keys of the unknowns whose nominal is part of c, in order."""
    nominals: Mapping[str, Any]
    """Nominal of each unknown: numbers, or symbols of c."""
    q: ca.SX
    columns: Mapping[str, ca.SX]
    local: Mapping[str, ca.SX]
    """z, unknown by unknown."""
    values: Mapping[str, Any]
    """p: the value of each unknown at z and c."""
    seen: Seen

    @property
    def z(self) -> ca.SX:
        """Local coordinates (nz)."""
        return ca.vertcat(*self.local.values())

    @property
    def c(self) -> ca.SX:
        """Constants (nc)."""
        return ca.vertcat(*(self.nominals[key] for key in self.constants)) if self.constants else ca.SX(0, 1)

    @property
    def d(self) -> ca.SX:
        """The row (nd)."""
        return ca.vertcat(self.q, *self.columns.values())

    @cached_property
    def raw(self) -> tuple[ca.SX, ca.SX]:
        """Raw coordinates v, which only the IPOPT reference uses, and the residual (m) at them."""
        raw = {key: ca.SX.sym(key, unknown.raw_size) for key, unknown in self.unknowns.items()}
        p = {key: unknown.raw_value(self.nominals[key], raw[key]) for key, unknown in self.unknowns.items()}
        return ca.vertcat(*raw.values()), self.at(p).residual

    @cached_property
    def free(self) -> tuple[Mapping[str, ca.SX], Seen]:
        """A symbol for the whole value of each unknown, by key, and what is built of them: p itself is an input."""
        packed = {key: ca.SX(unknown.packed(self.values[key])) for key, unknown in self.unknowns.items()}
        symbols = {key: ca.SX.sym(key, *matrix.shape) for key, matrix in packed.items()}
        return symbols, self.at({key: self.unknowns[key].unpacked(symbol) for key, symbol in symbols.items()})

    def at(self, values: Mapping[str, Any]) -> Seen:
        """What the functions build of other values p."""
        return seen(self.robot, self.instrument, self.effects, values, self.q, self.columns)


def trace(robot: Robot, instrument: Instrument, effects: Sequence[Effect] = ()) -> Trace:
    """Trace one robot with one instrument, and what arm and cell do beside their geometry.

    Raises ProblemError when `pose`, `tip` or `residual` fails or has the wrong shape.
    """
    unknowns: dict[str, Unknown] = {**robot.parameters, **instrument.unknowns}
    site = Site(robot, instrument)
    effects = tuple(effect for effect in effects if effect.unknowns(site))
    for effect in effects:
        unknowns |= effect.unknowns(site)
    q = ca.SX.sym("q", len(robot.axes))
    beside = dict.fromkeys(name for effect in effects for name in effect.columns(site))
    columns = {name: ca.SX.sym(name) for name in (*instrument.columns, *instrument.known_columns, *beside)}
    nominals = {key: _nominal(key, unknown) for key, unknown in unknowns.items()}
    local = {key: ca.SX.sym(key, unknown.size) for key, unknown in unknowns.items()}
    values = {key: unknown.at(nominals[key], local[key]) for key, unknown in unknowns.items()}
    return Trace(
        robot=robot,
        instrument=instrument,
        effects=effects,
        unknowns=unknowns,
        constants=tuple(key for key, value in nominals.items() if isinstance(value, ca.SX)),
        nominals=nominals,
        q=q,
        columns=columns,
        local=local,
        values=values,
        seen=seen(robot, instrument, effects, values, q, columns),
    )


def seen(
    robot: Robot,
    instrument: Instrument,
    effects: Sequence[Effect],
    values: Mapping[str, Any],
    q: ca.SX,
    columns: Mapping[str, ca.SX],
) -> Seen:
    """Run the user's functions on symbols; raises ProblemError as `trace`."""
    p, row, kind = SimpleNamespace(**values), SimpleNamespace(**columns), type(instrument).__name__
    pose = _traced(robot.pose, "pose", robot.name, (4, 4), p, q)
    if effects:
        pose, row = _with_effects(Here(robot, instrument, p, q, pose, row), effects, columns)
    residual = _traced(instrument.residual, "residual", kind, None, pose, p, row)
    here = Here(robot, instrument, p, q, pose, SimpleNamespace(**columns))
    for effect in effects:
        found = _traced(_or_nothing(effect.residual), "residual", effect.words, None, here)
        residual += _in_its_unit(instrument, residual, found, effect.words)
    if (
        columns
        and instrument.columns
        and not any(ca.depends_on(ca.SX(residual), columns[name]) for name in instrument.columns)
    ):
        names = ", ".join(f"row.{name}" for name in instrument.columns)
        raise ProblemError(
            f"The residual of {kind} does not depend on what it reads, its column '{next(iter(instrument.columns))}'",
            f"Use {names}, or declare no columns",
        )
    tip = _traced(instrument.tip, "tip", kind, (3, 1), pose, p, row)
    plunger = instrument.plunger_direction(pose, p)
    return Seen(pose, tip, residual, None if plunger is None else ca.SX(plunger))


def _with_effects(
    here: Here, effects: Sequence[Effect], columns: Mapping[str, ca.SX]
) -> tuple[Expression, SimpleNamespace]:
    """Flange pose and row as they truly are, where joints, flange and readings err."""
    robot, count = here.robot, len(here.robot.axes)
    off = [_traced(_or_nothing(effect.joints), "joints", effect.words, None, here) for effect in effects]
    moved = [each for each in off if each.numel() == count]
    if moved:
        q = here.q + sum(moved, ca.SX.zeros(count))
        here = replace(here, pose=_traced(robot.pose, "pose", robot.name, (4, 4), here.p, q))
    read = dict(columns)
    for effect in effects:
        if (changed := effect.pose(here)) is not None:
            here = replace(here, pose=changed)
        for name, error in effect.reading(here).items():
            read[name] = read[name] + error
    return here.pose, SimpleNamespace(**read)


def _in_its_unit(instrument: Instrument, residual: Expression, found: ca.SX, words: str) -> Any:
    """What an effect adds to the components in the unit in which the instrument speaks; nothing to others."""
    units = [block.unit for block in instrument.blocks for _ in range(block.size)]
    alike = [unit == instrument.words.unit for unit in units]
    if len(alike) != residual.numel():
        alike = [True] * residual.numel()
    if found.numel() in (0, 1):  # nothing at all, or all components alike
        return ca.DM([float(each) for each in alike]) * ca.sum1(found)
    if found.numel() != sum(alike):
        said = f"residual of '{words}' has {found.numel()} components"
        raise ProblemError(said, f"It must have one, or the {sum(alike)} of the instrument's residual")
    each = iter(range(found.numel()))
    return ca.vertcat(*(found[next(each)] if one else 0 for one in alike))


def _or_nothing(call: Any) -> Any:
    """The same with nothing (0, 1) for None."""

    def called(*arguments: Any) -> Any:
        found = call(*arguments)
        return ca.SX(0, 1) if found is None else found

    return called


def _nominal(key: str, unknown: Unknown) -> Any:
    """Numbers where the nominal is known and the same for all rows, else symbols."""
    if unknown.nominal is None or unknown.per is not None:
        return ca.SX.sym(f"{key}_nominal", unknown.nominal_size)
    return ca.DM(unknown.nominal)


def _traced(call: Any, what: str, owner: str, shape: tuple[int, int] | None, *arguments: Any) -> Any:
    try:
        built = call(*arguments)
        value = built if isinstance(built, Product) else ca.SX(built)
        found = value.shape  # a product is multiplied out here, so that factors that do not fit are found
    except (
        Exception,
        SystemExit,
    ) as error:  # whatever a user's function raises, it is their problem file that must change
        raise ProblemError(
            f"{what} of '{owner}' failed with {type(error).__name__}: {' '.join(str(error).split())}",
            "It must build CasADi expressions from its arguments; see casacal.kinematics",
        ) from error
    if shape is not None and found != shape:
        raise ProblemError(f"{what} of '{owner}' has the shape {found}", f"It must be {shape}")
    if found[1] != 1 and shape is None:
        raise ProblemError(f"{what} of '{owner}' has the shape {found}", "It must be a scalar or a column")
    return value

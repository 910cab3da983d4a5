"""Carriers of an arm or its work (rail, gantry, turntable, another arm), and carrier and arm as one chain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from casacal.errors import ProblemError, came
from casacal.model.geometry import Direction
from casacal.model.joints import MOST_TURNED, Joint
from casacal.model.kinematics import Expression, chain, position, rigid, rotation, screw, slide
from casacal.model.robot import PoseFunction, Robot
from casacal.model.unknown import PRIOR_STD, Parameter
from casacal.values import Names, is_real

CARRIER = "carrier_"  # prefix of the carrier's parameters
LEAST_TRAVEL, MOST_TRAVEL = 50.0, 1e6  # travel of a rail, mm: what is shorter was meant in metres
SCALE = 0.1  # millimetres by which a metre of a rack or a spindle may well be long or short


def carried(arm: Robot, *, by: Robot, name: str | None = None) -> Robot:
    """An arm whose base stands on what another robot carries: a `rail`, a `turntable`, a gantry, a second arm.

    Args:
        arm: whose parameters keep their names.
        by: the carrier, whose flange is the base of the arm; its parameters are called "carrier_direction" and so on.
        name: of both; by default both names.

    Joint values are those of the carrier, then those of the arm. Work on a positioner is the other way round: `facing(
    arm, turntable(...))` is the arm as the table sees it. Raises ProblemError for what are no robots.

    """
    _check_robots("an arm or what carries it", arm, by)
    before = CARRIER
    while any(before + key in arm.parameters for key in by.parameters):  # a carrier of a carrier
        before += CARRIER
    parameters = {before + key: unknown for key, unknown in by.parameters.items()} | dict(arm.parameters)
    pose = Carried(arm.pose, by.pose, tuple(by.parameters), len(by.axes), before)
    return Robot(name or f"{arm.name} on {by.name}", (*by.axes, *arm.axes), pose, parameters)


def rail(
    lower: float,
    upper: float,
    *,
    direction: Sequence[float] = (1.0, 0.0, 0.0),
    angle_std: float | None = None,
    scale_std: float = SCALE,
    name: str = "rail",
) -> Robot:
    """A straight rail as a robot of one joint, to carry an arm.

    Args:
        lower, upper: its travel, mm.
        direction: of growing joint values in the base frame, which is that of the carriage at zero.
        angle_std: prior standard deviation of its two tilts, rad; default 1e-3.
        scale_std: of its scale: by how much a metre of the controller is longer or shorter, mm/m.
        name: what the report calls it.

    Raises ProblemError as `Robot` does.

    """
    if not (is_real(lower) and is_real(upper) and LEAST_TRAVEL <= upper - lower <= MOST_TRAVEL):
        fix = f"Give its travel in mm, {LEAST_TRAVEL:g} to {MOST_TRAVEL:g} of them"
        raise ProblemError(f"A rail goes from {lower!r} to {upper!r}", fix)
    parameters = {
        "direction": Direction(direction, prior_std=PRIOR_STD["rad"] if angle_std is None else angle_std),
        "scale": Parameter(0.0, unit="mm/m", prior_std=scale_std),
    }
    return Robot(name, (Joint("prismatic", lower, upper),), _along, parameters)


def turntable(
    lower: float,
    upper: float,
    *,
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    point: Sequence[float] = (0.0, 0.0, 0.0),
    length_std: float | None = None,
    angle_std: float | None = None,
    name: str = "turntable",
) -> Robot:
    """A table that turns, as a robot of one joint, to carry an arm or its work.

    Args:
        lower, upper: its travel, rad.
        axis: direction of the axis in the base frame; the table's own frame is the base frame at zero.
        point: a point on the axis, mm.
        length_std, angle_std: prior standard deviations of the point, mm (default 0.7), and of the axis' two tilts, rad
            (default 1e-3).
        name: what the report calls it.

    Raises ProblemError as `Robot` does.

    """
    if not (is_real(lower) and is_real(upper) and lower < upper and max(-lower, upper) <= MOST_TURNED):
        fix = f"Give its limits in rad, such as *deg(-180, 180), within {MOST_TURNED / (2 * math.pi):g} turns of zero"
        raise ProblemError(f"A turntable goes from {lower!r} to {upper!r}", fix)
    parameters = {
        "axis": Direction(axis, prior_std=PRIOR_STD["rad"] if angle_std is None else angle_std),
        "point": Parameter(tuple(point), unit="mm", prior_std=length_std, labels=("_x", "_y", "_z")),
    }
    return Robot(name, (Joint("revolute", lower, upper),), _about, parameters)


def _check_robots(what: str, *robots: Any) -> None:
    for robot in robots:
        if not isinstance(robot, Robot):
            raise ProblemError(f"Got {came(robot)} as {what}", "Give two Robots")


def _along(p: Any, q: Expression) -> Expression:
    return slide(p.direction, q[0] * (1 + p.scale / 1000))


def _about(p: Any, q: Expression) -> Expression:
    return screw(p.axis, p.point, q[0])


@dataclass(frozen=True)
class Carried:
    """`pose(p, q)` of an arm on its carrier."""

    arm: PoseFunction
    by: PoseFunction
    keys: tuple[str, ...]
    count: int
    before: str

    def __call__(self, p: Any, q: Expression) -> Expression:
        """The arm's flange (4x4, mm) in the base frame of the carrier."""
        theirs = Names(**{key: getattr(p, self.before + key) for key in self.keys})
        return chain(self.by(theirs, q[: self.count]), self.arm(p, q[self.count :]))


OTHER = "other_"  # prefix of the other arm's parameters


def facing(one: Robot, other: Robot, *, shared: int = 0, name: str | None = None) -> Robot:
    """The chain whose base is the flange of the other arm and whose flange is that of the first.

    What one arm touches on the other, or sees of it, is then measured like anything else: with `SelfContact`, or with
    any instrument of one's own. Gravity and the places of faces mean nothing there.

    Args:
        one: whose parameters keep their names.
        other: whose parameters are called "other_alpha" and so on.
        shared: how many first joints both have in common, such as a turntable under both; they come once.
        name: of the two; by default both names.

    Joint values are those of the first arm, then those of the other without the shared ones. Raises ProblemError for
    what are no robots, or share what they do not have.

    """
    _check_robots("an arm", one, other)
    if not isinstance(shared, int) or not 0 <= shared <= min(len(one.axes), len(other.axes)):
        raise ProblemError(f"Two arms share {shared!r} joints", "Give how many of the first joints they have in common")
    pose = Facing(one.pose, other.pose, tuple(other.parameters), len(one.axes), shared)
    parameters = {**one.parameters, **{OTHER + key: unknown for key, unknown in other.parameters.items()}}
    if len(parameters) < len(one.parameters) + len(other.parameters):
        raise ProblemError(f"Parameters of '{one.name}' begin with '{OTHER}'", "Rename them")
    return Robot(name or f"{one.name} facing {other.name}", (*one.axes, *other.axes[shared:]), pose, parameters)


@dataclass(frozen=True)
class Facing:
    """`pose(p, q)` of two arms that face each other."""

    one: PoseFunction
    other: PoseFunction
    keys: tuple[str, ...]
    count: int
    shared: int

    def __call__(self, p: Any, q: Expression) -> Expression:
        """The first arm's flange (4x4, mm) as the other's flange sees it."""
        theirs = Names(**{key: getattr(p, OTHER + key) for key in self.keys})
        there = self.other(theirs, ca.vertcat(q[: self.shared], q[self.count :]))
        turn = rotation(there).T
        return chain(rigid(turn, -ca.mtimes(turn, position(there))), self.one(p, q[: self.count]))

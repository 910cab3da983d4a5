"""Two arms that face each other as one chain: from the flange of one to the flange of the other."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import casadi as ca

from casacal.errors import ProblemError, came
from casacal.kinematics import Expression, chain, position, rotation
from casacal.robots.robot import PoseFunction, Robot

OTHER = "other_"
"""What the names of the other arm's parameters begin with."""


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
    for robot in (one, other):
        if not isinstance(robot, Robot):
            raise ProblemError(f"{came(robot)} came as an arm", "Give two Robots")
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
        theirs = SimpleNamespace(**{key: getattr(p, OTHER + key) for key in self.keys})
        there = self.other(theirs, ca.vertcat(q[: self.shared], q[self.count :]))
        return chain(_inverse(there), self.one(p, q[: self.count]))


def _inverse(pose: Expression) -> Expression:
    """The transform back."""
    turn = rotation(pose).T
    return ca.vertcat(ca.horzcat(turn, -ca.mtimes(turn, position(pose))), ca.DM([[0, 0, 0, 1]]))

"""Whether what a problem is put together from fits together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from casacal.discrepancy import Effect
from casacal.errors import ProblemError, came
from casacal.instruments import Instrument
from casacal.instruments.declaration import check_declaration
from casacal.robots.robot import Robot


def check_parts(robot: Any, instruments: Sequence[Any], effects: Sequence[Any]) -> None:
    """Raise ProblemError for what is no robot, instrument or effect, for names that collide, and without any noise."""
    if not isinstance(robot, Robot):
        raise ProblemError(f"{came(robot)} came as the robot", "Give a Robot, such as Robot.from_dh(...) makes")
    if not instruments:
        raise ProblemError(f"Problem '{robot.name}' has no instrument", "Give at least one, such as DialOnPlane")
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ProblemError(f"{came(effect)} came as an effect", "Give what casacal.discrepancy has, or one's own")
    for instrument in instruments:
        check_declaration(instrument)
        _check_with(robot, instrument)


def _check_with(robot: Robot, instrument: Instrument) -> None:
    name = type(instrument).__name__
    twice = set(robot.parameters) & set(instrument.unknowns)
    if twice:
        raise ProblemError(f"Robot and {name} both name '{sorted(twice)[0]}'", "Rename one of them")
    noisy_joints = any(joint.repeatability_std > 0 for joint in robot.axes)
    noisy_columns = any(std > 0 for std in instrument.column_stds.values())
    if instrument.residual_std <= 0 and not noisy_columns and not noisy_joints:
        raise ProblemError(f"{name} declares no noise", "Give the standard deviation of its measurements")

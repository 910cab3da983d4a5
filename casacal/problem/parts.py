"""Whether what a problem is put together from fits together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from casacal.discrepancy import Effect
from casacal.errors import ProblemError, came
from casacal.instruments import Instrument
from casacal.instruments.declaration import check_declaration
from casacal.robots.robot import Robot
from casacal.values import is_real


def check_parts(robot: Any, instruments: Sequence[Any], effects: Sequence[Any]) -> None:
    """Raise ProblemError for what is no robot, instrument or effect, for names that collide, and without any noise."""
    if not isinstance(robot, Robot):
        raise ProblemError(f"{came(robot)} came as the robot", "Give a Robot, such as Robot.from_dh(...) makes")
    if not instruments:
        raise ProblemError(f"Problem '{robot.name}' has no instrument", "Give at least one, such as DialOnPlane")
    if not isinstance(effects, (tuple, list)):
        raise ProblemError(f"{came(effects)} came as the effects", "Give them in a tuple, such as kit() makes")
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ProblemError(f"{came(effect)} came as an effect", "Give what casacal.discrepancy has, or one's own")
        _check_size(effect)
    keys = [effect.key for effect in effects]
    if twice := next((key for key in keys if keys.count(key) > 1), ""):
        raise ProblemError(f"The effect '{twice}' came twice", "Give each once")
    for instrument in instruments:
        check_declaration(instrument)
        _check_with(robot, instrument)


def _check_size(effect: Effect) -> None:
    name = type(effect).__name__
    for what, value, least in (("size", effect.size, 0.0), ("doubt", effect.doubt, 1.0), ("most", effect.most, 1.0)):
        if not is_real(value) or not least <= value < math.inf or value == 0:
            fix = f"Give a positive number, {least:g} or more" if least else "Give a positive number"
            raise ProblemError(f"The {what} of {name} is {value!r}", fix)


def _check_with(robot: Robot, instrument: Instrument) -> None:
    name = type(instrument).__name__
    twice = set(robot.parameters) & set(instrument.unknowns)
    if twice:
        raise ProblemError(f"Robot and {name} both name '{sorted(twice)[0]}'", "Rename one of them")
    noisy_joints = any(joint.repeatability_std > 0 for joint in robot.axes)
    noisy_columns = any(std > 0 for std in instrument.column_stds.values())
    if instrument.residual_std <= 0 and not instrument.blocks and not noisy_columns and not noisy_joints:
        raise ProblemError(f"{name} declares no noise", "Give the standard deviation of its measurements")

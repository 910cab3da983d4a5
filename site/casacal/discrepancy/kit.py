"""The effects to expect of any arm, whatever measures it."""

from __future__ import annotations

from casacal.discrepancy.arm import GravitySag, ThermalGrowth
from casacal.discrepancy.effect import Effect
from casacal.discrepancy.gears import Backlash, GearRipple, TransmissionError
from casacal.discrepancy.smooth import Drift, FaceForm, JointField

DOWN = (0.0, 0.0, -1.0)  # gravity in the base frame of an arm that stands


def kit(*, down: tuple[float, float, float] = DOWN) -> tuple[Effect, ...]:
    """The standard effects; those that mean nothing to a robot or an instrument have no unknowns there.

    down: direction of gravity in the base frame; of an arm that hangs or stands at a wall it is another.
    """
    return _with(JointField(), down)


def rich_kit(*, down: tuple[float, float, float] = DOWN) -> tuple[Effect, ...]:
    """The same for rows that err together by more than each of them does alone: much more of what has no name."""
    return _with(JointField(reach=0.7, rank=120), down)


def _with(field: JointField, down: tuple[float, float, float]) -> tuple[Effect, ...]:
    return (
        TransmissionError(order=1),
        TransmissionError(order=2),
        GearRipple(),
        GravitySag(down=down),
        Backlash(),
        FaceForm(),
        field,
        Drift(),
        ThermalGrowth(),
    )

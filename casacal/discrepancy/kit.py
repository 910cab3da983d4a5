"""The effects to expect of any arm, whatever measures it."""

from __future__ import annotations

from casacal.discrepancy.arm import GravitySag, ThermalGrowth
from casacal.discrepancy.effect import Effect
from casacal.discrepancy.further import DOWN
from casacal.discrepancy.gears import Backlash, GearRipple, TransmissionError
from casacal.discrepancy.smooth import Drift, FaceForm, JointField


def kit(*, down: tuple[float, float, float] = DOWN) -> tuple[Effect, ...]:
    """The standard effects; those that mean nothing to a robot or an instrument have no unknowns there.

    down: direction of gravity in the base frame; of an arm that hangs or stands at a wall it is another.
    """
    return (
        TransmissionError(order=1),
        TransmissionError(order=2),
        GearRipple(),
        GravitySag(down=down),
        Backlash(),
        FaceForm(),
        JointField(),
        Drift(),
        ThermalGrowth(),
    )


def rich_kit(*, down: tuple[float, float, float] = DOWN) -> tuple[Effect, ...]:
    """The same for rows that err together by more than each of them does alone: much more of what has no name."""
    return tuple(JointField(reach=0.7, rank=120) if isinstance(each, JointField) else each for each in kit(down=down))

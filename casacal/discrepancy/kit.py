"""The effects to expect of any arm, whatever measures it."""

from __future__ import annotations

from casacal.discrepancy.arm import GravitySag, ThermalGrowth
from casacal.discrepancy.compliance import LinkSag
from casacal.discrepancy.effect import Effect
from casacal.discrepancy.further import DOWN
from casacal.discrepancy.gears import Backlash, GearRipple, TransmissionError
from casacal.discrepancy.smooth import Drift, FaceForm, JointField


def kit(*, down: tuple[float, float, float] = DOWN, links: bool = False) -> tuple[Effect, ...]:
    """The standard effects; those that mean nothing to a robot or an instrument have no unknowns there.

    down: direction of gravity in the base frame; of an arm that hangs or stands at a wall it is another. links: sag by
    the weights of all links, of which nothing is known, in place of that by one weight at the flange.
    """
    return (
        TransmissionError(order=1),
        TransmissionError(order=2),
        GearRipple(),
        LinkSag(down=down) if links else GravitySag(down=down),
        Backlash(),
        FaceForm(),
        JointField(),
        Drift(),
        ThermalGrowth(),
    )


def rich_kit(*, down: tuple[float, float, float] = DOWN) -> tuple[Effect, ...]:
    """The same for rows that err together by more than each of them does alone: much more of what has no name."""
    return tuple(JointField(reach=0.7, rank=120) if isinstance(each, JointField) else each for each in kit(down=down))

"""The effects to expect of any arm, whatever measures it."""

from __future__ import annotations

from casacal.discrepancy.arm import Backlash, GearWaves, GravityGive, ThermalGrowth
from casacal.discrepancy.effect import Effect
from casacal.discrepancy.joint_field import JointField
from casacal.discrepancy.smooth import Drift, FaceForm


def kit() -> tuple[Effect, ...]:
    """The standard effects; those that mean nothing to a robot or an instrument have no unknowns there."""
    return _with(JointField())


def rich_kit() -> tuple[Effect, ...]:
    """The same for rows that err together by more than each of them does alone: much more of what has no name."""
    return _with(JointField(reach=0.7, rank=120))


def _with(field: JointField) -> tuple[Effect, ...]:
    return (
        GearWaves(order=1),
        GearWaves(order=2),
        GravityGive(),
        Backlash(),
        FaceForm(),
        field,
        Drift(),
        ThermalGrowth(),
    )

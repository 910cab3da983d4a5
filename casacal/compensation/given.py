"""What people hand over where a calibrated arm is asked for."""

from __future__ import annotations

from typing import Any

from casacal.compensation.arm import CalibratedArm
from casacal.compensation.seen_by import seen_by
from casacal.errors import CasacalError, came


def arm_from(given: Any) -> CalibratedArm:
    """The arm that was given, or that of a calibration, as its first instrument sees it; raises CasacalError."""
    arm = given if isinstance(given, CalibratedArm) else getattr(given, "arm", None)
    if not isinstance(arm, CalibratedArm):
        raise CasacalError(
            f"{came(given)} came as the calibrated arm",
            "Give a calibration, or what casacal.load or casacal.read_result returns",
        )
    return seen_by(arm)

"""What disturbs a simulated arm, whatever measures it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.errors import SimulationError, came

AMOUNTS = {
    "repeatability": math.inf,
    "resolution": math.inf,
    "joint_std": math.inf,
    "backlash": math.inf,
    "encoder_step": 0.1,
    "flatness": math.inf,
    "flatness_reach": 10.0,
    "compliance": math.inf,
    "thermal": 0.01,
    "dial_gain": 0.1,
    "dial_cycle": 0.1,
    "hysteresis": math.inf,
    "drift": math.inf,
    "error_scale": math.inf,
}
"""Numbers of a cell that are zero or positive, and the most that they mean something for."""

STEEPEST = 0.5
"""Slope (order times amplitude) from which a gear wave is none: the joint would hardly follow its motor."""


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """What disturbs a simulated arm and its measurements, whatever measures it; lengths mm, angles rad.

    Args:
        repeatability: standard deviation of the reading (or of the touch, without a dial); None takes the instrument's.
        resolution: step in which readings are shown; 0 for none.
        joint_std: standard deviation of joint repeatability, rad (mm for a prismatic joint).
        backlash: play of each joint, rad (mm for a prismatic joint); a joint lags half of it behind its last move.
        gear_waves: (order, amplitude) pairs, or a mapping: every turning joint stands off by amplitude *
            sin(order q + phase), rad, its phase drawn, its amplitude the same for all. 1 and 2 are eccentric encoders
            and wheels, 100 is the wave of a harmonic drive of that ratio.
        encoder_step: step in which the controller says joint values, rad (mm for a prismatic joint).
        outliers: fraction of rows that are gross.
        outlier_size: their size.
        error_scale: true parameters lie this many prior standard deviations (RMS) from nominal.

    """

    repeatability: float | None = None
    resolution: float = 0.001
    joint_std: float = 0.0
    backlash: float = 0.0
    gear_waves: Mapping[int, float] | Sequence[tuple[int, float]] = ()
    encoder_step: float = 0.0
    outliers: float = 0.0
    outlier_size: float = 1.0
    error_scale: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "gear_waves", _waves(self.gear_waves))
        if not 0 <= self.outliers < 1:
            raise SimulationError(f"The fraction of outliers is {self.outliers:g}", "Give 0 to less than 1")
        for name, most in AMOUNTS.items():
            value = getattr(self, name, None)
            if value is not None and not 0 <= value < math.inf:
                raise SimulationError(f"{name} of the cell is {value!r}", "Give zero or a positive number")
            if value is not None and value > most:
                raise SimulationError(f"{name} of the cell is {value:g}", f"Give at most {most:g}")

    @property
    def waves(self) -> tuple[tuple[int, float], ...]:
        """Order and amplitude (rad) of each gear wave."""
        return tuple(self.gear_waves)  # type: ignore[arg-type]  # pairs, once made


def _waves(given: Mapping[int, float] | Sequence[tuple[int, float]]) -> tuple[tuple[int, float], ...]:
    """Pairs of order and amplitude; raises SimulationError for what is none."""
    pairs = given.items() if isinstance(given, Mapping) else given
    try:
        waves = [(order, float(amplitude)) for order, amplitude in pairs]
    except (TypeError, ValueError):
        raise SimulationError(
            f"Got {came(given)} as gear_waves", "Give {order: amplitude in rad}, such as {1: 1e-4}"
        ) from None
    for order, amplitude in waves:
        if isinstance(order, bool) or not isinstance(order, (int, np.integer)) or order < 1:
            raise SimulationError(f"A gear wave has the order {order!r}", "Give a whole number from one on")
        if not 0 <= amplitude * order < STEEPEST:
            raise SimulationError(
                f"The gear wave of order {order} has the amplitude {amplitude:g}",
                f"Give zero or a positive number of rad below {STEEPEST / order:g}",
            )
    return tuple((int(order), amplitude) for order, amplitude in waves)

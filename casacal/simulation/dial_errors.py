"""What a simulated dial shows of the way that its plunger truly stands at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.problem.cell import Cell

TURN = 1.0
"""What one turn of the pointer shows, mm."""

ROUNDS = 60
"""Fixed-point steps; the largest wave that a cell takes leaves less than 1e-11 mm."""


@dataclass(frozen=True)
class DialErrors:
    """Errors of one dial; lengths mm.

    A true way is (1 + gain) * shown + cycle * sin(2 pi shown / TURN + phase). What is shown lags by half the
    hysteresis, and grows by `drift` over a session.
    """

    gain: float = 0.0
    cycle: float = 0.0
    phase: float = 0.0
    hysteresis: float = 0.0
    drift: float = 0.0

    @staticmethod
    def drawn(cell: Cell, rng: np.random.Generator) -> DialErrors:
        """Those of one dial."""
        gain, phase = cell.dial_gain * float(rng.normal()), float(rng.uniform(0, 2 * math.pi))
        return DialErrors(gain, cell.dial_cycle, phase, cell.hysteresis, cell.drift)

    def shown(self, ways: Array, came: Array, when: Array) -> Array:
        """Readings (N,) at true ways (N,), to which they grew (1) or fell (-1), at places 0 ... 1 of a session."""
        shown = ways
        for _ in range(ROUNDS if self.gain or self.cycle else 0):
            wave = self.cycle * np.sin(2 * math.pi * shown / TURN + self.phase)
            shown = (ways - wave) / (1 + self.gain)
        return np.asarray(shown - came * self.hysteresis / 2 + self.drift * when)

"""What a dial is declared with: where its tip stands, what it gets wrong itself, and steps of known height."""

from __future__ import annotations

import math
from dataclasses import dataclass

from casacal.unknowns import Parameter


def tool_point(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, *, prior_std: float = math.inf, free: bool = True
) -> Parameter:
    """Tool point (3, mm) in the flange frame, with components tool_x, tool_y, tool_z; its prior is flat by default."""
    return Parameter((x, y, z), unit="mm", prior_std=prior_std, free=free, labels=("_x", "_y", "_z"))


def dial_gain(percent: float = 0.15) -> Parameter:
    """How much too much or too little a dial may show of every way: a prior, from its certificate, else 0.15 %.

    What touches of planes leave of a wrong gain is too small to be seen: geometry absorbs nearly all of it, as an arm
    that is too large or too small. So this has to be said.
    """
    return Parameter(0.0, unit="%", prior_std=percent)


def dial_cycle(micrometres: float = 3.0) -> Parameter:
    """An error that comes back with every turn of the pointer: priors of its cosine and sine, in micrometres."""
    return Parameter((0.0, 0.0), unit="um", prior_std=micrometres, labels=("_cos", "_sin"))


@dataclass(frozen=True)
class Step:
    """A face parallel to another one at a known distance, as on a gauge block.

    on: label of the other face. height: distance along its normal, towards the tool, mm. std: of the certificate, mm.
    """

    on: str
    height: float
    std: float = 0.0003

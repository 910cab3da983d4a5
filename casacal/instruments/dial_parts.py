"""What a dial is declared with: what it gets wrong itself, zeros that were set anew, and steps of known height."""

from __future__ import annotations

from dataclasses import dataclass

from casacal.unknowns import Parameter

APPROACH = (
    "if the dial is at the end of its travel, move along the plunger until it reads about what is expected: readings "
    "that differ determine the size of the arm"
)
"""What whoever touches with a dial should see to."""


def dial_gain(percent: float = 0.15) -> Parameter:
    """How much too much or too little a dial may show of every way: a prior, from its certificate, else 0.15 %.

    What touches of planes leave of a wrong gain is too small to be seen: geometry absorbs nearly all of it, as an arm
    that is too large or too small. So this has to be said.
    """
    return Parameter(0.0, unit="%", prior_std=percent)


def dial_cycle(micrometres: float = 3.0) -> Parameter:
    """An error that comes back with every turn of the pointer: priors of its cosine and sine, in micrometres."""
    return Parameter((0.0, 0.0), unit="um", prior_std=micrometres, labels=("_cos", "_sin"))


def dial_zero(std: float = 10.0, *, per: str = "session") -> Parameter:
    """Where a dial was set to zero anew: an unknown for each value of a column, with a prior of so many mm."""
    return Parameter(0.0, unit="mm", prior_std=std, per=per)


@dataclass(frozen=True)
class Step:
    """A face parallel to another one at a known distance, as on a gauge block.

    on: label of the other face. height: distance along its normal, towards the tool, mm. std: of the certificate, mm.
    """

    on: str
    height: float
    std: float = 0.0003

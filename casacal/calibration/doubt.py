"""A doubt about a result, and the steps that settle one."""

from __future__ import annotations

from dataclasses import dataclass

DECLARE = "have the dial calibrated, or declare the error as unknown (gain=dial_gain(0.15) or cycle= of the instrument)"

VERIFY = "touch in other postures, and check with casacal verify whether the result holds there"
WIDEN = f"state wider priors (--accuracy, --prior) if the arm may be so far from its drawing; otherwise {VERIFY}"
REPEAT = (
    "touch some places three times each, which separates the scatter of touches from errors of the model; or state "
    "the noise, if it is known to be larger (--set noise_std=MM)"
)
"""What settles a doubt whose cause nobody knows."""


@dataclass(frozen=True)
class Doubt:
    """A clause to put after "but", and a sentence.

    step: what settles it; empty where the data check, which was not run, may find the cause.
    """

    clause: str
    sentence: str
    step: str = ""

"""Something that a figure of accuracy must not be without."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Doubt:
    """A clause to put after "but", and a sentence.

    step: what settles it; empty where the data check, which has not been asked, may tell the cause.
    """

    clause: str
    sentence: str
    step: str = ""

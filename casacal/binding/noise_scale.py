"""Noise as it was found: what was stated, times a factor for each face, and what the joints do not repeat."""

from __future__ import annotations

from collections.abc import Mapping

OTHERS = ""  # stands for every face that is not named

SHARED = "\0shared"
"""Stands for the part of the noise's variance that repeated touches share; no label holds a zero byte."""

REPEATABILITY = "\0joints"
"""Stands for what joints do not repeat, rad (`PER_RAD` mm of a sliding one are one), on top of the rest."""


def by_face(scale: Mapping[str, float]) -> dict[str, float]:
    """The factors of faces alone."""
    return {name: value for name, value in scale.items() if name not in (SHARED, REPEATABILITY)}


def of_repeats(scale: Mapping[str, float]) -> dict[str, float]:
    """What repeats share alone: the noise as it was stated, but for that."""
    return {name: value for name, value in scale.items() if name == SHARED}


def without_joints(scale: Mapping[str, float]) -> dict[str, float]:
    """The same without what joints do not repeat."""
    return {name: value for name, value in scale.items() if name != REPEATABILITY}


def times(scale: Mapping[str, float], factor: float) -> dict[str, float]:
    """All noise times another factor; what repeats share is a part of the noise and stays."""
    found = {name: value if name == SHARED else value * factor for name, value in scale.items()}
    return found if by_face(found) else {**found, OTHERS: factor}

"""What may have drifted since a calibration: more doubt about single unknowns of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casacal.errors import CasacalError, UnknownNameError, came
from casacal.values import is_real
from casacal.verification.fresh import Fresh


def with_drift(fresh: Fresh, drift: Mapping[str, float]) -> Fresh:
    """The same rows with more doubt about what they are judged by.

    drift: standard deviations (mm, rad) by the name of an unknown ("theta4"), or the key of several ("theta").
    Raises UnknownNameError for what these rows take from no calibration, CasacalError for what is no size.
    """
    if not drift:
        return fresh
    bound, places = fresh.bound, dict[str, list[int]]()
    position = np.cumsum(fresh.known) - 1
    for slot in bound.slots:
        for j, name in zip(slot.columns, slot.unknown.names(slot.name), strict=True):
            if fresh.known[j] and not slot.beside:
                for word in dict.fromkeys((name, slot.name, slot.key)):
                    places.setdefault(word, []).append(int(position[j]))
    covariance = fresh.covariance.copy()
    for name, std in drift.items():
        if name not in places:
            raise UnknownNameError("unknown of the calibration", name, places)
        if not (is_real(std) and 0 <= std < math.inf):
            raise CasacalError(f"{came(std)} came as the drift of '{name}'", "Give zero or more, mm or rad")
        covariance[places[name], places[name]] += float(std) ** 2
    return replace(fresh, covariance=covariance)

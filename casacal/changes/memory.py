"""What an update takes from the calibration: effects beside the geometry, and doubt about what may have drifted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casacal.compensation.arm import CalibratedArm
from casacal.errors import CasacalError, UnknownNameError, came
from casacal.values import is_real
from casacal.verification.fresh import Fresh

ANEW = ("growth",)
"""Keys of effects that move the tip and differ from session to session."""


def with_memory(fresh: Fresh, arm: CalibratedArm) -> Fresh:
    """The same rows with the geometry and the effects that go with the arm as they were estimated, and how well.

    Itself where a result says nothing of effects.
    """
    said = arm.document.get("discrepancy") or {}
    if "covariance" not in said or "covariance_of" not in said:
        return fresh
    rows = [[np.inf if value is None else float(value) for value in row] for row in said["covariance"]]
    whole, places = np.array(rows), {name: i for i, name in enumerate(said["covariance_of"])}
    off = dict(zip(places, map(float, said["off"]), strict=True))
    bound, columns = fresh.bound, np.flatnonzero(fresh.known)
    stays = [k for k, j in enumerate(columns) if bound.names[j] in places and bound.beside[j] not in ANEW]
    index = [places[bound.names[columns[k]]] for k in stays]
    covariance, at = fresh.covariance.copy(), fresh.at.copy()
    covariance[np.ix_(stays, stays)] = whole[np.ix_(index, index)]
    for k in stays:
        at[columns[k]] += off[bound.names[columns[k]]]
    return replace(fresh, at=at, covariance=covariance)


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
            raise CasacalError(f"Got {came(std)} as the drift of '{name}'", "Give zero or more, mm or rad")
        covariance[places[name], places[name]] += float(std) ** 2
    return replace(fresh, covariance=covariance)

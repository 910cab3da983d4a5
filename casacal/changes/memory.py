"""What a calibration knows of effects beside the geometry goes with the arm: gears and give are what they were.

A verification takes them for errors of an expected size, each time anew. An arm that is asked whether it changed is the
same arm, so that its gears err as they did: geometry and effects are known together, and much better than each alone.
Warmth, drift, dials and faces begin anew.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casacal.compensation.arm import CalibratedArm
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

"""The arm's error before and after, of all rows, each face and each region, with intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.verification.arm_error import Seen
from casacal.verification.decision import Scatter
from casacal.verification.figures import INTERVAL, ErrorInterval, PartError
from casacal.verification.parts import FEWEST, blocks


def errors_by_part(seen: Seen, drawn: Array) -> tuple[PartError, ...]:
    """Errors of all rows, then of faces and of regions where there are several with rows enough.

    Args:
        seen: what the rows see.
        drawn: unknowns (n,) of the arm as drawn, those of the rows fitted.

    """
    bound, x = seen.fresh.bound, seen.fresh.x
    pair = seen.residual(drawn), seen.residual(x)
    faces = bound.block.samples.faces(bound.problem.instrument.groups)
    everything: NDArray[np.intp] = np.arange(len(faces))
    asked = [("all", "all rows", everything)]
    if len(faces.names) > 1:
        asked += [("face", label, rows) for label, rows in faces.rows().items() if len(rows) >= FEWEST]
    asked += [("region", label, rows) for label, rows in blocks(bound.tips(x, bound.block.samples.joints)).items()]
    found = []
    for kind, label, rows in asked:
        before, after = (seen.scatter(residual, rows) for residual in pair)
        if before is not None and after is not None:
            here = interval(before), interval(after)
            found.append(PartError(kind, label, len(rows), *here, seen.promised_mm(rows)))
    return tuple(found)


def interval(scatter: Scatter) -> ErrorInterval:
    """The error that rows show, and the interval that holds it with a chance of 95 %."""
    beyond = (1 - INTERVAL) / 2
    return ErrorInterval(scatter.measured_mm, scatter.lower_mm(beyond), scatter.upper_mm(beyond))

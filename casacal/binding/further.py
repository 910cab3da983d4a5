"""Rows of labels that a bound problem has not seen: faces held out of a fit have places of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.slots import make_slots
from casacal.estimators import lm
from casacal.least_squares.restricted import Restricted
from casacal.samples.samples import Samples


def bind_further(bound: BoundProblem, *samples: Samples) -> BoundProblem:
    """Bind the same unknowns to other rows, and after them those of labels that are new; one set per instrument.

    Raises ProblemError as `bind` does.
    """
    seen = {slot.name: slot.nominal for slot in bound.slots}
    slots = list(bound.slots)
    for slot in make_slots(bound.problem, samples, seen):
        if slot.name not in seen:
            slots.append(replace(slot, first=slots[-1].first + slots[-1].unknown.size))
    if len(slots) == len(seen):
        return bound.on(*samples)
    return BoundProblem(bound.problem, slots, samples, bound.backend, scale=bound.scale, surveys=bound.surveys)


def extended(further: BoundProblem, x: Array) -> Array:
    """All unknowns (n + k,) of such rows at x (n,): those of new labels are fitted to their rows, nothing else is."""
    new = np.arange(further.unknowns) >= x.size
    if not new.any():
        return x
    part = Restricted(further, new, np.concatenate([x, np.zeros(int(new.sum()))]))
    return np.asarray(part.expand(lm(part).x))

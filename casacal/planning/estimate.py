"""What the samples there are tell at the estimate, with extra rows on top of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import OTHERS, by_face, times
from casacal.binding.slots import Slot, make_slots
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.cell import Face


@dataclass(frozen=True)
class Estimate:
    """What the samples tell at the estimate x (n,): their information (n, n)."""

    bound: BoundProblem
    x: Array
    information: Array

    def with_rows(
        self, problem: Problem, faces: Sequence[Face], rows: Samples, noise: float
    ) -> tuple[BoundProblem, Array, Array]:
        """Extra rows (N), bound; where they stand, x (m,); information (m, m) that there is without them.

        Their noise is what was found, times a factor. What they alone see, such as a new face, comes last.
        """
        instrument, old = problem.instrument, dict[str, Slot]()
        for slot in self.bound.slots:  # as the instrument with a face for each label has them
            unknown = instrument.unknowns.get(slot.key)
            if slot.label is None and unknown is not None and unknown.per is not None:
                slot = replace(slot, unknown=unknown, label="plane")
            old[slot.name] = slot
        known, new = {slot.label for slot in old.values()}, list[Slot]()
        strange = {face.label: face for face in faces if face.label not in known}
        own = rows.faces(instrument.groups)
        there = np.flatnonzero(np.isin(own.codes, [k for k, label in enumerate(own.names) if label in strange]))
        for slot in make_slots(problem, [rows.take(there)]) if strange else ():
            if slot.label in strange and slot.unknown.nominal_plane(slot.nominal) is not None:
                face = strange[slot.label]
                slot = replace(slot, nominal=slot.unknown.placed(np.asarray(face.centre), face.axes[0]))
            new += [] if slot.name in old else [slot]
        slots, x = _in_row([*old.values(), *new], np.concatenate([self.x, np.zeros(sum(s.unknown.size for s in new))]))
        # the noise of a new face is the mean square of that of the others
        found = list(by_face(self.bound.scale).values())
        others = math.sqrt(float(np.mean(np.square(found)))) if found else 1.0
        scale = times({OTHERS: others, **self.bound.scale}, noise)
        information = np.zeros((x.size, x.size))
        information[: self.x.size, : self.x.size] = self.information
        return BoundProblem(problem, slots, (rows,), "blocks", scale=scale), x, information


def _in_row(slots: Sequence[Slot], x: Array) -> tuple[tuple[Slot, ...], Array]:
    """Slots one after the other, and their part of x (n,); new slots stand at the end of it."""
    placed, parts, first = [], [], 0
    for slot in slots:
        placed.append(replace(slot, first=first))
        parts.append(x[slot.columns])
        first += slot.unknown.size
    return tuple(placed), np.concatenate(parts)

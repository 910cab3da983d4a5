"""What the samples there are tell at the estimate, with extra rows on top of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import OTHERS, by_face, times
from casacal.binding.slots import Slot, make_slots
from casacal.instruments import Instrument
from casacal.least_squares.linalg import posterior_covariance
from casacal.problem.cell import Cell, Face
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples


@dataclass(frozen=True)
class Known:
    """What the samples tell at the estimate, in shared unknowns and those of the labels that extra touches see."""

    bound: BoundProblem
    slots: tuple[Slot, ...]
    x: Array
    information: Array

    @staticmethod
    def of(bound: BoundProblem, x: Array, told: Array, labels: Sequence[str]) -> Known:
        """At x (n,) of a bound problem, from the information (s, s) in what figures of its arm need."""
        if bound.groups is None:
            return Known(bound, bound.slots, x, told)
        shared = set(bound.groups.shared.tolist())
        first = [slot for slot in bound.slots if shared.issuperset(slot.columns)]
        own = [slot for slot in bound.slots if slot.label in labels and not shared.issuperset(slot.columns)]
        slots, x = _in_row([*first, *own], x)
        if not own:
            return Known(bound, slots, x, told)
        # their own unknowns were taken out: the rows that see them go out of the sum, and come back with them
        samples, instrument, key = bound.samples[0], bound.problem.instrument, own[0].key
        groups, named = samples.labels[own[0].unknown.per or ""], {slot.label for slot in own}
        codes = [k for k, name in enumerate(groups.names) if instrument.instance(key, name) in named]
        rows = samples.take(np.flatnonzero(np.isin(groups.codes, codes)))
        part = BoundProblem(bound.problem, slots, (rows,), "blocks", scale=bound.scale)
        information, few = part.information(x), len(told)
        information[:few, :few] += told - _left(information, part.prior_std, few)
        return Known(bound, slots, x, information)

    def with_rows(self, problem: Problem, cell: Cell, rows: Samples, noise: float) -> tuple[BoundProblem, Array, Array]:
        """Extra rows (N), bound; where they stand, x (m,); information (m, m) that there is without them.

        Their noise is what was found, times a factor. What they alone see, such as a new face, comes last.
        """
        instrument = problem.instrument
        old = {slot.name: slot for slot in (_by_label(each, instrument) for each in self.slots)}
        known = {slot.label for slot in old.values()}
        strange = {face.label: face for face in cell.faces if face.label not in known}
        faces = rows.faces(instrument.groups)
        there = np.flatnonzero(np.isin(faces.codes, [k for k, label in enumerate(faces.names) if label in strange]))
        new = [slot for slot in make_slots(problem, [rows.take(there)]) if slot.name not in old] if strange else []
        new = [_placed(slot, strange) for slot in new]
        slots, x = _in_row([*old.values(), *new], np.concatenate([self.x, np.zeros(sum(s.unknown.size for s in new))]))
        extra = BoundProblem(problem, slots, (rows,), "blocks", scale=_scale(self.bound.scale, noise))
        information = np.zeros((x.size, x.size))
        information[: self.x.size, : self.x.size] = self.information
        return extra, x, information


def _placed(slot: Slot, faces: Mapping[str, Face]) -> Slot:
    """A new plane where its face is; any other slot as it is."""
    if slot.label is None or slot.label not in faces or slot.unknown.nominal_plane(slot.nominal) is None:
        return slot
    face = faces[slot.label]
    return replace(slot, nominal=slot.unknown.placed(np.asarray(face.centre), face.axes[0]))


def _by_label(slot: Slot, instrument: Instrument) -> Slot:
    """A slot as the instrument with a face for each label has it."""
    unknown = instrument.unknowns.get(slot.key)
    if slot.label is None and unknown is not None and unknown.per is not None:
        return replace(slot, unknown=unknown, label="plane")
    return slot


def _in_row(slots: Sequence[Slot], x: Array) -> tuple[tuple[Slot, ...], Array]:
    """Slots one after the other, and their part of x (n,); new slots stand at the end of it."""
    placed, parts, first = [], [], 0
    for slot in slots:
        placed.append(replace(slot, first=first))
        parts.append(x[slot.columns])
        first += slot.unknown.size
    return tuple(placed), np.concatenate(parts)


def _left(information: Array, prior_std: Array, shared: int) -> Array:
    """Information (s, s) left of the first unknowns when the others, held by their priors, are taken out."""
    own = posterior_covariance(information[shared:, shared:], prior_std[shared:])
    across = information[:shared, shared:]
    return np.asarray(information[:shared, :shared] - across @ own @ across.T)


def _scale(found: Mapping[str, float], noise: float) -> dict[str, float]:
    """Factors of the noise as found, for a new face their mean square, all times one more."""
    faces = list(by_face(found).values())
    others = math.sqrt(float(np.mean(np.square(faces)))) if faces else 1.0
    return times({OTHERS: others, **found}, noise)

"""Extra touches: where an arm as calibrated would make them, and what they add to what the samples know."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.marginal import Seen
from casacal.binding.noise_scale import OTHERS
from casacal.binding.slots import ENOUGH, Slot, make_slots
from casacal.errors import CasacalError
from casacal.instruments import Instrument
from casacal.instruments.instrument import Probe
from casacal.least_squares.linalg import posterior_covariance
from casacal.problem.cell import Cell, Face
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.reach import Touch
from casacal.simulation.touches import find_touches, try_touches
from casacal.tables.labels import Labels

EXTRA_TOUCHES = 24
"""Touches that are added: a quarter of an hour of work."""
MOST_FACES = 8
"""Faces, those with most rows, on which extra touches are made."""
SMALLEST = 50.0
"""Least side of a face that is touched, mm."""
REACHED = 0.2
"""Share of touches of a face that must succeed at the first try: others take many."""


@dataclass(frozen=True)
class Touches:
    """An arm as calibrated before its faces as they were found."""

    problem: Problem
    """With a face for each label."""
    probe: Probe
    touch: Touch
    faces: tuple[Face, ...]
    """Rectangles around what was touched, their normals towards the tool; those with most rows first."""
    senses: tuple[int, ...]
    """Whether each face's plane has that normal, or its opposite: +1, -1."""
    tilt: float
    """Largest angle (rad) between plunger and normal in the samples there are."""

    @staticmethod
    def of(bound: BoundProblem, x: Array) -> Touches | None:
        """At x (n,); None for instruments that know no faces by label, such as a tracker."""
        if len(bound.problem.instruments) != 1:
            return None
        labelled = bound.problem.instrument.with_faces_by_label()
        if labelled is None or labelled.probe is None:
            return None
        problem = bound.problem if labelled is bound.problem.instrument else Problem(bound.problem.robot, labelled)
        local = {slot.key: x[slot.columns] for slot in bound.slots if slot.label is None}
        touch = Touch.of(problem.robot, labelled, labelled.probe, local)
        found = _faces(bound, x, touch, labelled.probe)
        if not found:
            return None
        faces, senses, tilts = zip(*found, strict=True)
        return Touches(problem, labelled.probe, touch, faces, senses, max(tilts))

    def on(self, cell: Cell) -> Samples | None:
        """Rows of touches shared between the faces of a cell; None where they are out of reach."""
        which = np.arange(EXTRA_TOUCHES) % len(cell.faces)
        level, seeds = np.zeros(EXTRA_TOUCHES), [None] * len(cell.faces)
        *_, good = try_touches(self.touch, self.probe, cell, which, level, [*seeds], np.random.default_rng(0))
        if min(good[which == k].mean() for k in range(len(cell.faces))) < REACHED:
            return None
        rng, form = np.random.default_rng(0), np.random.default_rng(0)
        try:
            joints, readings = find_touches(self.touch, self.probe, cell, which, level, rng, form)
        except CasacalError:
            return None
        columns = {} if self.probe.column is None else {self.probe.column: readings}
        assert self.probe.label is not None
        labels = {self.probe.label: Labels([face.label for face in cell.faces], which)}
        return Samples(joints, columns, labels, tuple(range(1, EXTRA_TOUCHES + 1)), {}, "extra touches", "")


@dataclass(frozen=True)
class Known:
    """What the samples tell at the estimate, in their shared unknowns and those of the faces that extra touches see."""

    bound: BoundProblem
    slots: tuple[Slot, ...]
    x: Array
    information: Array

    @staticmethod
    def of(bound: BoundProblem, arm: Seen, x: Array, at: Array, labels: Sequence[str]) -> Known:
        """At x (n,) of a bound problem and `at` (s,) of what figures of its arm need."""
        if bound.groups is None:
            return Known(bound, bound.slots, x, bound.information(x))
        shared = set(bound.groups.shared.tolist())
        first = [slot for slot in bound.slots if all(j in shared for j in slot.columns)]
        own = [slot for slot in bound.slots if slot.label in labels and slot not in first]
        slots, x = _in_row([*first, *own], x)
        # these faces' own unknowns were taken out: their rows go out of the sum, and come back with them
        samples = bound.samples[0]
        faces = samples.faces(bound.problem.instrument.groups)
        named = {slot.label for slot in own}
        instrument, key = bound.problem.instrument, own[0].key
        codes = [k for k, name in enumerate(faces.names) if instrument.instance(key, name) in named]
        rows = samples.take(np.flatnonzero(np.isin(faces.codes, codes)))
        part = BoundProblem(bound.problem, slots, (rows,), "blocks", noise_scale=bound.noise_scale)
        information = part.information(x)
        information[: at.size, : at.size] += arm.information(at) - _left(information, part.prior_std, at.size)
        return Known(bound, slots, x, information)

    def plus(self, problem: Problem, rows: Samples, noise: float) -> tuple[Array, Array]:
        """Information (m, m) and prior (m,) with extra rows, their noise times a factor; new unknowns come last."""
        instrument = problem.instrument
        old = {slot.name: slot for slot in (_by_label(each, instrument) for each in self.slots)}
        new = [slot for slot in make_slots(problem, [rows]) if slot.name not in old]
        slots, x = _in_row([*old.values(), *new], np.concatenate([self.x, np.zeros(sum(s.unknown.size for s in new))]))
        scale = _scale(self.bound.noise_scale[0] if self.bound.noise_scale else {}, noise)
        extra = BoundProblem(problem, slots, (rows,), "blocks", noise_scale=(scale,))
        information = extra.information(x)
        information[: self.x.size, : self.x.size] += self.information
        return information, extra.prior_std


def _faces(bound: BoundProblem, x: Array, touch: Touch, probe: Probe) -> list[tuple[Face, int, float]]:
    """Rectangles around the tips of each face, most touched first, its plane's sense, and the largest tilt there."""
    samples, instrument = bound.samples[0], bound.problem.instrument
    some = samples.take(np.arange(0, len(samples), -(-len(samples) // ENOUGH)))
    readings = np.zeros((len(some), 1)) if probe.column is None else some.columns[probe.column][:, None]
    tips, plungers = touch.place(touch.local, some.joints, readings)
    labels = some.faces(instrument.groups)
    rows, found = labels.rows(), []
    for slot in bound.slots:
        if slot.unknown.nominal_plane(slot.nominal) is None:
            continue
        _, plane = slot.unknown.shown(slot.nominal, x[slot.columns])
        own = [rows[name] for name in labels.names if slot.label in (None, instrument.instance(slot.key, name))]
        if own:
            here = np.concatenate(own)
            found.append((here.size, _face(slot.label or "plane", plane, tips[here], plungers[here])))
    return [each for _, each in sorted(found, key=lambda entry: -entry[0])[:MOST_FACES]]


def _face(label: str, plane: Mapping[str, Array], tips: Array, plungers: Array) -> tuple[Face, int, float]:
    """A rectangle around tips (N, 3), its plane's sense, and the largest tilt of plungers (N, 3) against it."""
    normal, point = plane["normal"], plane["point_mm"]
    against = -(plungers @ normal)
    sense = 1 if against.mean() > 0 else -1
    face = Face(label, _triple(point), _triple(sense * normal))
    along = (tips - point) @ face.axes[1:].T
    low, high = along.min(axis=0), along.max(axis=0)
    width, depth = (max(float(side), SMALLEST) for side in high - low)
    centre = _triple(point + (low + high) / 2 @ face.axes[1:])
    tilt = math.acos(min(float((sense * against).min()), 1.0))
    return replace(face, centre=centre, size=(width, depth)), sense, tilt


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
    others = math.sqrt(float(np.mean(np.square(list(found.values()))))) if found else 1.0
    return {name: noise * factor for name, factor in {OTHERS: others, **found}.items()}


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z

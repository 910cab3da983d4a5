"""Extra touches: where an arm as calibrated would make them, and what they add to what the samples know."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import OTHERS, by_face, times
from casacal.binding.slots import ENOUGH, Slot, make_slots
from casacal.instruments import Instrument
from casacal.instruments.instrument import Probe
from casacal.least_squares.linalg import posterior_covariance
from casacal.problem.cell import Cell, Face
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.reach import Touch
from casacal.simulation.touches import ROUNDS, try_touches
from casacal.tables.labels import Labels

EXTRA_TOUCHES = 24
"""Touches that are added: a quarter of an hour of work."""
MOST_FACES = 8
"""Faces, those with most rows, on which extra touches are made."""
SMALLEST = 50.0
"""Least side of a face that is touched, mm."""
TRIES = 2
"""Rounds of tries after which a face that was never reached is out of reach."""


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
    other: Samples
    """A row as those that there are mostly look: what is neither joints nor a reading nor a face stays like that."""
    held: bool
    """Whether it is known where the faces are, so that a new one makes no sense."""

    @staticmethod
    def of(bound: BoundProblem, x: Array) -> Touches | None:
        """At x (n,); None for instruments that know no faces by label, such as a tracker."""
        if len(bound.problem.instruments) != 1:
            return None
        labelled = bound.problem.instrument.with_faces_by_label()
        if labelled is None or labelled.probe is None:
            return None
        problem = bound.problem if labelled is bound.problem.instrument else Problem(bound.problem.robot, labelled)
        other = _usual(bound.samples[0])
        local = {
            slot.key: x[slot.columns]
            for slot in bound.slots
            if slot.label is None or slot.label in other.labels.get(slot.unknown.per or "", ())
        }
        touch = Touch.of(problem.robot, labelled, labelled.probe, local)
        found = _faces(bound, x, touch, labelled.probe)
        if not found:
            return None
        faces, senses, tilts = zip(*found, strict=True)
        held = not any(slot.datum and slot.unknown.size for slot in bound.slots)
        return Touches(problem, labelled.probe, touch, faces, senses, max(tilts), other, held)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels that extra touches may have: those of the faces, and of all else the commonest."""
        return (*(face.label for face in self.faces), *(values[0] for values in self.other.labels.values()))

    def on(self, cell: Cell) -> Samples | None:
        """Rows of touches shared between the faces of a cell; None where they are out of reach."""
        count, faces = EXTRA_TOUCHES, len(cell.faces)
        which, level, even, rng = np.arange(count) % faces, np.zeros(count), [None] * faces, np.random.default_rng(0)
        joints, readings = np.zeros((count, len(self.problem.robot.axes))), np.zeros(count)
        waiting = np.arange(count)
        for k in range(ROUNDS):
            found = try_touches(self.touch, self.probe, cell, which, level, [*even], rng, waiting)
            good = found[2]
            joints[waiting[good]], readings[waiting[good]] = found[0][good], found[1][good]
            waiting = waiting[~good]
            if not waiting.size:
                break
            if k + 1 == TRIES and (np.bincount(which[waiting], minlength=faces) == np.bincount(which)).any():
                return None
        else:
            return None
        alike = self.other.take(np.zeros(count, dtype=np.intp))
        columns, labels = dict(alike.columns), dict(alike.labels)
        if self.probe.column is not None:
            columns[self.probe.column] = readings
        assert self.probe.label is not None
        labels[self.probe.label] = Labels([face.label for face in cell.faces], which)
        return replace(alike, joints=joints, columns=columns, labels=labels)


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

    def plus(self, problem: Problem, cell: Cell, rows: Samples, noise: float) -> tuple[Array, Array]:
        """Information (m, m) and prior (m,) with extra rows, their noise times a factor; new unknowns come last."""
        instrument = problem.instrument
        old = {slot.name: slot for slot in (_by_label(each, instrument) for each in self.slots)}
        known = {slot.label for slot in old.values()}
        strange = {face.label: face for face in cell.faces if face.label not in known}
        faces = rows.faces(instrument.groups)
        there = np.flatnonzero(np.isin(faces.codes, [k for k, label in enumerate(faces.names) if label in strange]))
        new = [slot for slot in make_slots(problem, [rows.take(there)]) if slot.name not in old] if strange else []
        new = [_placed(slot, strange) for slot in new]
        slots, x = _in_row([*old.values(), *new], np.concatenate([self.x, np.zeros(sum(s.unknown.size for s in new))]))
        scale = _scale(self.bound.scale, noise)
        extra = BoundProblem(problem, slots, (rows,), "blocks", scale=scale)
        information = extra.information(x)
        information[: self.x.size, : self.x.size] += self.information
        return information, extra.prior_std


def _faces(bound: BoundProblem, x: Array, touch: Touch, probe: Probe) -> list[tuple[Face, int, float]]:
    """Rectangles around the tips of each face, most touched first, its plane's sense, and the largest tilt there."""
    samples, instrument = bound.samples[0], bound.problem.instrument
    some = samples.take(np.arange(0, len(samples), -(-len(samples) // ENOUGH)))
    readings = np.zeros((len(some), 1)) if probe.column is None else some.columns[probe.column][:, None]
    tips, plungers = touch.place(touch.local, some.joints, readings)
    labels, shared = some.faces(instrument.groups), {}
    found: list[tuple[Slot, NDArray[np.intp]]] = []
    for slot in bound.slots:
        if slot.unknown.nominal_plane(slot.nominal) is not None:
            if slot.key not in shared:
                have = (instrument.instance(slot.key, name) for name in labels.names)
                shared[slot.key] = Labels.coded(have, labels.codes).rows()
            found.append((slot, np.arange(len(some)) if slot.label is None else shared[slot.key][slot.label]))
    found.sort(key=lambda entry: -entry[1].size)
    return [_face(slot, x, tips[own], plungers[own]) for slot, own in found[:MOST_FACES]]


def _face(slot: Slot, x: Array, tips: Array, plungers: Array) -> tuple[Face, int, float]:
    """A rectangle around tips (N, 3), its plane's sense, and the largest tilt of plungers (N, 3) against it."""
    _, plane = slot.unknown.shown(slot.nominal, x[slot.columns])
    normal, point = plane["normal"], plane["point_mm"]
    against = -(plungers @ normal)
    sense = 1 if against.mean() > 0 else -1
    face = Face(slot.label or "plane", _triple(point), _triple(sense * normal))
    along = (tips - point) @ face.axes[1:].T
    low, high = along.min(axis=0), along.max(axis=0)
    width, depth = (max(float(side), SMALLEST) for side in high - low)
    centre = _triple(point + (low + high) / 2 @ face.axes[1:])
    tilt = math.acos(min(float((sense * against).min()), 1.0))
    return replace(face, centre=centre, size=(width, depth)), sense, tilt


def _usual(samples: Samples) -> Samples:
    """One row with the commonest label and the middle value of each column."""
    row = samples.take([0])
    columns = {name: np.array([np.median(values)]) for name, values in samples.columns.items()}
    common = {name: int(np.argmax(np.bincount(values.codes))) for name, values in samples.labels.items()}
    labels = {name: Labels([samples.labels[name].names[code]], np.zeros(1)) for name, code in common.items()}
    return replace(row, columns=columns, labels=labels, extra={})


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


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z

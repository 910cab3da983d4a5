"""Touches that an arm as calibrated could make next, on its faces as they were found: the pool of what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array, Index
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.slots import ENOUGH
from casacal.instruments.description import Probe
from casacal.problem.cell import Cell, Face, triple
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.reach import TouchingArm
from casacal.simulation.touches import ROUNDS, try_touches
from casacal.tables.columns import Labels
from casacal.unknowns.geometry import fitted_plane

POOL = 240  # touches that are drawn on the faces of a cell, to choose among
ENOUGH_OF_THEM = 0.8  # part of these that has to be found, where it can be: the last ones are the hardest to reach
FEWEST = 120  # touches without which there is nothing to choose among
STARTS = 50  # random poses among which each of them finds its start
MOST_FACES = 8  # faces, those with most rows, on which extra touches are made
SMALLEST = 50.0  # least side of a face that is touched, mm
TRIES = 2  # rounds of tries after which a face that was never reached is out of reach


@dataclass(frozen=True)
class CalibratedCell:
    """An arm as calibrated before its faces as they were found.

    problem: with a face for each label. faces: rectangles around what was touched, their normals towards the tool;
    those with most rows first. senses: whether each face's plane has that normal, or its opposite: +1, -1. tilt:
    largest angle (rad) between plunger and normal in the samples there are. other: a row as those that there are mostly
    look: what is neither joints nor a reading nor a face stays like that. held: whether a new face makes no sense, as
    it is known where faces are, or how they stand to each other.
    """

    problem: Problem
    probe: Probe
    touch: TouchingArm
    faces: tuple[Face, ...]
    senses: tuple[int, ...]
    tilt: float
    other: Samples
    held: bool

    @staticmethod
    def of(bound: BoundProblem, x: Array) -> CalibratedCell | None:
        """At x (n,); None for instruments that touch no faces, such as a tracker."""
        if len(bound.problem.instruments) != 1:
            return None
        more = bound.problem.instrument.with_faces_by_label()
        labelled = bound.problem.instrument if more is None else more
        if labelled.probe is None or labelled.probe.label is None:
            return None
        problem = bound.problem if labelled is bound.problem.instrument else Problem(bound.problem.robot, labelled)
        other = _usual(bound.samples[0])
        local = {
            slot.key: x[slot.columns]
            for slot in bound.slots
            if slot.label is None or slot.label in other.labels.get(slot.unknown.per or "", ())
        }
        touch = TouchingArm.of(problem.robot, labelled, labelled.probe, local)
        found = _faces(bound, x, touch, labelled.probe)
        if not found:
            return None
        faces, senses, tilts = zip(*found, strict=True)
        held = more is None or not any(slot.datum and slot.unknown.size for slot in bound.slots)
        return CalibratedCell(problem, labelled.probe, touch, faces, senses, max(tilts), other, held)

    def on(self, cell: Cell) -> Samples | None:
        """Rows of touches shared between the faces of a cell; None where they are out of reach."""
        faces = len(cell.faces)
        which, level, even, rng = np.arange(POOL) % faces, np.zeros(POOL), [None] * faces, np.random.default_rng(0)
        joints, readings = np.zeros((POOL, len(self.problem.robot.axes))), np.zeros(POOL)
        waiting = np.arange(POOL)
        for k in range(ROUNDS):
            found = try_touches(self.touch, self.probe, cell, which, level, [*even], rng, waiting, starts=STARTS)
            good = found[2]
            joints[waiting[good]], readings[waiting[good]] = found[0][good], found[1][good]
            waiting = waiting[~good]
            if waiting.size <= (1 - ENOUGH_OF_THEM) * POOL:
                break
            if k + 1 == TRIES and (np.bincount(which[waiting], minlength=faces) == np.bincount(which)).any():
                return None
        made = np.setdiff1d(np.arange(POOL), waiting)
        if made.size < FEWEST:
            return None
        alike = self.other.take(np.zeros(made.size, dtype=np.intp))
        columns, labels = dict(alike.columns), dict(alike.labels)
        if self.probe.column is not None:
            columns[self.probe.column] = readings[made]
        assert self.probe.label is not None
        labels[self.probe.label] = Labels([face.label for face in cell.faces], which[made])
        return replace(alike, joints=joints[made], columns=columns, labels=labels)


def _faces(bound: BoundProblem, x: Array, touch: TouchingArm, probe: Probe) -> list[tuple[Face, int, float]]:
    """Rectangles around the tips of each face, most touched first, its plane's sense, and the largest tilt there."""
    samples, instrument = bound.samples[0], bound.problem.instrument
    some = samples.take(np.arange(0, len(samples), -(-len(samples) // ENOUGH)))
    readings = np.zeros((len(some), 1)) if probe.column is None else some.columns[probe.column][:, None]
    tips, plungers = touch.place(touch.local, some.joints, readings)
    labels, shared = some.faces(instrument.groups), dict[str, Mapping[str, Index]]()
    found: list[tuple[str | None, Array, Array, Index]] = []
    for slot in bound.slots:
        if slot.unknown.nominal_plane(slot.nominal) is not None:
            if slot.key not in shared:
                have = (instrument.instance(slot.key, name) for name in labels.names)
                shared[slot.key] = Labels.coded(have, labels.codes).rows()
            own = np.arange(len(some)) if slot.label is None else shared[slot.key][slot.label]
            _, plane = slot.unknown.shown(slot.nominal, x[slot.columns])
            found.append((slot.label, plane["normal"], plane["point_mm"], own))
    if not found:  # faces of a body: an unknown of theirs is no plane
        planes = ((label, fitted_plane(tips[own]), own) for label, own in some.faces(probe.label).rows().items())
        found = [(label, plane.normal, plane.centre, own) for label, plane, own in planes if plane.flat]
    found.sort(key=lambda entry: -entry[3].size)
    most = found[:MOST_FACES]
    return [_face(label or "plane", normal, point, tips[own], plungers[own]) for label, normal, point, own in most]


def _face(label: str, normal: Array, point: Array, tips: Array, plungers: Array) -> tuple[Face, int, float]:
    """A rectangle around tips (N, 3), its plane's sense, and the largest tilt of plungers (N, 3) against it."""
    against = -(plungers @ normal)
    sense = 1 if against.mean() > 0 else -1
    face = Face(label, triple(point), triple(sense * normal))
    along = (tips - point) @ face.axes[1:].T
    low, high = along.min(axis=0), along.max(axis=0)
    width, depth = (max(float(side), SMALLEST) for side in high - low)
    centre = triple(point + (low + high) / 2 @ face.axes[1:])
    tilt = math.acos(min(float((sense * against).min()), 1.0))
    return replace(face, centre=centre, size=(width, depth)), sense, tilt


def _usual(samples: Samples) -> Samples:
    """One row with the commonest label and the middle value of each column."""
    row = samples.take([0])
    columns = {name: np.array([np.median(values)]) for name, values in samples.columns.items()}
    common = {name: int(np.argmax(np.bincount(values.codes))) for name, values in samples.labels.items()}
    labels = {name: Labels([samples.labels[name].names[code]], np.zeros(1)) for name, code in common.items()}
    return replace(row, columns=columns, labels=labels, extra={})


STEP = 100.0  # height of a gauge block, mm


BLOCK = (35.0, 35.0)  # its top, mm


def raised(face: Face, by: float, label: str) -> Face:
    """The same face, so many mm along its normal."""
    return replace(face, label=label, centre=triple(np.asarray(face.centre) + by * face.axes[0]))


def block_on(face: Face, label: str) -> Face:
    """The top of a gauge block that stands in the middle of a face."""
    return replace(raised(face, STEP, label), size=BLOCK)


def rising(face: Face, towards: Array, label: str) -> Face:
    """A face at right angles that rises from the edge of another one and looks towards (3,) across it."""
    centre = np.asarray(face.centre) + 0.5 * face.size[0] * (face.axes[0] - towards)
    return Face(label, triple(centre), triple(towards), face.size)


def inclined(face: Face, by: float, towards: Array, label: str) -> Face:
    """The same face, turned by an angle (rad) so that it looks more towards (3,)."""
    return replace(face, label=label, normal=triple(math.cos(by) * face.axes[0] + math.sin(by) * towards))


def fresh(label: str, faces: Sequence[Face]) -> str:
    """A label that no face has, like the one given."""
    while any(face.label == label for face in faces):
        label += "'"
    return label

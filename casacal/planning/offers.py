"""Further measurements open to a calibrated arm: its faces as found, faces to put beside them, and touches of both."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.data.columns import Labels
from casacal.data.samples import Samples
from casacal.fit.bound_problem import BoundProblem, by_face
from casacal.fit.slots import ENOUGH
from casacal.model.geometry import fitted_plane
from casacal.model.instrument import Probe
from casacal.model.problem import Problem
from casacal.simulation.cell import Cell, Face, triple
from casacal.simulation.touches import ROUNDS, TouchingArm, try_touches
from casacal.values import Array, Index

DRAWN = 240  # touches that are drawn on the faces of a cell, to choose among
ENOUGH_OF_THEM = 0.8  # part of these that has to be found, where it can be: the last ones are the hardest to reach
FEWEST_DRAWN = 120  # touches without which there is nothing to choose among
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
        """The cell at x (n,); None for instruments that touch no faces, such as a tracker."""
        if len(bound.problem.instruments) != 1:
            return None
        more = bound.problem.instrument.with_faces_by_label()
        labelled = bound.problem.instrument if more is None else more
        if labelled.probe is None or labelled.probe.label is None:
            return None
        problem = bound.problem if labelled is bound.problem.instrument else Problem(bound.problem.robot, labelled)
        samples = bound.samples[0]
        columns = {name: np.array([np.median(values)]) for name, values in samples.columns.items()}
        common = {name: int(np.argmax(np.bincount(values.codes))) for name, values in samples.labels.items()}
        labels = {name: Labels([samples.labels[name].names[code]], np.zeros(1)) for name, code in common.items()}
        other = replace(samples.take([0]), columns=columns, labels=labels, extra={})
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
        which, level, even, rng = np.arange(DRAWN) % faces, np.zeros(DRAWN), [None] * faces, np.random.default_rng(0)
        joints, readings = np.zeros((DRAWN, len(self.problem.robot.axes))), np.zeros(DRAWN)
        waiting = np.arange(DRAWN)
        for k in range(ROUNDS):
            found = try_touches(self.touch, self.probe, cell, which, level, [*even], rng, waiting, starts=STARTS)
            good = found[2]
            joints[waiting[good]], readings[waiting[good]] = found[0][good], found[1][good]
            waiting = waiting[~good]
            if waiting.size <= (1 - ENOUGH_OF_THEM) * DRAWN:
                break
            if k + 1 == TRIES and (np.bincount(which[waiting], minlength=faces) == np.bincount(which)).any():
                return None
        made = np.setdiff1d(np.arange(DRAWN), waiting)
        if made.size < FEWEST_DRAWN:
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
    made = []
    for label, normal, point, own in found[:MOST_FACES]:
        against = -(plungers[own] @ normal)
        sense = 1 if against.mean() > 0 else -1
        face = Face(label or "plane", triple(point), triple(sense * normal))
        along = (tips[own] - point) @ face.axes[1:].T
        low, high = along.min(axis=0), along.max(axis=0)
        width, depth = (max(float(side), SMALLEST) for side in high - low)
        centre = triple(point + (low + high) / 2 @ face.axes[1:])
        tilt = math.acos(min(float((sense * against).min()), 1.0))
        made.append((replace(face, centre=centre, size=(width, depth)), sense, tilt))
    return made


STEP = 100.0  # height of a gauge block, mm

BLOCK = (35.0, 35.0)  # its top, mm


def raised(face: Face, by: float, label: str) -> Face:
    """Face shifted along its normal by some mm."""
    return replace(face, label=label, centre=triple(np.asarray(face.centre) + by * face.axes[0]))


def block_on(face: Face, label: str, height: float = STEP) -> Face:
    """The top of a gauge block of a height (mm) that stands in the middle of a face."""
    return replace(raised(face, height, label), size=BLOCK)


def rising(face: Face, towards: Array, label: str) -> Face:
    """A face at right angles that rises from the edge of another one and looks towards (3,) across it."""
    centre = np.asarray(face.centre) + 0.5 * face.size[0] * (face.axes[0] - towards)
    return Face(label, triple(centre), triple(towards), face.size)


def inclined(face: Face, by: float, towards: Array, label: str) -> Face:
    """Face inclined by an angle (rad) towards a direction (3,)."""
    return replace(face, label=label, normal=triple(math.cos(by) * face.axes[0] + math.sin(by) * towards))


def fresh(label: str, faces: Sequence[Face]) -> str:
    """A label that no face has, like the one given."""
    while any(face.label == label for face in faces):
        label += "'"
    return label


EXTRA_TOUCHES = 24  # touches that are added: a quarter of an hour of work
PLENTY = 60  # extra touches for who has an hour
TILT = math.radians(30.0)  # largest tilt of the tool that is offered
NEARLY = math.radians(25.0)  # tilt from which more is none
MARGIN = math.radians(0.1)  # by which a tool may lean more than it has: as much as arms err
INCLINED = math.radians(15.0)  # by which a plate that stands alone is inclined
ALIKE = math.cos(math.radians(5.0))  # cosine between normals of faces that are as good as one


@dataclass(frozen=True)
class Offer:
    """One kind of further measurement; of several of a kind, the best is taken.

    cell: where touches are made; None where no faces are touched. noise: factor of the noise. touches: how many are
    chosen of those that can be made there.
    """

    kind: str
    words: str
    problem: Problem
    cell: Cell | None
    noise: float = 1.0
    touches: int = EXTRA_TOUCHES


def offers(bound: BoundProblem, touched: CalibratedCell) -> Iterator[Offer]:
    """Every further measurement that makes sense here, whether or not this arm can reach it."""
    faces, problem = touched.faces, touched.problem
    now = touched.tilt + MARGIN
    same = _cell(faces, now)
    for kind, count in (("same", EXTRA_TOUCHES), ("many", PLENTY)):
        yield Offer(kind, f"{count} planned touches of the same kind", problem, same, touches=count)
    # noise beyond what is stated no better indicator takes away
    found = any(factor > 1.1 for factor in by_face(bound.scale).values())
    how = "the mean of four readings each" if found else "a better dial, or the mean of four readings each"
    yield Offer("noise", f"{EXTRA_TOUCHES} planned touches at half the noise ({how})", problem, same, 0.5)
    if now < NEARLY:
        words = f"{EXTRA_TOUCHES} planned touches with the tool tilted by up to 30 degrees"
        yield Offer("tilt", words, problem, _cell(faces, TILT))
    first = faces[0]
    _, aside, side = first.axes
    across = (aside, -aside, side, -side)
    for aside in () if touched.held else across:
        second = rising(first, aside, fresh("second", faces))
        where = f"on the first face and another at right angles, facing {_named(aside)}"
        words = f"{EXTRA_TOUCHES} planned touches, tool tilted, {where}"
        yield Offer("face", words, problem, _cell((first, second), max(now, TILT)))
    alike = all(abs(face.axes[0] @ first.axes[0]) > ALIKE for face in faces)
    for aside in across if alike and not touched.held else ():
        leaned = inclined(first, INCLINED, aside, fresh("inclined", faces))
        words = f"{EXTRA_TOUCHES} planned touches on the plate inclined by 15 degrees towards {_named(aside)}"
        yield Offer("inclined", words, problem, _cell((leaned,), max(now, INCLINED + 10 * MARGIN)))
    label = fresh("known step", faces)
    stepped = problem.instrument.with_step(label, first.label, touched.senses[0] * STEP)
    if stepped is not None:
        words = f"{EXTRA_TOUCHES} planned touches on a gauge block (a {STEP:g} mm step) and beside it"
        yield Offer("step", words, Problem(problem.robot, stepped), _cell((first, block_on(first, label)), now))


def more_samples(problem: Problem) -> Iterator[Offer]:
    """Further measurements with an instrument that touches no faces."""
    for kind, count in (("same", EXTRA_TOUCHES), ("many", PLENTY)):
        yield Offer(kind, f"{count} planned samples of the same kind", problem, None, touches=count)
    yield Offer("noise", f"{EXTRA_TOUCHES} planned samples at half the noise", problem, None, 0.5)


def _cell(faces: tuple[Face, ...], tilt: float) -> Cell:
    return Cell(faces=faces, tilt=tilt, error_scale=0.0, repeatability=0.0, resolution=0.0)


def _named(normal: Array) -> str:
    """A direction in the base frame, as people say it."""
    largest = int(np.argmax(np.abs(normal)))
    if abs(normal[largest]) > ALIKE:
        return f"{'-' if normal[largest] < 0 else '+'}{'xyz'[largest]}"
    return f"({', '.join(f'{value:.1f}' for value in np.round(normal, 1) + 0.0)})"

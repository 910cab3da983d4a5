"""What could be done next with a dial on faces: in words, as a problem, and as a cell to be touched."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import by_face
from casacal.problem.cell import Cell, Face
from casacal.problem.problem import Problem
from casacal.uncertainty.extra_touches import EXTRA_TOUCHES, Touches

TILT = math.radians(30.0)
"""Largest tilt of the tool that is offered."""
NEARLY = math.radians(25.0)
"""Tilt from which more is none."""
MARGIN = math.radians(0.1)
"""By which a tool may lean more than it has: as much as arms err."""
STEP = 100.0
"""Known length that is offered, mm."""
BLOCK = (35.0, 35.0)
"""Top of the gauge block, mm."""
INCLINED = math.radians(15.0)
"""By which a plate that stands alone is inclined."""
ALIKE = math.cos(math.radians(5.0))
"""Cosine between normals of faces that are as good as one."""


@dataclass(frozen=True)
class Offer:
    """One way to go on; of several of the same kind, the best is meant."""

    kind: str
    words: str
    problem: Problem
    cell: Cell
    noise: float = 1.0
    """Factor of the noise."""


def offers(bound: BoundProblem, touches: Touches) -> Iterator[Offer]:
    """Every way to go on that makes sense here, whether or not this arm can reach it."""
    faces, problem, count = touches.faces, touches.problem, EXTRA_TOUCHES
    now = touches.tilt + MARGIN
    same = _cell(faces, now)
    yield Offer("same", f"{count} more touches of the same kind", problem, same)
    how = "each the mean of four" if _is_found(bound) else "a better indicator, or each the mean of four"
    yield Offer("noise", f"{count} touches with half the noise ({how})", problem, same, 0.5)
    if now < NEARLY:
        yield Offer("tilt", f"{count} touches with the tool tilted by 10 to 30 degrees", problem, _cell(faces, TILT))
    if not touches.held:
        yield from _other_faces(touches, now)
    yield from _step(touches, now)


def _other_faces(touches: Touches, tilt: float) -> Iterator[Offer]:
    """A face at right angles to the first; where all are as good as one, that one inclined."""
    faces, problem, count, first = touches.faces, touches.problem, EXTRA_TOUCHES, touches.faces[0]
    leaning = max(tilt, TILT)
    for aside in _across(first):
        second = Face(_new("second", faces), _beside(first, aside), _triple(aside), first.size)
        words = f"{count} touches, tool tilted, half of them on another face at right angles, facing {_named(aside)}"
        yield Offer("face", words, problem, _cell((first, second), leaning))
    if all(abs(face.axes[0] @ first.axes[0]) > ALIKE for face in faces):
        for aside in _across(first):
            normal = math.cos(INCLINED) * first.axes[0] + math.sin(INCLINED) * aside
            inclined = Face(_new("inclined", faces), first.centre, _triple(normal), first.size)
            words = f"{count} touches on the plate inclined by 15 degrees towards {_named(aside)}"
            yield Offer("inclined", words, problem, _cell((inclined,), max(tilt, INCLINED + 10 * MARGIN)))


def _step(touches: Touches, tilt: float) -> Iterator[Offer]:
    """A gauge block that stands on the first face: half of the touches on it, half beside it."""
    first, label = touches.faces[0], _new("known step", touches.faces)
    stepped = touches.problem.instrument.with_step(label, first.label, touches.senses[0] * STEP)
    if stepped is None:
        return
    top = np.asarray(first.centre) + STEP * first.axes[0]
    cell = _cell((first, Face(label, _triple(top), first.normal, BLOCK)), tilt)
    words = f"{EXTRA_TOUCHES} touches on a {STEP:g} mm step, half on the gauge block and half beside it"
    yield Offer("step", words, Problem(touches.problem.robot, stepped), cell)


def _cell(faces: tuple[Face, ...], tilt: float) -> Cell:
    return Cell(faces=faces, tilt=tilt, error_scale=0.0, repeatability=0.0, resolution=0.0)


def _is_found(bound: BoundProblem) -> bool:
    """Whether the rows show more noise than is stated, which no better indicator takes away."""
    return any(factor > 1.1 for factor in by_face(bound.scale).values())


def _across(face: Face) -> tuple[Array, ...]:
    """Four directions in a face."""
    _, aside, across = face.axes
    return aside, -aside, across, -across


def _beside(first: Face, normal: Array) -> tuple[float, float, float]:
    """Centre of a face at right angles that rises from the edge of another one."""
    return _triple(np.asarray(first.centre) + 0.5 * first.size[0] * (first.axes[0] - normal))


def _named(normal: Array) -> str:
    """A direction in the base frame, as people say it."""
    largest = int(np.argmax(np.abs(normal)))
    if abs(normal[largest]) > ALIKE:
        return f"{'-' if normal[largest] < 0 else '+'}{'xyz'[largest]}"
    return f"({', '.join(f'{value:.1f}' for value in np.round(normal, 1) + 0.0)})"


def _new(label: str, faces: tuple[Face, ...]) -> str:
    """A label that no face has."""
    while any(face.label == label for face in faces):
        label += "'"
    return label


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z

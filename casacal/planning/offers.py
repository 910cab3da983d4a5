"""What could be done next with a dial on faces: in words, as a problem, and as a cell to be touched."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import by_face
from casacal.planning.extra_touches import Touches
from casacal.planning.more_faces import STEP, block_on, fresh, inclined, rising
from casacal.problem.cell import Cell, Face
from casacal.problem.problem import Problem

EXTRA_TOUCHES = 24
"""Touches that are added: a quarter of an hour of work."""
PLENTY = 60
"""The same for who has an hour."""
TILT = math.radians(30.0)
"""Largest tilt of the tool that is offered."""
NEARLY = math.radians(25.0)
"""Tilt from which more is none."""
MARGIN = math.radians(0.1)
"""By which a tool may lean more than it has: as much as arms err."""
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
    touches: int = EXTRA_TOUCHES
    """How many are chosen of those that can be made in the cell."""


def offers(bound: BoundProblem, touches: Touches) -> Iterator[Offer]:
    """Every way to go on that makes sense here, whether or not this arm can reach it."""
    faces, problem = touches.faces, touches.problem
    now = touches.tilt + MARGIN
    same = _cell(faces, now)
    for kind, count in (("same", EXTRA_TOUCHES), ("many", PLENTY)):
        yield Offer(kind, f"{count} planned touches of the same kind", problem, same, touches=count)
    how = "the mean of four readings each" if _is_found(bound) else "a better dial, or the mean of four readings each"
    yield Offer("noise", f"{EXTRA_TOUCHES} planned touches at half the noise ({how})", problem, same, 0.5)
    if now < NEARLY:
        words = f"{EXTRA_TOUCHES} planned touches with the tool tilted by up to 30 degrees"
        yield Offer("tilt", words, problem, _cell(faces, TILT))
    if not touches.held:
        yield from _other_faces(touches, now)
    yield from _step(touches, now)


def _other_faces(touches: Touches, tilt: float) -> Iterator[Offer]:
    """A face at right angles to the first; where all are as good as one, that one inclined."""
    faces, problem, first = touches.faces, touches.problem, touches.faces[0]
    leaning = max(tilt, TILT)
    for aside in _across(first):
        second = rising(first, aside, fresh("second", faces))
        where = f"on the first face and another at right angles, facing {_named(aside)}"
        words = f"{EXTRA_TOUCHES} planned touches, tool tilted, {where}"
        yield Offer("face", words, problem, _cell((first, second), leaning))
    if all(abs(face.axes[0] @ first.axes[0]) > ALIKE for face in faces):
        for aside in _across(first):
            leaned = inclined(first, INCLINED, aside, fresh("inclined", faces))
            words = f"{EXTRA_TOUCHES} planned touches on the plate inclined by 15 degrees towards {_named(aside)}"
            yield Offer("inclined", words, problem, _cell((leaned,), max(tilt, INCLINED + 10 * MARGIN)))


def _step(touches: Touches, tilt: float) -> Iterator[Offer]:
    """A gauge block that stands on the first face: touches on it and beside it."""
    first, label = touches.faces[0], fresh("known step", touches.faces)
    stepped = touches.problem.instrument.with_step(label, first.label, touches.senses[0] * STEP)
    if stepped is None:
        return
    cell = _cell((first, block_on(first, label)), tilt)
    words = f"{EXTRA_TOUCHES} planned touches on a {STEP:g} mm step, on the gauge block and beside it"
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


def _named(normal: Array) -> str:
    """A direction in the base frame, as people say it."""
    largest = int(np.argmax(np.abs(normal)))
    if abs(normal[largest]) > ALIKE:
        return f"{'-' if normal[largest] < 0 else '+'}{'xyz'[largest]}"
    return f"({', '.join(f'{value:.1f}' for value in np.round(normal, 1) + 0.0)})"

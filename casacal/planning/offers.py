"""Ways to go on: more touches, other faces and steps, and how many touches are enough."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import by_face
from casacal.binding.slots import instances
from casacal.planning.exchange import Chosen
from casacal.planning.extra_touches import STEP, Touches, block_on, fresh, inclined, rising
from casacal.planning.route import FIT, Route
from casacal.problem.cell import Cell, Face
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples


def rows_needed(problem: Problem, route: Route) -> tuple[int, int]:
    """How many touches a plan has to fit, and how many `calibrate` takes at least for all unknowns of arm and faces."""
    fitted = np.flatnonzero([purpose == FIT for purpose in route.purposes])
    own = sum(
        u.size * len(instances(problem.instrument, key, u, route.samples.take(fitted)))
        for key, u in problem.instrument.unknowns.items()
    )
    total = own + sum(unknown.size for unknown in problem.robot.parameters.values())
    return len(fitted), -(-total // problem.models[0].components)


def seldom(problem: Problem, pool: Samples, chosen: Chosen) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Measurements of a pool (N,) of faces that the chosen ones touch too seldom to say where they are.

    Such touches place the face at best, and tell nothing of the arm. Of all such faces, and of the one that is touched
    least but touched.
    """
    taken = np.zeros(len(pool), dtype=bool)
    taken[chosen] = True
    all_of_them, least, fewest = np.zeros(len(pool), dtype=bool), np.zeros(len(pool), dtype=bool), len(pool)
    for key in problem.instrument.datum:
        unknown = problem.instrument.unknowns[key]
        flat = int((~np.isfinite(unknown.prior_stds)).sum())
        for _, rows in instances(problem.instrument, key, unknown, pool):
            count = int(taken[rows].sum())
            if count * problem.models[0].components > flat:
                continue
            all_of_them[rows] = True
            if 0 < count < fewest:
                fewest, least = count, np.zeros(len(pool), dtype=bool)
                least[rows] = True
    return all_of_them, least


EXTRA_TOUCHES = 24  # touches that are added: a quarter of an hour of work
PLENTY = 60  # the same for who has an hour
TILT = math.radians(30.0)  # largest tilt of the tool that is offered
NEARLY = math.radians(25.0)  # tilt from which more is none
MARGIN = math.radians(0.1)  # by which a tool may lean more than it has: as much as arms err
INCLINED = math.radians(15.0)  # by which a plate that stands alone is inclined
ALIKE = math.cos(math.radians(5.0))  # cosine between normals of faces that are as good as one


@dataclass(frozen=True)
class Offer:
    """One way to go on; of several of the same kind, the best is meant.

    noise: factor of the noise. touches: how many are chosen of those that can be made in the cell.
    """

    kind: str
    words: str
    problem: Problem
    cell: Cell
    noise: float = 1.0
    touches: int = EXTRA_TOUCHES


def offers(bound: BoundProblem, touches: Touches) -> Iterator[Offer]:
    """Every way to go on that makes sense here, whether or not this arm can reach it."""
    faces, problem = touches.faces, touches.problem
    now = touches.tilt + MARGIN
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

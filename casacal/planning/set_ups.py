"""Ways to set a cell up: as they compare beforehand, and as ways to go on after a calibration."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.noise_scale import by_face
from casacal.errors import CasacalError
from casacal.planning.choice import Choice, cell_of, pool_of, wanted_joints
from casacal.planning.extra_touches import STEP, CalibratedCell, block_on, fresh, inclined, raised, rising
from casacal.problem.problem import Problem
from casacal.simulation.cell import Cell, Disturbances, Face
from casacal.uncertainty.expectation import Box
from casacal.values import Value

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
    """Every way to go on that makes sense here, whether or not this arm can reach it."""
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
    if not touched.held:
        yield from _other_faces(touched, now)
    yield from _step(touched, now)


def more_samples(problem: Problem) -> Iterator[Offer]:
    """Ways to go on with an instrument that touches no faces."""
    for kind, count in (("same", EXTRA_TOUCHES), ("many", PLENTY)):
        yield Offer(kind, f"{count} planned samples of the same kind", problem, None, touches=count)
    yield Offer("noise", f"{EXTRA_TOUCHES} planned samples at half the noise", problem, None, 0.5)


def _other_faces(touched: CalibratedCell, tilt: float) -> Iterator[Offer]:
    """A face at right angles to the first; where all are as good as one, that one inclined."""
    faces, problem, first = touched.faces, touched.problem, touched.faces[0]
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


def _step(touched: CalibratedCell, tilt: float) -> Iterator[Offer]:
    """A gauge block that stands on the first face: touches on it and beside it."""
    first, label = touched.faces[0], fresh("known step", touched.faces)
    stepped = touched.problem.instrument.with_step(label, first.label, touched.senses[0] * STEP)
    if stepped is None:
        return
    cell = _cell((first, block_on(first, label)), tilt)
    words = f"{EXTRA_TOUCHES} planned touches on a gauge block (a {STEP:g} mm step) and beside it"
    yield Offer("step", words, Problem(touched.problem.robot, stepped), cell)


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


POOL = 600  # touches among which is chosen in each set-up
FEW = 3  # touches of each face that show whether it is in reach
HIGHER = 300.0  # by how much a plate is raised, mm
TILTS = (10.0, 30.0, 45.0)  # largest angles between plunger and face that are compared, degrees


@dataclass(frozen=True, eq=False)
class SetUp(Value):
    """A way to set the cell up, and the tip error (mm RMS) that chosen touches leave there; infinite out of reach.

    as_it_is: whether it is the present one.
    """

    words: str
    problem: Problem
    cell: Cell
    error: float
    as_it_is: bool = False


def set_ups(
    problem: Problem,
    cell: Disturbances | None = None,
    *,
    touches: int = 40,
    box: Box | None = None,
    targets: Array | None = None,
    seed: int = 0,
) -> tuple[SetUp, ...]:
    """Compare ways to set the cell up by the tip error to expect from as many touches, the best first.

    As it is; one plate; it at two heights; three faces at right angles; a gauge block; other tilts. What this arm
    cannot touch is last, with an infinite error. touches: how many are fitted in each. cell, box, targets, seed: as for
    `plan`. Raises CasacalError for an instrument that touches no faces.
    """
    still = cell_of(problem, cell)
    if not isinstance(still, Cell):
        what = f"{type(problem.instrument).__name__} touches no faces, so there are no set-ups of them"
        raise CasacalError(what, "Plan without comparing set-ups")
    if not 3 <= touches <= POOL:
        raise CasacalError(f"{touches} touches were asked for", f"Give 3 to {POOL}")
    found = list[SetUp]()
    for words, other, place in _ways(problem.without_terms, still):
        try:
            pool_of(other, place, FEW * len(place.faces), seed)  # soon says what is out of reach
            bound = bind(other, pool_of(other, place, POOL, seed))
            choice = Choice.of(bound, wanted_joints(bound, box, targets))
            error = choice.error(choice.best_of(touches, 1, np.random.default_rng(seed)))
        except CasacalError:  # out of reach
            error = math.inf
        found.append(SetUp(words, other, place, error, not found))
    return tuple(sorted(found, key=lambda each: each.error))


WORTH = 0.7  # error over that of the present set-up below which another one is worth the work


def worth_most(compared: Sequence[SetUp]) -> tuple[SetUp, SetUp] | None:
    """The best of some set-ups and the present one; None where the best is hardly better."""
    best, now = min(compared, key=lambda each: each.error), [each for each in compared if each.as_it_is]
    return (best, now[0]) if now and best.error < WORTH * now[0].error else None


def _ways(problem: Problem, cell: Cell) -> Iterator[tuple[str, Problem, Cell]]:
    """Words, problem and cell of each."""
    count, tilt = len(cell.faces), math.degrees(cell.tilt)
    yield f"as it is: {'one face' if count == 1 else f'{count} faces'}, tilt up to {tilt:.0f} degrees", problem, cell
    first = cell.faces[0]
    several = problem.instrument.with_faces_by_label()
    labelled = problem if several is None else Problem(problem.robot, several)
    if count > 1:
        yield f"one plate, '{first.label}'", problem, replace(cell, faces=(first,))
    if several is not None:
        higher = raised(first, HIGHER, fresh("higher", cell.faces))
        words = f"one plate, '{first.label}', and it again {HIGHER:g} mm higher"
        yield words, labelled, replace(cell, faces=(first, higher))
        normals = np.array([face.axes[0] for face in cell.faces])
        square = np.abs(normals @ normals.T) < math.sin(math.radians(10))
        if count < 3 or (square.sum(axis=1) < 2).all():  # there are not three faces at right angles already
            walls = (rising(first, first.axes[k], fresh(label, (first,))) for k, label in ((1, "wall"), (2, "side")))
            yield "three faces at right angles", labelled, replace(cell, faces=(first, *walls))
        label = fresh("gauge block", cell.faces)
        stepped = several.with_step(label, first.label, STEP)
        if stepped is not None:
            words = f"as it is, and a gauge block of {STEP:g} mm on '{first.label}'"
            yield words, Problem(problem.robot, stepped), replace(cell, faces=(*cell.faces, block_on(first, label)))
    for other in TILTS:
        if abs(other - tilt) > 1:
            yield f"as it is, tilt up to {other:.0f} degrees", problem, replace(cell, tilt=math.radians(other))

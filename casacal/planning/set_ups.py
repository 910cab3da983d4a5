"""Ways to set a cell up, compared by the tip error to expect from touches that are chosen in each."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casacal.errors import CasacalError
from casacal.files import MADE
from casacal.fit.bound_problem import bind
from casacal.model.problem import Problem
from casacal.model.problem_file import FILL_IN, ProblemFile
from casacal.model.problem_text import word
from casacal.pages.drawing import plain_text
from casacal.planning.candidates import cell_of, pool_of
from casacal.planning.choice import Choice, wanted_joints
from casacal.planning.clearance import Clearance
from casacal.planning.offers import STEP, block_on, fresh, raised, rising
from casacal.simulation.cell import Cell, Disturbances, Face
from casacal.values import Array, Box, Value, plain
from casacal.wording import numbered_lines

POOL = 600  # touches among which is chosen in each set-up
FEW = 3  # touches of each face that show whether it is in reach
HIGHER = 300.0  # by how much a plate is raised, mm
TILTS = (10.0, 30.0, 45.0)  # largest angles between plunger and face that are compared, degrees


@dataclass(frozen=True, eq=False)
class SetUp(Value):
    """A way to set the cell up, and the tip error (mm RMS) that chosen touches leave there.

    It is infinite where hardly a touch can be made. option: of `casacal plan`, which makes a plan for it, or else the
    faces as options of `casacal new`; empty as it is.
    """

    words: str
    problem: Problem
    cell: Cell
    error: float
    option: str = ""


def set_ups(
    problem: Problem,
    cell: Disturbances | None = None,
    *,
    touches: int = 40,
    box: Box | None = None,
    targets: Array | None = None,
    clearance: Clearance | None = None,
    seed: int = 0,
) -> tuple[SetUp, ...]:
    """Compare ways to set the cell up by the tip error to expect from as many touches, the best first.

    As it is; one plate; it at two heights; three faces at right angles; a gauge block; other tilts. What this arm
    cannot touch is last, with an infinite error. touches: how many are fitted in each. cell, box, targets,
    clearance, seed: as for `plan`. Raises CasacalError for an instrument that touches no faces.
    """
    still = cell_of(problem, cell)
    if not isinstance(still, Cell) or problem.instrument.probe is None:
        what = f"{type(problem.instrument).__name__} touches no faces, so there are no set-ups of them"
        raise CasacalError(what, "Plan without comparing set-ups")
    if not 3 <= touches <= POOL:
        raise CasacalError(f"{touches} touches were asked for", f"Give 3 to {POOL}")
    found = list[SetUp]()
    for words, option, other, place in _ways(problem.without_terms, still):
        try:
            bound = bind(other, pool_of(other, place, POOL, seed, clearance, trial=FEW * len(place.faces)))
            choice = Choice.of(bound, wanted_joints(bound, box, targets))
            error = choice.error(choice.best_of(touches, 1, np.random.default_rng(seed)))
        except CasacalError:  # out of reach
            error = math.inf
        found.append(SetUp(words, other, place, error, option))
    return tuple(sorted(found, key=lambda each: each.error))


WORTH = 0.7  # error over that of the present set-up below which another one is worth the work


def worth_most(compared: Sequence[SetUp]) -> tuple[SetUp, SetUp] | None:
    """The best of some set-ups and the present one; None where the best is hardly better."""
    best, now = min(compared, key=lambda each: each.error), [each for each in compared if not each.option]
    return (best, now[0]) if now and best.error < WORTH * now[0].error else None


def with_block(problem: Problem, cell: Cell, height: float) -> tuple[Problem, Cell] | None:
    """Problem and cell with a gauge block of a height (mm) on the first face; None where faces are those of a body."""
    first, several = cell.faces[0], problem.instrument.with_faces_by_label()
    label = fresh("block", cell.faces)
    stepped = None if several is None else several.with_step(label, first.label, height)
    if stepped is None:
        return None
    stood = replace(cell, faces=(*cell.faces, block_on(first, label, height)))
    return problem.with_parts(problem.robot, (stepped,)), stood


def block_text(source: ProblemFile, cell: Cell, folder: Path, instrument: str | None) -> str:
    """problem.py in a folder for a problem file and its cell with a gauge block, measured by one instrument of it.

    It names the lines of the problem file that are still to be filled in.
    """
    faces = [f"Face{(face.label, *map(plain, (face.centre, face.normal, face.size)))}" for face in cell.faces]
    height = float((np.subtract(cell.faces[-1].centre, cell.faces[0].centre)) @ cell.faces[0].axes[0])
    marked = [k for k, line in enumerate(source.files[0].text.splitlines(), 1) if FILL_IN in line]
    said = {
        "name": word(source.name),
        "faces": faces,
        "height": f"{round(height, 9):g}",
        "table": cell.table,
        "made": MADE,
        "unchecked": numbered_lines(marked) if marked else "",
        "block": cell.faces[-1].label,
        "first": cell.faces[0].label,
        "instrument": instrument,
        "path": Path(os.path.relpath(source.path, folder)).as_posix(),
    }
    return plain_text("block.py.txt", said)


def _plates(faces: Sequence[Face]) -> str:
    """Faces as options of `casacal new`."""
    found = []
    for face in faces:
        centre, normal = (
            ",".join(f"{round(value, 3) + 0.0:g}" for value in each) for each in (face.centre, face.axes[0])
        )
        found.append(f"--plate={face.label}:{centre}:{normal}:{min(face.size):g}")
    return shlex.join(found)


def _ways(problem: Problem, cell: Cell) -> Iterator[tuple[str, str, Problem, Cell]]:
    """Words, option, problem and cell of each."""
    count, tilt = len(cell.faces), math.degrees(cell.tilt)
    number = "one face" if count == 1 else f"{count} faces"
    yield f"as it is: {number}, tilt up to {tilt:.0f} degrees", "", problem, cell
    first = cell.faces[0]
    several = problem.instrument.with_faces_by_label()
    labelled = problem if several is None else problem.with_parts(problem.robot, (several,))
    if count > 1:
        yield f"one plate, '{first.label}'", _plates([first]), problem, replace(cell, faces=(first,))
    if several is not None:
        faces = (first, raised(first, HIGHER, fresh("higher", cell.faces)))
        words = f"one plate, '{first.label}', and it again {HIGHER:g} mm higher"
        yield words, _plates(faces), labelled, replace(cell, faces=faces)
        normals = np.array([face.axes[0] for face in cell.faces])
        square = np.abs(normals @ normals.T) < math.sin(math.radians(10))
        if count < 3 or (square.sum(axis=1) < 2).all():  # there are not three faces at right angles already
            walls = [rising(first, first.axes[k], fresh(label, (first,))) for k, label in ((1, "wall"), (2, "side"))]
            three = replace(cell, faces=(first, *walls))
            yield "three faces at right angles", _plates(three.faces), labelled, three
        there = any(face.label.startswith("block") for face in cell.faces)
        if not there and (blocked := with_block(problem, cell, STEP)) is not None:
            yield f"as it is, and a gauge block of {STEP:g} mm on '{first.label}'", f"--block={STEP:g}", *blocked
    for other in TILTS:
        if abs(other - tilt) > 1:
            words = f"as it is, tilt up to {other:.0f} degrees"
            yield words, f"--tilt={other:g}", problem, replace(cell, tilt=math.radians(other))

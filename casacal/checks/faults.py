"""What people do wrong with samples and the problem file, each with what undoes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain, combinations, permutations

import numpy as np

from casacal.array_types import Array
from casacal.checks.finding import Fault, Undo, Undone
from casacal.checks.fitted_faults import (
    drifting,
    geared,
    scaled,
    somewhere_moved,
    tool_elsewhere,
    tool_keys,
    zero_moved,
)
from casacal.checks.numbers import numbers
from casacal.instruments import Suspect
from casacal.instruments.description import readings_within
from casacal.instruments.usual_mistakes import ANGLE_UNITS, UNIT_MISTAKES
from casacal.problem.problem import Problem
from casacal.problem.problem_text import conventions_line
from casacal.robots.joints import Conventions
from casacal.robots.robot import Robot
from casacal.samples.samples import Samples
from casacal.tables.columns import Labels

DOCTOR = "Run casacal doctor on rows of the pendant, and write the coupling into the problem's Conventions"

MOST_FACES = 12  # faces beyond which their labels are not exchanged two by two


def suspected(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Every mistake that is looked for; of two that explain samples alike and are as simple, the first is believed."""
    return chain(_columns_and_joints(problem), _parts_of_the_cell(problem, samples))


def _columns_and_joints(problem: Problem) -> Iterator[Fault]:
    """Mistakes in whole columns: sign, units, joints the other way or swapped; the table's convention."""
    turns = problem.robot.revolute
    for suspect in problem.instrument.suspects:
        yield Fault(suspect.about, suspect.cause, suspect.fix, _rewritten(suspect))
    if turns.any():
        for factor, words in ANGLE_UNITS.items():
            cause, fix = f"the joint angles look like {words}", "Correct the unit in the columns' names"
            yield Fault("unit of the joints", cause, fix, _turned(np.diag(np.where(turns, factor, 1.0))))
    yield from flips(problem)
    if (other := problem.robot.in_other_convention()) is not None:
        cause, fix = "the DH table seems to be of the other convention", "Correct its convention, standard or modified"
        yield Fault("DH convention", cause, fix, partial(_with_arm, robot=other), 1, common=False)
    for i, j in combinations(range(len(turns)), 2):
        if turns[i] == turns[j]:
            order = np.eye(len(turns))
            order[[i, j]] = order[[j, i]]
            cause, fix = f"columns q{i + 1} and q{j + 1} seem to be swapped", "Swap the two column names"
            yield Fault(f"joints {i + 1} and {j + 1} swapped", cause, fix, _turned(order))


def flips(problem: Problem) -> Iterator[Fault]:
    """Each joint counted the other way."""
    count, arm = len(problem.robot.axes), problem.robot.arm
    for i in range(count):
        signs = np.ones(count)
        signs[i] = -1.0
        cause = f"joint {i + 1} seems to be counted in the other direction"
        fix = f"Reverse the sign of column q{i + 1}"
        if arm is not None:
            said = (arm.conventions or Conventions.plain(count)).flipped(i + 1)
            line = conventions_line(said, problem.robot.axes)
            fix += f", or turn the joint round in the problem, with its limits: {line}"
        yield Fault(f"joint {i + 1} flipped", cause, fix, _turned(np.diag(signs)))


def _parts_of_the_cell(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Mistakes that concern the tool, one face, two joints, or the order of the rows."""
    probe, turns = problem.instrument.probe, problem.robot.revolute
    if tool_keys(problem):
        fix = "Measure the tool from the flange again, and correct it in the problem file"
        cause = "the tool seems to be elsewhere"
        yield Fault("tool elsewhere", cause, fix, tool_elsewhere, 3)
    if probe is not None and probe.column is not None:
        yield from _signs_of_faces(samples, probe.column, probe.label, sum(readings_within(probe.travel)))
        yield from _some_units(samples, probe.column, readings_within(probe.travel))
    yield from _exchanged(problem, samples)
    yield from numbers(problem)
    yield from _zeros(problem)
    for i, j in permutations(range(len(turns)), 2):
        about = f"joint {j + 1} coupled to joint {i + 1}"
        if turns[i] == turns[j]:
            for factor in (1.0, -1.0):
                coupled = np.eye(len(turns))
                coupled[j, i] = factor
                said = "turns" if turns[j] else "slides"
                cause = f"joint {j + 1} seems to {said[:-1]} {'with' if factor > 0 else 'against'} joint {i + 1}"
                yield Fault(about, cause, DOCTOR, _turned(coupled), common=False)
        elif turns[i]:
            cause = f"joint {j + 1} seems to slide as joint {i + 1} turns"
            yield Fault(about, cause, DOCTOR, partial(geared, turning=i, sliding=j), 1, False)
    lengths = [name for name, kind in problem.instrument.columns.items() if kind == "length"]
    if probe is None and lengths:
        fix = "Check the instrument's scale factor and its settings for air, or declare the scale as an unknown"
        undo = partial(scaled, columns=lengths)
        yield Fault("scale of the readings", "the readings seem to be off in proportion", fix, undo, 1, False)
    if probe is not None and probe.column is not None:
        yield from _one_row_off(probe.column)
        fix = "Let dial and arm warm up, fasten the stand, and measure again; touch one place at the beginning and end"
        yield Fault("drift", "the readings seem to drift", fix, partial(drifting, column=probe.column), 1)
        said = probe.zero_label or "session"
        fix = f"Give the rows from there on another value in a column '{said}'"
        fix += "" if probe.zero else ", and declare zero_shift=dial_zero() for the dial"
        cause = "the dial seems to have been set to zero anew, or to have slipped in its clamp"
        yield Fault("dial set to zero anew", cause, fix, partial(zero_moved, column=probe.column), 2, False)
    if problem.instrument.groups is not None:
        fix = "Fasten base, tool and faces, and measure again, or give the faces other labels from there on"
        yield Fault("something moved", "base, tool or faces seem to have moved", fix, somewhere_moved, 9, False)


def _signs_of_faces(samples: Samples, column: str, label: str | None, ends: float) -> Iterator[Fault]:
    """The reading of one face counted the other way, from zero or from the other end; both ends add up to `ends`."""
    faces = samples.faces(label)
    if len(faces.names) < 2:
        return
    for name in faces.names:
        cause = f"the readings on '{name}' seem to have the wrong sign"
        fix = f"Reverse the sign of the readings on '{name}'"
        for end in dict.fromkeys((0.0, ends)):

            def undo(problem: Problem, samples: Samples, name: str = name, end: float = end) -> Undone:
                reading, rows = samples.columns[column].copy(), samples.faces(label).rows()[name]
                reading[rows] = end - reading[rows]
                return Undone(problem, replace(samples, columns={**samples.columns, column: reading}))

            yield Fault(f"dial sign of '{name}'", cause, fix, undo)


def _one_row_off(column: str) -> Iterator[Fault]:
    """The column of readings slipped by one row against the joints, as in a spreadsheet; the row at the end is lost."""
    for by, which in ((-1, "previous"), (1, "next")):

        def undo(problem: Problem, samples: Samples, by: int = by) -> Undone:
            rows = np.arange(len(samples) - 1) + max(by, 0)
            reading = np.roll(samples.columns[column], by)
            return Undone(problem, replace(samples, columns={**samples.columns, column: reading}).take(rows))

        cause, fix = f"each reading seems to belong to the joints of the {which} row", "Move the column by one row"
        yield Fault("readings one row off", cause, fix, undo, 1, common=False)


def _some_units(samples: Samples, column: str, ends: tuple[float, float]) -> Iterator[Fault]:
    """Some readings in another unit: those that stay within the dial's travel in it, or that it alone brings there."""
    reading, most = samples.columns[column], max(map(abs, ends))
    for factor, words in UNIT_MISTAKES.items():
        other = np.abs(reading) <= most / factor if factor > 1 else np.abs(reading) > most
        if not other.any() or other.all():
            continue
        which = f"up to {most / factor:.3g}" if factor > 1 else f"beyond {most:g}"
        cause, fix = f"the readings {which} mm seem to be {words}", "Write all readings in one unit"
        changed = {**samples.columns, column: np.where(other, factor * reading, reading)}
        yield Fault("unit of some readings", cause, fix, partial(_instead, columns=changed), 1, False)


def _instead(problem: Problem, samples: Samples, *, columns: dict[str, Array]) -> Undone:
    return Undone(problem, replace(samples, columns=columns))


def _exchanged(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Labels of two faces in each other's place, where one stands on another or on it; else a name says nothing."""
    column, probe = problem.instrument.groups, problem.instrument.probe
    if column is None or probe is None or not probe.steps:
        return
    names = samples.faces(column).names
    known = {*probe.steps, *(problem.instrument.instance("plane", step) for step in probe.steps)}
    pairs = combinations(names if len(names) <= MOST_FACES else (), 2)
    for one, two in (pair for pair in pairs if known & set(pair)):

        def undo(problem: Problem, samples: Samples, one: str = one, two: str = two) -> Undone:
            faces, other = samples.faces(column), {one: two, two: one}
            swapped = Labels(tuple(other.get(name, name) for name in faces.names), faces.codes)
            return Undone(problem, replace(samples, labels={**samples.labels, column: swapped}))

        cause, fix = f"the labels '{one}' and '{two}' seem to be exchanged in all rows", "Exchange them"
        yield Fault("labels exchanged", cause, fix, undo)


def _zeros(problem: Problem) -> Iterator[Fault]:
    """The zero of a joint a quarter or half a turn from where the problem has it."""
    for i in np.flatnonzero(problem.robot.revolute).tolist():
        for turn in (90, -90, 180):
            cause = f"the zero of joint {i + 1} seems to be {turn} degrees from where the problem has it"
            fix = f"Add {turn} degrees to column q{i + 1}, or to theta of that joint; casacal doctor finds it as well"
            same = np.eye(len(problem.robot.axes))
            undo = _turned(same, math.radians(turn) * same[i])
            yield Fault(f"zero of joint {i + 1}", cause, fix, undo, 1, common=False)


def _with_arm(problem: Problem, samples: Samples, *, robot: Robot) -> Undone:
    return Undone(problem.with_parts(robot, problem.instruments), samples)


def _rewritten(suspect: Suspect) -> Undo:
    def undo(problem: Problem, samples: Samples) -> Undone:
        order = suspect.order or suspect.columns
        pairs = zip(suspect.columns, order, strict=True)
        scaled = {name: samples.columns[true] * suspect.factor for name, true in pairs}
        return Undone(problem, replace(samples, columns={**samples.columns, **scaled}))

    return undo


def _turned(matrix: Array, shift: Array | float = 0.0) -> Callable[[Problem, Samples], Undone]:
    return lambda problem, samples: Undone(problem, replace(samples, joints=samples.joints @ matrix.T + shift))

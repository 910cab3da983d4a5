"""The cause of a misfit, found by undoing what people do wrong: one thing if that suffices, else two."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations, permutations

import numpy as np

from casacal.array_types import Array
from casacal.checks.finding import FIRST_STEPS, STEPS, Fault, Finding, Undo, Undone, misfit
from casacal.checks.fitted_faults import drifting, geared, somewhere_moved, tool_elsewhere, tool_keys
from casacal.checks.numbers import numbers
from casacal.errors import CasacalError
from casacal.instruments import Suspect
from casacal.instruments.description import readings_within
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.wording import times

ANGLE_UNITS = {180 / math.pi: "radians, written as degrees", math.pi / 180: "degrees, written as radians"}

DOCTOR = "Run casacal doctor on rows of the pendant, and write the coupling into the problem's Conventions"


def columns_and_joints(problem: Problem) -> Iterator[Fault]:
    """Mistakes in whole columns: sign, units, joints counted the other way or swapped."""
    turns = problem.robot.revolute
    for suspect in problem.instrument.suspects:
        yield Fault(suspect.about, suspect.cause, suspect.fix, _rewritten(suspect))
    if turns.any():
        for factor, words in ANGLE_UNITS.items():
            cause, fix = f"the joint angles look like {words}", "Correct the unit in the columns' names"
            yield Fault("unit of the joints", cause, fix, _turned(np.diag(np.where(turns, factor, 1.0))))
    yield from flips(problem)
    for i, j in combinations(range(len(turns)), 2):
        if turns[i] == turns[j]:
            order = np.eye(len(turns))
            order[[i, j]] = order[[j, i]]
            cause, fix = f"columns q{i + 1} and q{j + 1} seem to be swapped", "Swap the two column names"
            yield Fault(f"joints {i + 1} and {j + 1} swapped", cause, fix, _turned(order))


def flips(problem: Problem) -> Iterator[Fault]:
    """Each joint counted the other way."""
    count = len(problem.robot.axes)
    for i in range(count):
        signs = np.ones(count)
        signs[i] = -1.0
        cause = f"joint {i + 1} seems to be counted in the other direction"
        fix = f"Reverse the sign of column q{i + 1}, or of the joint in the problem"
        yield Fault(f"joint {i + 1} flipped", cause, fix, _turned(np.diag(signs)))


def parts_of_the_cell(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Mistakes that concern the tool, one face, two joints, or the order of the rows."""
    probe, turns = problem.instrument.probe, problem.robot.revolute
    if names := ",".join(tool_keys(problem)):
        fix = f"Measure the tool again, and correct it in the problem (--free {names} --prior {names}=20 tries it)"
        cause = "the tool seems to be elsewhere"
        yield Fault("tool elsewhere", cause, fix, tool_elsewhere, 3)
    if probe is not None and probe.column is not None:
        yield from _signs_of_faces(samples, probe.column, probe.label, sum(readings_within(probe.travel)))
    yield from numbers(problem)
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
    if probe is not None and probe.column is not None:
        fix = "Let dial and arm warm up, fasten the stand, and measure again; touch one place at the beginning and end"
        yield Fault("drift", "the readings seem to drift", fix, partial(drifting, column=probe.column), 1)
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


def _rewritten(suspect: Suspect) -> Undo:
    def undo(problem: Problem, samples: Samples) -> Undone:
        order = suspect.order or suspect.columns
        pairs = zip(suspect.columns, order, strict=True)
        scaled = {name: samples.columns[true] * suspect.factor for name, true in pairs}
        return Undone(problem, replace(samples, columns={**samples.columns, **scaled}))

    return undo


def _turned(matrix: Array) -> Callable[[Problem, Samples], Undone]:
    return lambda problem, samples: Undone(problem, replace(samples, joints=samples.joints @ matrix.T))


SUSPICIOUS = 2.0  # misfit, in stated standard deviations, above which something systematic is looked for
BETTER = 0.25  # an undone fault must shrink the misfit to this part to be believed
EXPLAINED = 50.0  # misfit that noise and effects leave at most; what leaves more explains nothing
CHANCE = 1.3  # a misfit of this size is chance: whatever leaves no more explains it all
ALIKE = 1.5  # within this factor a fault and its absence cannot be told apart
PROMISING = 12  # faults, or pairs of them, that a first look finds best and that are fitted to the end
PAIRED = 3  # single faults, beside the usual ones, that are tried together with others
RIVALS = 3  # faults that would explain it equally well and are named


@dataclass(frozen=True)
class Cause:
    """What explains a misfit, as a finding, and problem and samples without it."""

    finding: Finding
    undone: Undone


@dataclass(frozen=True)
class _Trial:
    """Faults that were undone one after the other, and what came of it."""

    faults: tuple[Fault, ...]
    undone: Undone
    size: float  # the misfit that is left

    @property
    def freedom(self) -> int:
        return sum(fault.freedom for fault in self.faults)


def explained(problem: Problem, samples: Samples, base: float, *, gross: bool = True) -> Cause | None:
    """The simplest that makes a misfit vanish: one suspected fault, else two together; None where none does.

    problem: with one instrument. samples: its rows, some hundred. base: their misfit as they are. gross: whether it is
    so large that two mistakes at once are looked for.
    """
    tried = _looked_at_closely(list(_tried(problem, samples)))
    best = _simplest(tried)
    if best is None:
        return None
    if best.size > max(BETTER * base, SUSPICIOUS) and gross:
        pairs = _pairs(tried, problem)
        both = _simplest(pairs)
        if both is not None and both.size < min(BETTER * min(best.size, base), EXPLAINED):
            return _told(both, base, pairs)
    return _told(best, base, tried) if best.size <= max(min(BETTER * base, EXPLAINED), CHANCE) else None


def _tried(problem: Problem, samples: Samples) -> Iterator[_Trial]:
    for fault in chain(columns_and_joints(problem), parts_of_the_cell(problem, samples)):
        yield from _one(fault, _Trial((), Undone(problem, samples), 0.0))


def _one(fault: Fault, before: _Trial) -> Iterator[_Trial]:
    """What is left with a fault undone on top of others; nothing where it cannot be."""
    try:
        undone = fault.undo(before.undone.problem, before.undone.samples)
    except CasacalError:  # such as a tool of an instrument that holds it
        return
    undone = replace(undone, found=before.undone.found + undone.found)
    yield _Trial((*before.faults, fault), undone, _left(undone, FIRST_STEPS))


def _looked_at_closely(tried: list[_Trial]) -> list[_Trial]:
    """The same trials, the most promising of them fitted to the end."""
    closer = {id(trial) for trial in sorted(tried, key=lambda trial: trial.size)[:PROMISING]}
    return [replace(trial, size=_left(trial.undone, STEPS)) if id(trial) in closer else trial for trial in tried]


def _left(undone: Undone, steps: int) -> float:
    """The misfit that is left."""
    return misfit(undone.problem, undone.samples, steps=steps, start=undone.start)


def _pairs(tried: list[_Trial], problem: Problem) -> list[_Trial]:
    """Wrong units and signs of the dial, and what promises most, each with what is commonly done wrong beside it."""
    usual = {"unit of the joints", *(suspect.about for suspect in problem.instrument.suspects)}
    best = sorted(tried, key=lambda trial: trial.size)
    first = [trial for k, trial in enumerate(best) if k < PAIRED or trial.faults[0].about in usual]
    found: list[_Trial] = []
    for trial in first:
        for fault in chain(columns_and_joints(problem), parts_of_the_cell(problem, trial.undone.samples)):
            if fault.about != trial.faults[0].about and fault.common:
                found += _one(fault, trial)
    return _looked_at_closely(found)


def _simplest(tried: list[_Trial]) -> _Trial | None:
    """Of those that explain about as well as the best, the one of least freedom, then the first."""
    if not tried:
        return None
    least = min(trial.size for trial in tried)
    return min((trial for trial in tried if trial.size <= ALIKE * least), key=lambda trial: trial.freedom)


def _told(best: _Trial, base: float, tried: list[_Trial]) -> Cause:
    names = " and ".join(fault.about for fault in best.faults)
    others = [" and ".join(fault.about for fault in trial.faults) for trial in tried if trial.size <= ALIKE * best.size]
    rivals = [name for name in dict.fromkeys(others) if set(name.split(" and ")) != set(names.split(" and "))][:RIVALS]
    also = f"; {', '.join(rivals)} would explain it equally well" if rivals else ""
    causes = " and ".join(fault.cause for fault in best.faults)
    undone = "with that undone" if len(best.faults) == 1 else "with both undone"
    cause = (
        f"{causes}{best.undone.found}: {undone}, the misfit falls from {times(base)} to {times(best.size)} times the "
        f"stated noise{also}"
    )
    return Cause(Finding("error", names, cause, ". ".join(fault.fix for fault in best.faults)), best.undone)

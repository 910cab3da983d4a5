"""The cause of a misfit, found by undoing what people do wrong: one thing if that suffices, else two."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from casacal.binding.bound_problem import bind
from casacal.checks.faults import suspected
from casacal.checks.finding import FIRST_STEPS, STEPS, Fault, Finding, Undone, misfit
from casacal.checks.fitted_faults import alike_numbers, tool_keys
from casacal.checks.numbers import TOOL
from casacal.errors import CasacalError
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.wording import times

SUSPICIOUS = 2.0  # misfit, in stated standard deviations, above which something systematic is looked for
BETTER = 0.25  # an undone fault must shrink the misfit to this part to be believed
EXPLAINED = 50.0  # misfit that noise and effects leave at most; what leaves more explains nothing
CHANCE = 1.3  # a misfit of this size is chance: whatever leaves no more explains it all
ALIKE = 1.5  # within this factor a fault and its absence cannot be told apart
PROMISING = 12  # faults, or pairs of them, that a first look finds best and that are fitted to the end
PAIRED = 3  # single faults, beside the usual ones, that are tried together with others
RIVALS = 3  # faults that would explain it equally well and are named


@dataclass(frozen=True)
class MisfitCause:
    """What explains a misfit, as a finding, and problem and samples without it."""

    finding: Finding
    undone: Undone


@dataclass(frozen=True)
class _Attempt:
    """Faults that were undone one after the other, and what came of it."""

    faults: tuple[Fault, ...]
    undone: Undone
    size: float  # the misfit that is left

    @property
    def freedom(self) -> int:
        return sum(fault.freedom for fault in self.faults)


def explained(problem: Problem, samples: Samples, base: float, *, gross: bool = True) -> MisfitCause | None:
    """The simplest that makes a misfit vanish: one suspected fault, else two together; None where none does.

    problem: with one instrument. samples: its rows, some hundred. base: their misfit as they are. gross: whether it is
    so large that two mistakes at once are looked for.
    """
    nothing = _Attempt((), Undone(problem, samples), 0.0)
    tried = _looked_at_closely([each for fault in suspected(problem, samples) for each in _one(fault, nothing)])
    best = _simplest(tried)
    if best is None:
        return None
    if best.size > max(min(BETTER * base, EXPLAINED), SUSPICIOUS) and gross:
        pairs = _pairs(tried, problem)
        both = _simplest(pairs)
        if both is not None and both.size < min(BETTER * min(best.size, base), EXPLAINED):
            return _told(both, base, pairs, [])
    tool = [fault.about for fault in best.faults] == [TOOL]
    alike = alike_numbers(bind(problem, samples), tool_keys(problem)) if tool else ()
    return (
        _told(best, base, tried, [f"{name} elsewhere" for name in alike])
        if best.size <= max(min(BETTER * base, EXPLAINED), CHANCE)
        else None
    )


def _one(fault: Fault, before: _Attempt) -> Iterator[_Attempt]:
    """What is left with a fault undone on top of others; nothing where it cannot be."""
    try:
        undone = fault.undo(before.undone.problem, before.undone.samples)
    except CasacalError:  # such as a tool of an instrument that holds it
        return
    undone = replace(undone, found=before.undone.found + undone.found)
    yield _Attempt((*before.faults, fault), undone, _left(undone, FIRST_STEPS))


def _looked_at_closely(tried: list[_Attempt]) -> list[_Attempt]:
    """The same trials, the most promising of them fitted to the end; no other explains anything."""
    closer = {id(trial) for trial in sorted(tried, key=lambda trial: trial.size)[:PROMISING]}
    return [_to_the_end(trial) if id(trial) in closer else replace(trial, size=math.inf) for trial in tried]


def _to_the_end(trial: _Attempt) -> _Attempt:
    """The same trial with its final misfit: infinite where joints mixed up among the rows would fit about as well."""
    size = _left(trial.undone, STEPS)
    if size > EXPLAINED:
        return replace(trial, size=size)
    samples = trial.undone.samples
    mixed = replace(samples, joints=np.random.default_rng(0).permuted(samples.joints, axis=0))
    says_nothing = misfit(trial.undone.problem, mixed, start=trial.undone.start) * BETTER < max(size, SUSPICIOUS)
    return replace(trial, size=math.inf if says_nothing else size)


def _left(undone: Undone, steps: int) -> float:
    """The misfit that is left."""
    return misfit(undone.problem, undone.samples, steps=steps, start=undone.start)


def _pairs(tried: list[_Attempt], problem: Problem) -> list[_Attempt]:
    """Wrong units and signs of the dial, and what promises most, each with what is commonly done wrong beside it."""
    usual = {"unit of the joints", *(suspect.about for suspect in problem.instrument.suspects)}
    best = sorted(tried, key=lambda trial: trial.size)
    first = [trial for k, trial in enumerate(best) if k < PAIRED or trial.faults[0].about in usual]
    found: list[_Attempt] = []
    for trial in first:
        for fault in suspected(trial.undone.problem, trial.undone.samples):
            if fault.about != trial.faults[0].about and fault.common:
                found += _one(fault, trial)
    return _looked_at_closely(found)


def _simplest(tried: list[_Attempt]) -> _Attempt | None:
    """Of those that explain about as well as the best, the one of least freedom, then the first."""
    least = min((trial.size for trial in tried), default=math.inf)
    if least == math.inf:
        return None
    return min((trial for trial in tried if trial.size <= ALIKE * least), key=lambda trial: trial.freedom)


def _told(best: _Attempt, base: float, tried: list[_Attempt], alike: list[str]) -> MisfitCause:
    """The cause in words; `alike`: what rows cannot tell from it, beside what was tried."""
    names = " and ".join(fault.about for fault in best.faults)
    others = [" and ".join(fault.about for fault in trial.faults) for trial in tried if trial.size <= ALIKE * best.size]
    rivals = [name for name in dict.fromkeys(others) if set(name.split(" and ")) != set(names.split(" and "))][:RIVALS]
    rivals = [*dict.fromkeys([*alike, *rivals])]
    also = f"; {', '.join(rivals)} would explain it equally well" if rivals else ""
    causes = " and ".join(fault.cause for fault in best.faults)
    undone = "with that undone" if len(best.faults) == 1 else "with both undone"
    cause = (
        f"{causes}{best.undone.found}: {undone}, the misfit falls from {times(base)} to {times(best.size)} times the "
        f"stated noise{also}"
    )
    fix = ". ".join(fault.fix for fault in best.faults) + ("" if rivals else best.undone.offer)
    return MisfitCause(Finding("error", names, cause, fix), best.undone)

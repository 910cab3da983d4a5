"""The cause of a misfit: each suspected fault is undone, alone or with another; the simplest that explains it counts.

A fit of every fault takes seconds, and where a joint is counted the wrong way it ends anywhere. How far rows lie from
the arm as drawn, before any fit, tells most of them apart: by tenths of a millimetre where the fault is undone, by
hundreds of millimetres where it is not. So only what brings rows near the drawn arm is fitted, where anything does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from casacal.calibration.before_fit import OUT_OF_LIMITS, OUTSIDE, WRONG_SIGN, outside
from casacal.calibration.conventions import patterns
from casacal.calibration.faults import (
    ALIKE,
    EXPLAINED,
    MOST_PAIRED,
    SUSPICIOUS,
    OfRows,
    hanging,
    pairings,
    some_radians,
    suspected,
)
from casacal.calibration.finding import FIRST_STEPS, KEPT, Fault, Finding, Undone, misfit
from casacal.calibration.numbers import TOOL, alike_numbers, tool_keys
from casacal.calibration.set_aside import robust_fit, studentised_outliers
from casacal.data.samples import Samples
from casacal.errors import CasacalError, ProblemError
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.nominal import nominal_sight, proposed_by, row_columns
from casacal.fit.slots import instances, nominals, proposed
from casacal.model.problem import Problem
from casacal.uncertainty.moves import prior_scatter
from casacal.values import Array, Rows
from casacal.wording import times

FEW_OFF, MOSTLY = 3, 0.5  # rows, and part of those from the first on, that lie off where readings slipped
BETTER = 0.25  # an undone fault must shrink the misfit to this part to be believed
DENSER = 0.5  # likewise of readings that it makes smaller, in the unit in which they came
CHANCE = 1.3  # a misfit of this size is chance: whatever leaves no more explains it all
PROMISING = 12  # faults, or pairs of them, that a first look finds best and that are fitted to the end
NEAR, FAR = 3.0, 10.0  # times the scatter of arms as drawn that rows may have: with the cause undone, and ever
OF_BASE = 0.2  # part of the scatter of the rows as they are, up to which a pair of faults is fitted however it scatters
PAIRED = 3  # single faults, beside the usual ones, that are tried together with others
RIVALS = 3  # faults that would explain it equally well and are named


@dataclass(frozen=True)
class MisfitCause:
    """Cause of a misfit as a finding, and problem and samples with it undone."""

    finding: Finding
    undone: Undone


@dataclass(frozen=True)
class _Attempt:
    """Faults that were undone one after the other, and what came of it."""

    faults: tuple[Fault, ...]
    undone: Undone
    size: float  # the misfit that is left
    base: float = math.inf  # that of the rows as they came, infinite where the instrument cannot read so
    shrunk: float = 1.0  # part that undone readings have of the scatter of those that came, one at most

    @property
    def freedom(self) -> int:
        return sum(fault.freedom for fault in self.faults)


def explained(
    problem: Problem, samples: Samples, base: float, *, gross: bool = True, whole: Samples | None = None
) -> MisfitCause | None:
    """The simplest cause of a misfit: one suspected fault, else two together; None where none explains it.

    problem: with one instrument. samples: its rows, some hundred. base: their misfit as they are. gross: whether it is
    so large that two mistakes at once are looked for. whole: all rows in their order, where samples are some of them.
    """
    impossible = any(
        each.severity == "error" and each.about in (OUTSIDE, OUT_OF_LIMITS) for each in outside(problem, samples)
    )
    nothing = _Attempt((), Undone(problem, samples), base, math.inf if impossible else base)
    whole = samples if whole is None or len(whole) > MOST_PAIRED else whole
    faults = [*chain(suspected(problem, samples), pairings(whole), some_radians(problem, whole))]
    drawn = bind(problem, samples)
    usual, off = prior_scatter(drawn, flat_counts=True).rms, _trimmed(drawn.plain_residual(drawn.x0))
    near, most = NEAR * usual, max(FAR * usual, OF_BASE * off)
    at_once = [fault for fault in faults if isinstance(fault.undo, OfRows)]
    tried = _looked_at_closely(plain := _singles(at_once, nothing, near, most))
    makers: list[_Attempt] | None = None
    if base > EXPLAINED:  # more than any arm errs: what then leaves no more than chance is the cause
        if (best := _simplest(tried)) is not None and best.size <= CHANCE:
            return _misfit_cause(best, base, tried, [])
        if gross:
            makers = _of_makers(nothing)
            if (best := _simplest(makers)) is not None and best.size <= CHANCE:
                return _misfit_cause(best, base, makers, [])
    sought = _singles([fault for fault in faults if not isinstance(fault.undo, OfRows)], nothing, near, most)
    tried = _looked_at_closely([*plain, *sought])
    best = _simplest(tried)
    left = math.inf if best is None else best.size
    if left > max(min(BETTER * base, EXPLAINED), SUSPICIOUS) and gross:
        makers = _of_makers(nothing) if makers is None else makers
        maker = _simplest(makers)
        if maker is not None and maker.size < min(BETTER * min(left, base), EXPLAINED):
            return _misfit_cause(maker, base, makers, [])
        pairs = _pairs(tried, problem, most)
        both = _simplest(pairs)
        if both is not None and both.size < min(BETTER * min(left, base), EXPLAINED):
            return _misfit_cause(both, base, pairs, [])
    if best is None or left > max(min(BETTER * base, EXPLAINED), CHANCE):
        return None
    tool = [fault.about for fault in best.faults] == [TOOL]
    alike = alike_numbers(bind(problem, samples), tool_keys(problem)) if tool else ()
    return _misfit_cause(best, base, tried, [f"{name} elsewhere" for name in alike])


def cause_of_rows(problem: Problem, samples: Samples, off: Rows) -> Finding | None:
    """What rows that lie off (N,) have in common: a slip by a row, a unit, a joint that hangs, or the dial's sign."""
    tail = off.sum() >= FEW_OFF and off[int(np.argmax(off)) :].mean() >= MOSTLY
    nothing = _Attempt((), Undone(problem, samples), math.inf)
    signs = (fault for fault in suspected(problem, samples) if fault.about == WRONG_SIGN)
    rows = chain(some_radians(problem, samples), hanging(samples), signs) if off.any() else ()
    for fault in chain(pairings(samples) if tail else (), rows):
        for tried in _one(fault, nothing):
            fitted = robust_fit(bind(problem, tried.undone.samples))
            if tried.size <= SUSPICIOUS and (fitted is None or not studentised_outliers(*fitted).rows):
                cause = f"{fault.cause}{tried.undone.found}: with that undone, no row lies off any more"
                return Finding("error", fault.about, cause, fault.fix)
    return None


def _undone(fault: Fault, before: _Attempt) -> Iterator[_Attempt]:
    """The attempt with one more fault undone, not fitted yet; nothing where it cannot be undone."""
    try:
        undone = fault.undo(before.undone.problem, before.undone.samples)
    except CasacalError:  # such as a tool of an instrument that holds it
        return
    shrunk = before.shrunk * _shrunk(before.undone.samples, undone.samples)
    undone = replace(undone, found=before.undone.found + undone.found)
    yield _Attempt((*before.faults, fault), undone, math.inf, before.base, shrunk)


def _shrunk(before: Samples, after: Samples) -> float:
    """The least part, one at most, that readings of a column have of the scatter that they had before a change."""
    stds = ((float(np.std(values)), float(np.std(after.columns[name]))) for name, values in before.columns.items())
    return min((new / old for old, new in stds if 0 < new < old), default=1.0)


def _fitted(trial: _Attempt) -> _Attempt:
    """An attempt with the misfit of a first look."""
    undone = trial.undone
    return replace(trial, size=misfit(undone.problem, undone.samples, steps=FIRST_STEPS, start=undone.start))


def _one(fault: Fault, before: _Attempt) -> Iterator[_Attempt]:
    """The attempt with one more fault undone; nothing where it cannot be undone."""
    yield from map(_fitted, _undone(fault, before))


def _of_makers(nothing: _Attempt) -> list[_Attempt]:
    """Joint conventions of makers, each fitted to the end."""
    faults = patterns(nothing.undone.problem, nothing.undone.samples)
    return [_to_the_end(each) for fault in faults for each in _one(fault, nothing)]


def _singles(faults: Sequence[Fault], nothing: _Attempt, near: float, most: float) -> list[_Attempt]:
    """Every fault undone and fitted; where rows are `near` the drawn arm, or one brings them there, none beyond `most`.

    near, most: RMS residuals about the drawn arm, in the unit of the rows.
    """
    trials = [each for fault in faults for each in _undone(fault, nothing)]
    as_they_are, *off = _off_the_drawing([nothing, *trials], nothing)
    found = np.nanmin([as_they_are, *off, math.inf]) < near
    return [trial if found and far > most else _fitted(trial) for trial, far in zip(trials, off, strict=True)]


def _off_the_drawing(trials: Sequence[_Attempt], before: _Attempt) -> list[float]:
    """RMS residual of each trial about the drawn arm, largest tenth left out; NaN where more than numbers change.

    In the unit of the rows, mm as a rule. A fit takes several times as long, and of an arm with a joint counted the
    wrong way it ends anywhere.
    """
    problem, samples = before.undone.problem, before.undone.samples
    try:
        bound = bind(problem, samples)
    except CasacalError:
        return [math.nan] * len(trials)

    def off(undone: Undone) -> float:
        rows = undone.samples
        alike = undone.problem is problem and len(rows) == len(samples) and not problem.terms
        if not alike or any(rows.labels[name] is not labels for name, labels in samples.labels.items()):
            return math.nan
        try:
            return _trimmed(residuals_as_drawn(bound, rows))
        except CasacalError:
            return math.nan

    return [off(trial.undone) for trial in trials]


def residuals_as_drawn(bound: BoundProblem, samples: Samples) -> Array:
    """Residuals (N, m) in their own unit at the nominal, of other rows with the same labels, of one instrument.

    What has no nominal is proposed by these rows. A third of the work of binding them. Raises ProblemError where they,
    or the instrument, propose nothing.
    """
    problem, block, instrument = bound.problem, bound.block, bound.problem.instrument
    sight, slots = nominal_sight(problem, 0, samples), {slot.name: slot for slot in bound.slots}
    for key, unknown in instrument.unknowns.items():
        for label, rows in instances(instrument, key, unknown, samples) if unknown.nominal is None else ():
            nominal = proposed(instrument, key, unknown, sight.of(rows))
            if nominal is None:
                raise ProblemError(f"'{key}' has no nominal value", "Give it one")
            name = key if label is None else f"{key}.{label}"
            slots[name] = replace(slots[name], nominal=nominal)
    columns = row_columns(problem, 0, samples, None, proposed_by(problem, 0, nominals([*slots.values()])))
    held = set(block.model.constants)
    constants = [[slots[slot.name].nominal for slot in row if slot.key in held] for row in block.slots]
    packed = np.array([np.concatenate([np.zeros(0), *row]) for row in constants]).reshape(block.constants.shape)
    other = replace(block, samples=samples, constants=packed, row_columns=tuple(columns.values()))
    return other.at_nominal(block.model.columnwise("residual"))


def _trimmed(residual: Array) -> float:
    """Root mean square of residuals, the largest tenth left out."""
    squares = np.sort(np.ravel(residual) ** 2)[: math.ceil(KEPT * residual.size)]
    return math.sqrt(float(squares.mean()))


def _looked_at_closely(tried: list[_Attempt]) -> list[_Attempt]:
    """The trials with the most promising ones fitted to the end, and the misfit of all others infinite."""
    finite = [trial for trial in tried if trial.size < math.inf]
    closer = {id(trial) for trial in sorted(finite, key=lambda trial: trial.size)[:PROMISING]}
    return [_to_the_end(trial) if id(trial) in closer else replace(trial, size=math.inf) for trial in tried]


def _to_the_end(trial: _Attempt) -> _Attempt:
    """A trial with its final misfit: infinite where it says nothing.

    So where shuffled joint values would fit about as well, and where only smaller numbers fit better: readings that are
    divided by 25.4 carry a 25th of the noise that they came with, and their density has that factor in it.
    """
    undone, samples = trial.undone, trial.undone.samples
    size = misfit(undone.problem, samples, start=undone.start)
    if size > EXPLAINED:
        return replace(trial, size=size)
    mixed = replace(samples, joints=np.random.default_rng(0).permuted(samples.joints, axis=0))
    says_nothing = misfit(undone.problem, mixed, start=undone.start) * BETTER < max(size, SUSPICIOUS)
    says_nothing |= size / trial.shrunk > DENSER * trial.base
    return replace(trial, size=math.inf if says_nothing else size)


def _pairs(tried: list[_Attempt], problem: Problem, most: float) -> list[_Attempt]:
    """Pairs of faults: wrong units and signs, and the most promising ones, each with every common fault.

    Those whose rows lie farther off the drawn arm than `most`, mm, are not fitted.
    """
    usual = {"unit of the joints", *(suspect.about for suspect in problem.instrument.suspects)}
    best = sorted(tried, key=lambda trial: trial.size)
    first = [trial for k, trial in enumerate(best) if k < PAIRED or trial.faults[0].about in usual]
    found: list[_Attempt] = []
    for trial in first:
        others = suspected(trial.undone.problem, trial.undone.samples)
        common = (fault for fault in others if fault.common and fault.about != trial.faults[0].about)
        both = [each for fault in common for each in _undone(fault, trial)]
        off = _off_the_drawing(both, trial)
        found += [_fitted(each) for each, far in zip(both, off, strict=True) if not far > most]
    return _looked_at_closely(found)


def _simplest(tried: list[_Attempt]) -> _Attempt | None:
    """The trial of least freedom among those that explain about as well as the best; ties go to the first."""
    least = min((trial.size for trial in tried), default=math.inf)
    if least == math.inf:
        return None
    return min((trial for trial in tried if trial.size <= ALIKE * least), key=lambda trial: trial.freedom)


def _misfit_cause(best: _Attempt, base: float, tried: list[_Attempt], alike: list[str]) -> MisfitCause:
    """The best attempt as a cause; `alike`: further causes that the rows cannot tell from it."""
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

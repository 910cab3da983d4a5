"""The cause of a misfit: each suspected fault is undone, alone or with another; the simplest that explains it counts.

A fit of every fault takes seconds, and where a joint is counted the wrong way it ends anywhere. How far rows lie from
the arm as drawn tells most faults apart before any fit: by tenths of a millimetre where the fault is undone, by
hundreds where it is not. So only what brings rows near the drawn arm is fitted, where anything does.

What fits up to some line alone, as with labels exchanged from there on, no mistake made in all rows explains.
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
    MOST_PAIRED,
    OfRows,
    at_an_end,
    exchanged_labels,
    exchanges,
    hanging,
    pairings,
    some_radians,
    suspected,
)
from casacal.calibration.finding import ALIKE, EXPLAINED, SUSPICIOUS, Fault, Finding, Undone, kept_square, misfit
from casacal.calibration.numbers import TOOL, alike_numbers, tool_keys
from casacal.calibration.set_aside import robust_fit, studentised_outliers
from casacal.data.samples import Samples, joined
from casacal.errors import CasacalError, ProblemError
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.lm import lm
from casacal.fit.nominal import nominal_sight, proposed_by, row_columns
from casacal.fit.slots import instances, nominals, proposed
from casacal.model.problem import Problem
from casacal.uncertainty.figures import effective_unknowns
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
SOMETHING = "something changed"
FEWEST = 20  # rows that must fit by themselves; fewer fit to anything
FEW_LEFT = 5  # rows beyond the line; fewer are single rows
UNEXPECTED = 25.0  # chi-square of a row that those before it do not expect: five standard deviations
LEFT_OVER = 5.0  # rows beyond what their fit needs that the good ones must have
FAR_OFF = 5.0  # standard deviations by which most of the others must lie off
TRIMMED = 0.85  # part of the rows that a robust fit takes for good which surely are: it bears a tenth of others


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
    beyond = {each.about for each in outside(problem, samples) if each.severity == "error"}
    impossible = not beyond.isdisjoint((OUTSIDE, OUT_OF_LIMITS))
    nothing = _Attempt((), Undone(problem, samples), base, math.inf if impossible else base)
    whole = samples if whole is None or len(whole) > MOST_PAIRED else whole
    faults = [*chain(suspected(problem, samples), pairings(whole), some_radians(problem, whole))]
    drawn = bind(problem, samples)
    usual, off = prior_scatter(drawn, flat_counts=True).rms, math.sqrt(kept_square(drawn.plain_residual(drawn.x0)))
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
    exchanged = exchanges(samples, off)
    alone = some_radians(problem, samples), hanging(samples), at_an_end(problem, samples), exchanged, signs
    rows = chain(*alone) if off.any() else ()
    for fault in chain(pairings(samples) if tail else (), rows):
        for tried in map(_fitted, _undone(fault, nothing)):
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
    old, new = before.undone.samples.columns, undone.samples.columns
    stds = ((float(np.std(values)), float(np.std(new[name]))) for name, values in old.items())
    shrunk = before.shrunk * min((after / was for was, after in stds if 0 < after < was), default=1.0)
    undone = replace(undone, found=before.undone.found + undone.found)
    yield _Attempt((*before.faults, fault), undone, math.inf, before.base, shrunk)


def _fitted(trial: _Attempt) -> _Attempt:
    """An attempt with the misfit of a first look."""
    undone = trial.undone
    return replace(trial, size=misfit(undone.problem, undone.samples, first=True, start=undone.start))


def _of_makers(nothing: _Attempt) -> list[_Attempt]:
    """Joint conventions of makers, each fitted to the end."""
    faults = patterns(nothing.undone.problem, nothing.undone.samples)
    return [_to_the_end(each) for fault in faults for each in map(_fitted, _undone(fault, nothing))]


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
            return math.sqrt(kept_square(residuals_as_drawn(bound, rows)))
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
            if (nominal := proposed(instrument, key, unknown, sight.of(rows))) is None:
                raise ProblemError(f"'{key}' has no nominal value", "Give it one")
            name = key if label is None else f"{key}.{label}"
            slots[name] = replace(slots[name], nominal=nominal)
    columns = row_columns(problem, 0, samples, None, proposed_by(problem, 0, nominals([*slots.values()])))
    held = set(block.model.constants)
    constants = [[slots[slot.name].nominal for slot in row if slot.key in held] for row in block.slots]
    packed = np.array([np.concatenate([np.zeros(0), *row]) for row in constants]).reshape(block.constants.shape)
    other = replace(block, samples=samples, constants=packed, row_columns=tuple(columns.values()))
    return other.at_nominal(block.model.columnwise("residual"))


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
    """Wrong units and signs, and what is most promising, each with every common fault of rows within `most`, mm."""
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
    falls = f"the misfit falls from {times(base)} to {times(best.size)} times the stated noise"
    cause = f"{causes}{best.undone.found}: {undone}, {falls}{also}"
    fix = ". ".join(fault.fix for fault in best.faults) + ("" if rivals else best.undone.offer)
    return MisfitCause(Finding("error", names, cause, fix), best.undone)


def changed_midway(problem: Problem, samples: Samples) -> Finding | None:
    """An error where rows on one side of a line fit by themselves and the others do not fit to them; else None."""
    count = len(samples)
    for backwards in (False, True):
        rows = samples.take(range(count)[:: -1 if backwards else 1])
        place = _first_unexpected(problem, rows)
        if place is None or count - place < FEW_LEFT:
            continue
        good, rest = (samples.take(range(place)), samples.take(range(place, count)))
        if backwards:
            good, rest = samples.take(range(count - place, count)), samples.take(range(count - place))
        if not _surprising(problem, good, rest):
            continue
        line = rest.lines[-1 if backwards else 0]
        where = f"up to line {line}" if backwards else f"from line {line} on"
        base = misfit(problem, rest)
        if (named := exchanged_labels(problem, good, rest)) is not None:
            about, cause, fix = named
        elif base > SUSPICIOUS and (own := explained(problem, rest, base, whole=rest)) is not None:
            about, cause, fix = own.finding.about, own.finding.cause, f"Mend these rows alone: {own.finding.fix}"
        else:
            about, cause = SOMETHING, "they fit by themselves too, but not to the others"
            if base > SUSPICIOUS:
                cause = f"they do not fit ({times(base)} times the stated noise by themselves)"
            fix = "Find out what was changed there: arm, base, tool, dial, faces or the recording; "
            fix += "measure those rows again"
        alone = "the later lines fit by themselves" if backwards else "the lines before fit by themselves"
        return Finding("error", f"{about} {where}", f"{alone}, and {where} {cause}", fix)
    return None


def _first_unexpected(problem: Problem, samples: Samples) -> int | None:
    """How many rows fit before the first that those before it do not expect; None where too few do."""
    fits, fails = FEWEST, len(samples)
    if fits >= fails or misfit(problem, samples.take(range(fits))) > SUSPICIOUS:
        return None
    while fails - fits > 1:
        middle = (fits + fails) // 2
        good = misfit(problem, samples.take(range(middle))) <= SUSPICIOUS
        fits, fails = (middle, fails) if good else (fits, middle)
    before = math.inf
    for place in range(max(FEWEST, int(TRIMMED * fits)), fails + 1):
        try:
            found = lm(bind(problem, samples.take(range(place))))
        except CasacalError:  # a face of too few rows so far
            continue
        if 2 * (found.cost - before) > UNEXPECTED * max(2 * before / place, 1.0):
            return place - 1
        before = found.cost
    return fits


def _surprising(problem: Problem, good: Samples, rest: Samples) -> bool:
    """Whether good rows, more than their fit needs, do not expect most of the others by far.

    Where the model is wrong everywhere, or the noise is, the first rows fit as well, if they are few.
    """
    whole = bind(problem, joined(good, rest))
    part, later = whole.take(range(len(good))), whole.take(range(len(good), len(whole.measured)))
    found = lm(part)
    if not found.converged or part.rows - effective_unknowns(part, found.x) < LEFT_OVER:
        return False
    jacobian, covariance = later.jacobian(found.x), found.covariance
    known = np.isfinite(np.diagonal(covariance))  # but for faces that the good rows do not show
    spread = np.einsum("ij,jk,ik->i", jacobian[:, known], covariance[np.ix_(known, known)], jacobian[:, known])
    told = (jacobian[:, ~known] == 0).all(axis=1)
    off = np.abs(later.residual(found.x)[told]) / np.sqrt(1 + spread[told])
    return bool(off.size) and float(np.median(off)) > FAR_OFF


def labels_exchanged(problem: Problem, samples: Samples, moved: Samples) -> Finding | None:
    """An error where faces only seem to have moved, as two labels were exchanged from some row on; else None.

    moved: the rows with the faces named otherwise from there on.
    """
    column = problem.instrument.groups
    later = np.flatnonzero(moved.faces(column).codes >= len(samples.faces(column).names))
    if not later.size:
        return None
    good, rest = samples.take(range(int(later[0]))), samples.take(range(int(later[0]), len(samples)))
    if (named := exchanged_labels(problem, good, rest)) is None:
        return None
    about, cause, fix = named
    where = f"from line {rest.lines[0]} on"
    return Finding("error", f"{about} {where}", f"{where} {cause}", fix)

"""An earlier result as the prior of a calibration: all that it knows, with its covariance, and what may have moved."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casacal.calibration.as_arm import AsArm
from casacal.calibration.finding import Finding
from casacal.calibration.fresh import Opened, fresh_among, fresh_rows, same_arm, with_memory
from casacal.calibration.motion import Tried
from casacal.calibration.saved import arm_from
from casacal.data.samples import Samples
from casacal.deployment.arm import CalibratedArm
from casacal.deployment.result import MirrorImage, Verdict
from casacal.effects.effect import effects_of
from casacal.effects.selection import in_sample_gains
from casacal.errors import CasacalError, RefusedResultError
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Result
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.uncertainty.fresh_rows import chance
from casacal.values import FrozenMapping, Value, as_given


@dataclass(frozen=True, eq=False)
class EarlierResult(Value):
    """The earlier result that is the prior of a calibration.

    file, sha256: the result. verdict: its own. expected_mm: the tip error that it expected. noise_freedom: degrees of
    freedom of the noise that it found, infinite where it was stated. standing: what had not moved since. loosened: what
    may have, by name: its standard deviation, None for anywhere. corrected: keys of the effects that it corrects.
    fitted_rows: those that it was calibrated from. left_out: lines of rows among them that came again.
    mirror_image: that it could not exclude.
    """

    file: str
    sha256: str
    verdict: Verdict
    expected_mm: float
    noise_freedom: float
    standing: tuple[str, ...]
    loosened: Mapping[str, float | None]
    corrected: tuple[str, ...]
    fitted_rows: Mapping[str, Any] | None
    left_out: tuple[int, ...]
    mirror_image: MirrorImage | None

    def __post_init__(self) -> None:
        object.__setattr__(self, "loosened", FrozenMapping(self.loosened))

    def chance_of(self, found: Result) -> float:
        """Chance of rows that lie so far from what it expects of them, where nothing but `loosened` has changed.

        Twice the cost at the minimum, over the rows and what is known beforehand, is chi-square.
        """
        fit = found.problem
        return chance(2 * found.cost, fit.rows + len(fit.prior_rows) - fit.unknowns, self.noise_freedom)

    def tried(self, fit: BoundProblem, found: Result) -> tuple[Tried, ...]:
        """Effects that were corrected stay so: few new rows could hardly ask again."""
        known = {each.key: each for each in effects_of(fit.problem) if each.key in fit.beside and each.moves}
        gains = in_sample_gains(fit, found.x, known)
        return tuple(
            Tried(key, each.words, gains[key], {}, key in self.corrected, each.further) for key, each in known.items()
        )


@dataclass(frozen=True, eq=False)
class RowsSince:
    """An earlier result, opened for rows of some problem."""

    opened: Opened
    result: EarlierResult

    def bound(
        self,
        samples: Samples,
        *,
        set_aside: bool,
        noise: bool,
        kit: bool,
        backend: str | None,
        threads: int | None,
    ) -> tuple[BoundProblem, BoundProblem, tuple[Finding, ...]]:
        """Rows under all that the earlier result knows, under the geometry alone, and what is wrong with some.

        With its effects beside the geometry, of their sizes (`kit`), and with the noise that it found (`noise`).
        backend, threads: as for `bind`. Raises CasacalError for what cannot be loosened, or stand; SamplesError for too
        few rows.
        """
        case, standing = self.opened, self.result.standing
        fresh = fresh_rows(
            case.arm,
            case.source.problem,
            samples,
            other=case.other,
            standing=standing,
            backend=backend,
            threads=threads,
        )
        fresh = with_memory(fresh, case.arm).loosened(self.result.loosened)
        if fresh.lost.any():
            name = fresh.gaussian.names[int(np.flatnonzero(fresh.lost)[0])]
            what = f"{case.arm.file}: it leaves '{name}' without bound, so it is no prior"
            raise CasacalError(what, "Calibrate again with old and new rows")
        bound, samples, aside = fresh.bound, fresh.bound.block.samples, tuple[Finding, ...]()
        off = fresh.linear.gross() if set_aside else ()  # what neither the earlier result nor the other rows expect
        if rows := sorted({int(k) // (bound.rows // len(samples)) for k in off if k < bound.rows}):
            cause = "these rows are not where the earlier result and the other rows expect them"
            fix = "Measure there again, or keep them with --keep-outliers"
            aside = (Finding("error", "outliers", cause, fix, tuple(samples.lines[k] for k in rows)),)
            bound = bound.take(np.setdiff1d(np.arange(len(samples)), rows))
        fit = bound.with_known(fresh.gaussian)
        fit = fit if noise else fit.with_noise()
        bare = fit.under(fit.problem.without_terms)
        return (fit if kit else bare), bare, aside


def earlier(
    result: AsArm | CalibratedArm | str | Path,
    source: ProblemFile,
    samples: Samples,
    *,
    loosen: Collection[str] | Mapping[str, float | None],
    standing: Collection[str],
) -> RowsSince:
    """Open an earlier result as the prior of some rows of a problem.

    Raises CasacalError for a result that is not to be used, that is no calibration, or of another arm; SamplesError
    where the rows are those that it was calibrated from.
    """
    for what, names in (("to loosen", loosen), ("of what has not moved", standing)):
        if isinstance(names, str) or not isinstance(names, Collection) or not all(isinstance(n, str) for n in names):
            given = f"the text '{names}'" if isinstance(names, str) else as_given(names)
            raise CasacalError(f"Got {given} as the list {what}", "Give names, such as ['joint3']")
    arm, robot = arm_from(result, "the earlier result"), source.problem.robot
    if (words := arm.denial) is not None:
        fix = "Mend what the verdict names, and calibrate again"
        raise RefusedResultError(f"{arm.file}: {words.removesuffix('.')}, so it is no prior", fix)
    if arm.found.method == "truth":
        raise CasacalError(f"{arm.file}: a true arm is not estimated, so it is no prior", "Give a calibration")
    if arm.source.problem.exact:  # no variance is left along them, and so no information that could be written
        what = f"{arm.file}: a result that keeps constraints exactly is no prior"
        raise CasacalError(what, "Calibrate with the old and the new rows together")
    if arm.found.data.instruments:
        what = f"{arm.file}: a result of several instruments is no prior of the rows of one"
        raise CasacalError(what, "Calibrate again with all rows")
    if not same_arm(arm.source.problem.robot, robot):
        what = f"{arm.file}: the arm of the problem ({robot.name}) is not the calibrated one"
        raise CasacalError(what, "Give the problem that it was calibrated with")
    other = type(source.problem.instrument) is not type(arm.source.problem.instrument)
    _refuse_other_unknowns(arm, source.problem, other=other)
    opened = fresh_among(arm, source, samples, other=other)
    found, said = arm.found, arm.found.verdict or Verdict("use with care", "It has no verdict.")
    requested = loosen if isinstance(loosen, Mapping) else dict.fromkeys(loosen)
    stds = {name.replace("joint ", "joint"): None if std == math.inf else std for name, std in requested.items()}
    seal, freedom = str((arm.document.get("seal") or {}).get("sha256", "")), opened.noise_freedom
    known = (found.tip.expected_mm, freedom, tuple(standing), stds, arm.corrected, found.data.fitted_rows)
    return RowsSince(opened, EarlierResult(arm.file, seal, said, *known, opened.fitted, found.mirror_image))


def _refuse_other_unknowns(arm: CalibratedArm, problem: Problem, *, other: bool) -> None:
    """Raise CasacalError where an unknown of the arm is free in one of the problems and held in the other.

    Of the instrument where it is held now: where it stood by the earlier result would be forgotten. One that is free
    now, such as a new tool, is fitted to these rows.
    """
    robots, instruments = [], []
    for each in (arm.source.problem, problem):
        robots.append({name for key, unknown in each.robot.parameters.items() for name in unknown.names(key)})
        own = ((key, unknown) for key, unknown in each.instrument.unknowns.items() if unknown.per is None)
        instruments.append({name for key, unknown in own for name in unknown.names(key)})
    # where an instrument that is held now stood would be forgotten; one that is free now is fitted to these rows
    lost = set() if other else instruments[0] - instruments[1]
    if differ := sorted((robots[0] ^ robots[1]) | lost):
        held = "the earlier calibration held" if differ[0] in robots[1] else "this problem holds"
        fix = "Give the problem that it was calibrated with, without other --fix or --free"
        raise CasacalError(f"{arm.file}: {held} '{differ[0]}', which is free in the other", fix)

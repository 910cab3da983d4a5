"""Fresh rows and the result that they are to be judged by, from any form in which people have them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casacal.calibration.fresh import Fresh, fresh_rows
from casacal.calibration.given import problem_from, samples_of
from casacal.calibration.saved import AsArm, arm_from
from casacal.compensation.arm import CalibratedArm
from casacal.compensation.seen_by import seen_by
from casacal.compensation.told import NOTHING, TellingColumns
from casacal.errors import CasacalError, SamplesError
from casacal.files import jsonable
from casacal.problem.problem import Problem
from casacal.problem.problem_file import ProblemFile
from casacal.robots.robot import Robot, random_joints
from casacal.samples.repeats import copies, fitted_among, in_fitted_postures
from casacal.samples.samples import Samples
from casacal.wording import counted, listed

SAME = 1e-6  # difference (mm; of a rotation's elements) of two poses below which arms are one
COMPARED = 8  # random joint values at which they are compared
SPENT = 0.5  # part of the rows that are those of the calibration, from which on they verify nothing


@dataclass(frozen=True)
class Judged:
    """Fresh rows and the calibration that they are held against.

    robot, result, verdict: which calibration, and what it said of itself (level and words; empty for a truth).
    samples, sha256, rows: which rows, and how many. own: unknowns that these rows alone know, fitted to them.
    standing: what was said to stand where it was calibrated. copied_lines, fitted_lines: rows that were left out:
    copies of others among them, and those that the arm was calibrated from. remarks: sentences on rows in
    postures that were fitted, and on columns that tell effects and are far from what they were in the fitted rows.
    """

    robot: str
    result: str
    verdict: tuple[str, str]
    samples: str
    sha256: str
    rows: int
    own: tuple[str, ...]
    standing: tuple[str, ...]
    copied_lines: tuple[int, ...]
    fitted_lines: tuple[int, ...]
    remarks: tuple[str, ...]

    @property
    def said(self) -> str:
        """The rows in a sentence."""
        return f"{counted(self.rows, 'fresh row')} of {self.samples}"

    @property
    def own_verdict(self) -> list[str]:
        """The result's own verdict as a sentence, where it is not simply calibrated; otherwise empty."""
        level, words = self.verdict
        return [] if level in ("", "calibrated") else [f"The result's own verdict: {words}"]

    def left_out(self, copied: str, fitted: str) -> list[str]:
        """Rows that do not count, a sentence for each reason: `copied`, `fitted`, with {} for the rows' file."""
        found = ((self.copied_lines, copied), (self.fitted_lines, fitted))
        return [f"{counted(len(lines))} {why.format(self.samples)}." for lines, why in found if lines]

    def fitted_words(self, names: str = "") -> str:
        """Clauses on the unknowns fitted to these rows and on what was assumed not to have moved."""
        own = f"{counted(len(self.own), 'unknown')} fitted to these rows{names}"
        still = f"; assumed not to have moved: {', '.join(self.standing)}" if self.standing else ""
        return (own if self.own else "nothing fitted to these rows") + still

    def document(self, first: Mapping[str, Any], found: Any, instead: Mapping[str, Any]) -> dict[str, Any]:
        """JSON document: entries of `first`, then the fields of `found`, those in `instead` replaced."""
        level, words = self.verdict
        rows = {each.name: getattr(self, each.name) for each in fields(self)}
        rows["verdict"] = {"level": level, "words": words} if level else None
        last = {name: rows.pop(name) for name in ("copied_lines", "fitted_lines", "remarks")}
        figures = {each.name: getattr(found, each.name) for each in fields(found) if each.name != "judged"}
        return dict(jsonable({**first, **rows, **figures, **instead, **last}))


@dataclass(frozen=True, eq=False)
class Opened:
    """A result as the instrument of some rows sees it, those rows that count, and lines of those that do not."""

    arm: CalibratedArm
    source: ProblemFile
    rows: Samples
    copied: tuple[int, ...]
    fitted: tuple[int, ...]
    other: bool
    """Whether another instrument than the calibration's took the rows."""
    remarks: tuple[str, ...]
    """Sentences: rows in postures that were fitted, and columns that are far from what they were in the fitted rows."""

    def fresh(self, standing: Collection[str]) -> Fresh:
        """Rows bound to the arm; raises CasacalError as `fresh_rows`, SamplesError for what is not finite."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            fresh = fresh_rows(self.arm, self.source.problem, self.rows, other=self.other, standing=standing)
            if not np.isfinite(fresh.bound.residual(fresh.x)).all() or not np.isfinite(fresh.jacobian).all():
                fix = "Check their values with check"
                raise SamplesError(self.rows.file, "the residuals of some rows are not finite", fix)
        return fresh

    @property
    def noise_freedom(self) -> float:
        """Degrees of freedom of the noise where the calibration found it itself, infinite where it was stated.

        The logarithm of a standard deviation from nu degrees of freedom has the variance 1 / (2 nu).
        """
        noise = self.arm.found.noise
        used = any(face.used_mm > face.stated_mm for face in noise.by_face.values())
        if not used or not noise.high > noise.low > 0:
            return math.inf
        return 0.5 / (math.log(noise.high / noise.low) / (2 * 1.96)) ** 2

    def judged(self, fresh: Fresh, standing: tuple[str, ...]) -> Judged:
        """These rows, bound to the arm, with what was said to stand."""
        verdict = self.arm.found.verdict
        return Judged(
            self.source.problem.robot.name,
            self.arm.file,
            ("", "") if verdict is None else (verdict.level, verdict.words),
            self.rows.file,
            self.rows.sha256,
            len(self.rows),
            fresh.own_names,
            standing,
            self.copied,
            self.fitted,
            self.remarks,
        )


def opened(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    problem: Problem | ProblemFile | str | Path | None,
    instrument: str | None,
    standing: Collection[str],
) -> Opened:
    """Read what is judged and by what; raises CasacalError as `verify` does."""
    if isinstance(standing, str):
        raise CasacalError(f"Got the text '{standing}' as the list of what has not moved", f"Give ['{standing}']")
    found = arm_from(result, "the result")
    arm = seen_by(found, instrument if problem is not None else measured_by(found, samples, instrument))
    source, robot = arm.source, arm.source.problem.robot
    if problem is not None:  # the result's arm with another problem's instrument
        other = problem_from(problem).problem
        if not same_arm(robot, other.robot):
            what = f"{arm.file}: the arm of the problem ({other.robot.name}) is not the calibrated one ({robot.name})"
            raise CasacalError(what, "Give a problem whose robot is that of the calibration, parameter by parameter")
        source = ProblemFile.of(Problem(robot, other.instrument))
    return fresh_among(arm, source, samples_of(samples, source, 0), other=problem is not None)


def measured_by(arm: CalibratedArm, samples: Any, instrument: str | None) -> str | None:
    """Which instrument of a calibration took some rows: the one that is named, else the one that reads most of them.

    Raises CasacalError where none could have, or several as well.
    """
    problem, fits = arm.source.problem, dict[str, int]()
    if instrument is not None or len(problem.instruments) == 1:
        return instrument
    if isinstance(samples, (str, Path)) and not Path(samples).is_file():
        raise CasacalError(f"There is no file '{samples}' of fresh rows", "Name one that is there")
    reasons = []
    for i, name in enumerate(problem.names):
        try:
            rows = samples_of(samples, arm.source, i)
            labelled = [column for column, labels in rows.labels.items() if labels.names != (column,)]
            fits[name] = len(rows.columns) + len(labelled)
        except CasacalError as error:
            reasons.append(f"for the {name}: {error.what}")
    best = [name for name, count in fits.items() if count == max(fits.values())]
    if len(best) == 1:
        return best[0]
    if best:
        fix = f"Name it: instrument='{best[0]}', or --instrument {best[0]}"
        raise CasacalError(f"These rows may be of {' or '.join(best)}", fix)
    raise CasacalError(f"These rows fit none of the instruments: {'; '.join(reasons)}", "Correct the columns")


def same_arm(one: Robot, two: Robot) -> bool:
    """Whether two arms have the same parameters, and the same poses wherever these move a little."""
    if [axis.turns for axis in one.axes] != [axis.turns for axis in two.axes] or set(one.parameters) != set(
        two.parameters
    ):
        return False
    rng = np.random.default_rng(0)
    for q in random_joints(one, COMPARED, rng):
        poses = []
        moved = {key: rng.normal(size=u.nominal_size) * 1e-3 for key, u in one.parameters.items()}
        for robot in (one, two):
            values = []
            for key, unknown in robot.traced.unknowns.items():
                if unknown.nominal is None or np.size(unknown.nominal) != moved[key].size:
                    return False
                value = unknown.at(ca.DM(np.ravel(unknown.nominal) + moved[key]), ca.DM.zeros(unknown.size))
                values.append(unknown.packed(value))
            pose = ca.DM.eye(4)
            for factor in robot.traced.graph.call([*values, ca.DM(q)]):
                pose = pose @ factor
            poses.append(np.array(pose))
        if not np.abs(poses[0] - poses[1]).max() < SAME:
            return False
    return True


def fresh_among(arm: CalibratedArm, source: ProblemFile, rows: Samples, *, other: bool) -> Opened:
    """Without copies of others, and without rows that the arm was calibrated from.

    Raises SamplesError where half of the rows or more are those that were fitted.
    """
    again = copies(rows)
    once, data = rows.take(np.flatnonzero(~again)), arm.found.data
    seen, part = np.zeros(len(once), dtype=bool), 0.0
    if data.fitted_rows is not None:
        seen, part = fitted_among(once, source.problem.layout(), data.fitted_rows)
    elif data.sha256 == rows.sha256 and arm.found.method != "truth":
        part = 1.0  # a result from before results held their rows
    if part >= SPENT:
        said = "these are the rows" if seen.all() or not seen.any() else "half of the rows or more are those"
        fix = "Take fresh rows, in other postures"
        raise SamplesError(rows.file, f"{said} that the arm was calibrated from, which say nothing new", fix)
    copied, fitted = (
        tuple(int(some.lines[k]) for k in np.flatnonzero(which).tolist())
        for some, which in ((rows, again), (once, seen))
    )
    fresh = once.take(np.flatnonzero(~seen))
    remarks = (NOTHING if other else TellingColumns.by(arm, fresh)).beyond
    if not other:
        remarks += (*_unlabelled(fresh, source, arm), *_same_postures(fresh, source, data.fitted_rows))
    return Opened(arm, source, fresh, copied, fitted, other, remarks)


def _unlabelled(fresh: Samples, source: ProblemFile, arm: CalibratedArm) -> list[str]:
    """A remark where rows lack the face column although the calibration had several faces."""
    groups = source.problem.instrument.groups
    if groups is None or fresh.labels[groups].names != (groups,):
        return []
    keys = [key for key, unknown in source.problem.instrument.unknowns.items() if unknown.per == groups]
    names = [name.split(".") for name in arm.found.unknowns]
    known = {name[-2] for name in names if len(name) > 2 and name[-3] in keys}
    if len(known) < 2:
        return []
    return [
        f"The rows have no column '{groups}' and count as one, while the calibration knows {listed(sorted(known))}: "
        "add the column if they are on several."
    ]


def _same_postures(fresh: Samples, source: ProblemFile, fitted: Mapping[str, Any] | None) -> list[str]:
    """A remark where most rows repeat fitted postures, which even wrong parameters predict."""
    again = 0 if fitted is None else int(in_fitted_postures(fresh, source.problem.layout(), fitted).sum())
    if again < SPENT * len(fresh):
        return []
    return [
        f"{again} of {len(fresh)} rows are in postures that were fitted. They show that readings repeat, not that the "
        "arm is right elsewhere: take rows in other postures."
    ]

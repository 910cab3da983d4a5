"""Test a calibration by fresh rows, without fitting the arm again: residuals, chi-square, faces, the decision."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.calibration.as_arm import AsArm
from casacal.calibration.fresh import Fresh, Opened, opened
from casacal.data.samples import Samples
from casacal.deployment.arm import CalibratedArm
from casacal.errors import CasacalError, SamplesError
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.uncertainty.figures import rms
from casacal.uncertainty.fresh_rows import FreshRows, chance, learnt
from casacal.uncertainty.identifiability import prior_scale
from casacal.uncertainty.tip_error import tip_rms, tip_stds, without_rigid, workspace_joints
from casacal.values import Array, is_real
from casacal.verification.arm_error import RISK, Decision, decide, errors_by_part, visible_error
from casacal.verification.verification import LEVEL, FaceVerification, Verification

LEAST_RISK = 1e-4  # risk below which nobody knows the noise well enough


def verify(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    problem: Problem | ProblemFile | str | Path | None = None,
    instrument: str | None = None,
    standing: Collection[str] = (),
    tolerance: float | None = None,
    risk: float = RISK,
) -> Verification:
    """Judge a calibration by rows that it has not seen; the arm is not fitted again.

    Only what the rows alone know is fitted to them: where the faces or the tracker stand, and the tool of another
    instrument. What is left is compared with its predicted covariance: of what the calibration may err by, from the
    posterior in result.json, and of the noise as the calibration used it. The sum of squares is chi-square with rows
    less fitted unknowns degrees of freedom (F where the calibration itself found the noise), and the promise is kept
    unless it is larger than 95 % of those of a good arm. Rows that were pasted again count once, and
    rows that the arm was calibrated from do not count.

    Args:
        result: a calibration, what `load` or `read_result` returns, or the path of a result.json or its folder.
        samples: fresh rows: `Samples`, a file, a pandas DataFrame, or arrays by column.
        problem: the same arm with the instrument of these rows, where it is not that of the calibration: a `Problem`,
            what `load_problem` returns, or a path.
        instrument: which of the calibration's instruments took these rows, where there are several; by default the one
            whose columns they have.
        standing: labels of faces ("floor") or unknowns ("plane", "tool") that stand where the calibration found them,
            and so are not fitted again.
        tolerance: largest RMS error, mm, that the arm may have in what this instrument sees: accepted, rejected or left
            undecided by JCGM 106:2012.
        risk: chance of a wrong decision of an arm whose error is the tolerance, below one half.

    Returns:
        What was found; residuals in mm.

    Raises CasacalError for what is no result, another arm, or a tolerance or risk that is none; UnknownNameError for
    something else standing; SamplesError for rows that do not fit, are too few, or half of which are those of the
    calibration; ProblemError for rows without the columns that tell an effect.

    """
    if tolerance is not None and not (is_real(tolerance) and 0 < tolerance < math.inf):
        raise CasacalError(f"The tolerance is {tolerance!r}", "Give a positive number of mm")
    if not (is_real(risk) and LEAST_RISK <= risk < 0.5):
        fix = f"Give a chance from {LEAST_RISK:g} to below 0.5, such as 0.05 for 5 %"
        raise CasacalError(f"The risk is {risk!r}", fix)
    case = opened(result, samples, problem=problem, instrument=instrument, standing=standing)
    unit = case.source.problem.instrument.words.unit
    if tolerance is not None and unit != "mm":
        raise CasacalError(f"The tolerance is in mm, but the residuals are in {unit}", "Leave it out")
    return _judged(case, tuple(standing), None if tolerance is None else float(tolerance), float(risk))


def _judged(case: Opened, standing: tuple[str, ...], tolerance: float | None, risk: float) -> Verification:
    """All figures of a verification."""
    fresh, freedom, words = case.fresh(standing), case.noise_freedom, case.source.problem.instrument.words
    bound, rows, arm = fresh.bound, fresh.linear, fresh.of_arm
    # slopes by the arm's unknowns, in units of their priors (1 mm, 1 mrad if flat); priors of own unknowns have none
    scaled = np.zeros((len(rows.residual), arm.size))
    scaled[: bound.rows] = fresh.jacobian[:, arm] * prior_scale(bound)[arm]
    per_row = bound.rows // len(case.rows)
    off = np.array([k for k in rows.gross() if k < bound.rows], dtype=np.intp)
    kept = np.setdiff1d(np.arange(len(rows.residual)), off)
    p, arm_chi, directions, arm_p = _chances(rows, scaled, freedom)
    without, _, _, arm_without = _chances(rows.take(kept), scaled[kept], freedom)
    drawn, visible = fresh.fitted(np.where(fresh.known, 0.0, fresh.at)), visible_error(case.arm, fresh)
    sizes = [_lengths(bound.plain_residual(x), per_row) for x in (drawn, fresh.x)]
    sizes.append(_lengths(rows.std[: bound.rows] * bound.noise, per_row))
    noise, most, stated = visible.noises_mm()
    promised, hidden = _tips(fresh)
    return Verification(
        case.judged(fresh, standing),
        before_mm=rms(sizes[0]),
        after_mm=rms(sizes[1]),
        predicted_mm=rms(sizes[2]),
        chi_square=rows.chi_square,
        freedom=rows.freedom,
        p=p,
        seen=directions,
        arm_chi_square=arm_chi,
        arm_p=arm_p,
        faces=_faces(fresh, sizes, freedom),
        gross_lines=tuple(sorted({int(case.rows.lines[k // per_row]) for k in off.tolist()})),
        kept_without_gross=min(without, arm_without) >= LEVEL / 2,
        quantile_mm=float(np.quantile(sizes[1], 0.95, method="inverted_cdf")),
        errors=errors_by_part(visible, drawn) if words.unit == "mm" else (),
        decision=None if tolerance is None else _decision(case.arm, fresh, off, tolerance, risk),
        noise_mm=noise,
        noise_most_mm=most,
        noise_stated_mm=stated,
        unknowns=arm.size,
        promised_tip_mm=promised,
        hidden_tip_mm=hidden,
        accuracy=words.accuracy,
        things=words.things,
        sees=words.residual,
        unit=words.unit,
    )


def _chances(rows: FreshRows, scaled: Array, noise: float) -> tuple[float, float, int, float]:
    """Chance of all residuals; chi-square in the arm's directions alone, its freedom and its chance."""
    arm, directions = rows.toward(scaled)
    return chance(rows.chi_square, rows.freedom, noise), arm, directions, chance(arm, directions, noise)


def _decision(arm: CalibratedArm, fresh: Fresh, off: NDArray[np.intp], tolerance: float, risk: float) -> Decision:
    """The decision by all rows; undecided where it hangs on those that are gross."""
    found = []
    for without in (None, off) if off.size else (None,):
        visible = visible_error(arm, fresh, without)
        scatter = visible.scatter(visible.residual(fresh.x))
        if scatter is None:
            what = "the unknowns fitted to these rows absorb any error of the arm, so no tolerance can be tested"
            raise SamplesError(fresh.bound.block.samples.file, what, "Take more rows, or leave the tolerance out")
        found.append(decide(scatter, visible.effective_rows(), tolerance, risk))
    if found[-1].verdict == found[0].verdict:
        return found[0]
    return replace(found[0], verdict="undecided", further_rows=None, hangs_on_gross=True)


def _lengths(values: Array, per_row: int) -> Array:
    """Norm (N,) of the `per_row` values of each row, from values (N per_row,): an error of three axes counts once."""
    return np.asarray(np.linalg.norm(values.reshape(-1, per_row), axis=1))


def _faces(fresh: Fresh, sizes: list[Array], noise: float) -> tuple[FaceVerification, ...]:
    """Each face by itself, in the order of the rows; none where there is only one."""
    bound, found = fresh.bound, []
    labels = bound.block.samples.faces(bound.problem.instrument.groups)
    for label, rows in labels.rows().items() if len(labels.names) > 1 else ():
        one = fresh.some(bound.residuals_of(rows))
        drawn, here, promised = (rms(each[rows]) for each in sizes)
        p = chance(one.chi_square, one.freedom, noise)
        found.append(FaceVerification(label, len(rows), drawn, here, promised, one.chi_square, one.freedom, p))
    return tuple(found)


def _tips(fresh: Fresh) -> tuple[float, float]:
    """Expected tip error, mm RMS: by the calibration, and by its posterior after these rows as well."""
    joints = workspace_joints(fresh.bound.problem.robot)
    tips, slopes = fresh.bound.tips(fresh.x, joints), fresh.bound.tip_jacobian(fresh.x, joints)
    field, there = without_rigid(slopes[:, fresh.known], tips), np.flatnonzero(~fresh.lost)
    after, own = fresh.covariance.copy(), fresh.linear.own
    slopes = np.zeros((len(own), there.size))
    slopes[: fresh.bound.rows] = fresh.jacobian[:, np.flatnonzero(fresh.known)[there]]
    after[np.ix_(there, there)] = learnt(fresh.covariance[np.ix_(there, there)], slopes, own)
    promised, hidden = (tip_stds(covariance, field) for covariance in (fresh.covariance, after))
    return tip_rms(promised.ravel()), tip_rms(hidden.ravel())

"""The figures of a verification: residuals, chi-square, faces, rows that are off, what the rows can vouch for."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.compensation.arm import CalibratedArm
from casacal.errors import SamplesError
from casacal.uncertainty.fresh_rows import chance, expected, gross, learnt, toward
from casacal.uncertainty.workspace import tip_rms, tip_stds, without_rigid, workspace_joints
from casacal.verification.arm_error import Seen, seen_by_rows
from casacal.verification.decision import Decision, decide
from casacal.verification.figures import LEVEL, QUANTILE, FaceVerification
from casacal.verification.fresh import Fresh
from casacal.verification.parts import errors_by_part
from casacal.verification.verification import Verification


def judged(
    arm: CalibratedArm, fresh: Fresh, standing: tuple[str, ...], tolerance: float | None, risk: float
) -> Verification:
    """All figures of a verification."""
    document, bound = arm.document, fresh.bound
    instrument, samples = bound.problem.instrument, bound.block.samples
    per_row = bound.rows // len(samples)
    parts = fresh.likelihood()
    found = expected(*parts)
    off = np.array([k for k in gross(*parts) if k < bound.rows], dtype=np.intp)
    arm_chi, seen = toward(*parts, fresh.scaled_arm())
    drawn, seen_rows = fresh.fitted(np.where(fresh.known, 0.0, fresh.at)), seen_by_rows(arm, fresh)
    before, after = (lengths(bound.plain_residual(x), per_row) for x in (drawn, fresh.x))
    predicted = lengths(found.std[: bound.rows] * bound.noise, per_row)
    noise, most, stated = seen_rows.noises_mm()
    freedom = noise_freedom(document)
    promised, hidden = _tips(fresh)
    verdict = document.get("verdict") or {}
    return Verification(
        robot=bound.problem.robot.name,
        result=arm.file,
        verdict=(str(verdict.get("level", "")), str(verdict.get("words", ""))),
        samples=samples.file,
        sha256=samples.sha256,
        rows=len(samples),
        own=fresh.own_names,
        standing=standing,
        before_mm=_rms(before),
        after_mm=_rms(after),
        predicted_mm=_rms(predicted),
        chi_square=found.chi_square,
        freedom=found.freedom,
        p=chance(found.chi_square, found.freedom, freedom),
        seen=seen,
        arm_chi_square=arm_chi,
        arm_p=chance(arm_chi, seen, freedom),
        faces=_faces(fresh, before, after, predicted, freedom),
        gross_lines=tuple(sorted({int(samples.lines[k // per_row]) for k in off.tolist()})),
        kept_without_gross=_kept_without(fresh, off, freedom),
        quantile_mm=float(np.quantile(after, QUANTILE, method="inverted_cdf")),
        errors=errors_by_part(seen_rows, drawn) if instrument.words.unit == "mm" else (),
        decision=None if tolerance is None else _decision(arm, fresh, off, tolerance, risk),
        noise_mm=noise,
        noise_most_mm=most,
        noise_stated_mm=stated,
        unknowns=int(fresh.arm.sum()),
        promised_tip_mm=promised,
        hidden_tip_mm=hidden,
        accuracy=instrument.words.accuracy,
        things=instrument.words.things,
        sees=instrument.words.residual,
        unit=instrument.words.unit,
    )


def _kept_without(fresh: Fresh, off: NDArray[np.intp], noise: float) -> bool:
    """Whether the promise would be kept without some residuals."""
    residual, spread, own = (np.delete(part, off, axis=0) for part in fresh.likelihood())
    found = expected(residual, spread, own)
    arm, seen = toward(residual, spread, own, np.delete(fresh.scaled_arm(), off, axis=0))
    return min(chance(found.chi_square, found.freedom, noise), chance(arm, seen, noise)) >= LEVEL / 2


def _decision(arm: CalibratedArm, fresh: Fresh, off: NDArray[np.intp], tolerance: float, risk: float) -> Decision:
    """The decision by all rows; undecided where it hangs on those that are gross."""
    found = _decided(seen_by_rows(arm, fresh), tolerance, risk)
    if not off.size:
        return found
    without = _decided(seen_by_rows(arm, fresh, off), tolerance, risk)
    if without.verdict == found.verdict:
        return found
    return replace(found, verdict="undecided", further_rows=None, hangs_on_gross=True)


def _decided(seen: Seen, tolerance: float, risk: float) -> Decision:
    scatter = seen.scatter(seen.residual(seen.fresh.x))
    if scatter is None:
        raise SamplesError(
            seen.fresh.bound.block.samples.file,
            "the unknowns fitted to these rows absorb any error of the arm, so no tolerance can be tested",
            "Take more rows, or leave the tolerance out",
        )
    return decide(scatter, seen.given_rows(), tolerance, risk)


def lengths(values: Array, per_row: int) -> Array:
    """Length of what each row (N,) has of some numbers (N per_row,): an error of three axes counts once."""
    return np.asarray(np.linalg.norm(values.reshape(-1, per_row), axis=1))


def _rms(values: Array) -> float:
    return math.sqrt(float((values**2).mean()))


def noise_freedom(document: Any) -> float:
    """Degrees of freedom of the noise where the calibration found it itself, infinite where it used what was stated.

    The logarithm of a standard deviation from nu degrees of freedom has the variance 1 / (2 nu).
    """
    noise = document.get("noise") or {}
    used = any(face["used_mm"] > face["stated_mm"] for face in (noise.get("by_face") or {}).values())
    low, high = noise.get("low"), noise.get("high")
    if not used or not low or not high or not high > low:
        return math.inf
    return 0.5 / (math.log(high / low) / (2 * 1.96)) ** 2


def _faces(fresh: Fresh, before: Array, after: Array, predicted: Array, noise: float) -> tuple[FaceVerification, ...]:
    """Each face by itself, in the order of the rows; none where there is only one."""
    bound = fresh.bound
    labels = bound.block.samples.faces(bound.problem.instrument.groups)
    per_row = bound.rows // len(labels)
    found = []
    for label, rows in labels.rows().items() if len(labels.names) > 1 else ():
        one = expected(*fresh.likelihood(_residuals(rows, per_row)))
        drawn, here, promised = (_rms(each[rows]) for each in (before, after, predicted))
        p = chance(one.chi_square, one.freedom, noise)
        found.append(FaceVerification(label, len(rows), drawn, here, promised, one.chi_square, one.freedom, p))
    return tuple(found)


def _residuals(rows: NDArray[np.intp], per_row: int) -> NDArray[np.intp]:
    return (rows[:, None] * per_row + np.arange(per_row)).ravel()


def _tips(fresh: Fresh) -> tuple[float, float]:
    """Tip error that the calibration expects, and what it would still be had it seen these rows too, mm RMS."""
    joints = workspace_joints(fresh.bound.problem.robot)
    tips, slopes = fresh.bound.tips(fresh.x, joints), fresh.bound.tip_jacobian(fresh.x, joints)
    field, there = without_rigid(slopes[:, fresh.known], tips), np.flatnonzero(~fresh.lost)
    after = fresh.covariance.copy()
    _, _, own = fresh.likelihood()
    slopes = np.zeros((len(own), there.size))
    slopes[: fresh.bound.rows] = fresh.jacobian[:, np.flatnonzero(fresh.known)[there]]
    after[np.ix_(there, there)] = learnt(fresh.covariance[np.ix_(there, there)], slopes, own)
    promised, hidden = (tip_stds(covariance, field) for covariance in (fresh.covariance, after))
    return tip_rms(promised.ravel()), tip_rms(hidden.ravel())

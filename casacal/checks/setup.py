"""What the set-up can show at all: tilts, faces, directions, lengths, number of rows; and the sign of the dial."""

from __future__ import annotations

import math

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.nominal import nominal_sight
from casacal.checks.finding import Finding
from casacal.instruments.description import Probe
from casacal.unknowns.fits import fitted_plane

SMALLEST_TILT = 5.0
"""Degrees between plunger and normal below which touches count as normal; 10 or more remove the blindness."""
SMALLEST_FACE = 0.05  # fraction of the arm's reach that touches of a face should span
SMALLEST_ANGLE = 20.0  # degrees between faces below which they count as parallel
ROWS_PER_UNKNOWN = 1.5  # fewer leave little to tell the noise and single bad rows by; as a plan takes at least
CLEARLY = 4.0  # times as far or as near as it might be by chance
NO_LENGTH = "no length was measured"


def setup_findings(bound: BoundProblem) -> list[Finding]:
    """Set-ups that leave the arm blind or weak, however good the readings."""
    probe, samples = bound.problem.instrument.probe, bound.block.samples
    findings = enough_rows(bound)
    if probe is None:
        return findings
    sight, faces = nominal_sight(bound.problem, 0, samples), samples.faces(probe.label)
    assert sight.plungers is not None
    reach = float(np.median(np.linalg.norm(sight.tips, axis=1)))
    tilts, normals, small = [], [], []
    for k, label in enumerate(faces.names):
        rows = faces.codes == k
        plane = fitted_plane(sight.tips[rows])
        normals.append(plane.normal)
        tilts.append(np.degrees(np.arccos(np.clip(np.abs(sight.plungers[rows] @ plane.normal), 0, 1))))
        span = float(np.ptp((sight.tips[rows] - plane.centre) @ plane.across[1]))
        if span < SMALLEST_FACE * reach and label not in probe.steps:  # a step gives a height, not a plane
            small.append(f"'{label}' {span:.0f} mm")
    tilt = float(np.concatenate(tilts).max())
    if tilt < SMALLEST_TILT:
        cause = (
            f"the tool is within {tilt:.1f} degrees of the normal in every touch, so some combinations of "
            f"parameters that move the tip stay unseen"
        )
        fix = "Tilt the tool by 10 degrees or more, in several directions"
        findings.append(Finding("warning", "tilt too small", cause, fix))
    if small:
        cause = f"the touches cover a small region for an arm that reaches {reach:.0f} mm: {', '.join(small)}"
        fix = "Use larger faces, or spread the touches over them"
        findings.append(Finding("warning", "faces too small", cause, fix))
    return findings + _directions(bound, probe, np.array(normals))


def enough_rows(bound: BoundProblem) -> list[Finding]:
    """An error where rows are fewer than the unknowns of the geometry, a warning where they are hardly more."""
    unknowns = bound.beside.count("")  # those of effects are small, and their priors say by how much
    ratio = bound.rows / max(unknowns, 1)
    if ratio >= ROWS_PER_UNKNOWN:
        return []
    fix = f"Take at least {math.ceil(ROWS_PER_UNKNOWN * unknowns)} rows, or hold parameters with --fix"
    return [Finding("error" if ratio < 1 else "warning", "few rows", f"{bound.rows} rows for {unknowns} unknowns", fix)]


def _directions(bound: BoundProblem, probe: Probe, normals: Array) -> list[Finding]:
    findings = []
    same = "there is only one face"
    angles = np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T), 0, 1)))
    if len(normals) > 1:
        same = f"all {len(normals)} faces look the same way, within {max(angles.max(), 1):.0f} degrees"
    if float(angles.max()) < SMALLEST_ANGLE and not probe.knows_angles:
        fix = "Add a face at an angle; three at right angles are best"
        findings.append(Finding("warning", "faces nearly parallel", same, fix))
    # on faces of certified angles a sliding joint is a ruler
    ruler = probe.knows_angles and not bound.problem.robot.revolute.all()
    if not probe.steps and not ruler:
        findings.append(
            Finding(
                "remark",
                NO_LENGTH,
                "faces determine angles; the size of the arm comes from the prior"
                + (" and a few millimetres of dial travel" if probe.column is not None else ""),
                "Measure one known length, such as a gauge block's step, declared as a Step in the problem",
            )
        )
    return findings


def upside_down(bound: BoundProblem, scatter: float) -> list[Finding]:
    """An error where a step lies as far below the face it stands on as it should stand out, seen from the tool.

    A fit cannot tell: with the plane's normal the other way round, all rows fit. scatter: distance (mm) that prior
    errors of the arm explain.
    """
    probe, samples, instrument = bound.problem.instrument.probe, bound.block.samples, bound.problem.instrument
    if probe is None or not probe.steps:
        return []
    rows, sight = samples.faces(probe.label).rows(), nominal_sight(bound.problem, 0, samples)
    assert sight.plungers is not None
    found = []
    for step, height in instrument.known_columns["height"].items():
        on = instrument.instance("plane", step)
        if step not in rows or on not in rows or abs(height) < CLEARLY * scatter:
            continue
        plane = fitted_plane(sight.tips[rows[on]])
        towards = -np.sign(float((sight.plungers[rows[on]] @ plane.normal).mean()))
        stands = towards * float(((sight.tips[rows[step]] - plane.centre) @ plane.normal).mean())
        if plane.flat and abs(stands + height) < CLEARLY * scatter:
            cause = f"'{step}' should stand {height:g} mm out of '{on}' and stands {stands:.0f} mm out of it"
            fix = "Exchange the two labels in all rows, or correct the sign of the step's height"
            found.append(Finding("error", "labels exchanged", cause, fix))
    return found


WRONG_SIGN = "wrong dial sign"


def sign_before_fit(bound: BoundProblem) -> list[Finding]:
    """Regression of the nominal residuals on the reading: a slope of 2 means a wrong sign, no spread tells nothing."""
    probe, samples = bound.problem.instrument.probe, bound.block.samples
    if probe is None or probe.column is None:
        return []
    reading = samples.columns[probe.column]
    if float(reading.std()) < 5 * probe.noise_std:
        cause = "the readings are nearly constant, so these samples cannot show whether the dial's sign is wrong"
        fix = "Let the reading vary over the dial's travel in a few touches"
        return [Finding("remark", "dial sign not tested", cause, fix)]
    sight, faces = nominal_sight(bound.problem, 0, samples), samples.faces(probe.label)
    residual = bound.plain_residual(bound.x0)
    assert sight.plungers is not None
    axis = sight.plungers
    slopes, errors = [], []
    for k in range(len(faces.names)):
        rows = faces.codes == k
        plane = fitted_plane(sight.tips[rows])
        normal = plane.normal if float((axis[rows] @ plane.normal).mean()) < 0 else -plane.normal
        # the plane absorbs what is linear over the face; take that out of both sides
        design = np.column_stack([np.ones(int(rows.sum())), (sight.tips[rows] - plane.centre) @ plane.across.T])
        lever = probe.sign * reading[rows] * (axis[rows] @ normal)
        lever = lever - design @ np.linalg.lstsq(design, lever, rcond=None)[0]
        left = residual[rows] - design @ np.linalg.lstsq(design, residual[rows], rcond=None)[0]
        size = float(lever @ lever)
        if size > 0 and rows.sum() > 6:
            slopes.append(float(lever @ left) / size)
            errors.append(float(left.std()) / math.sqrt(size))
    if not slopes:
        return []
    weights = 1 / np.maximum(np.array(errors), 1e-9) ** 2
    slope, std = float(np.average(slopes, weights=weights)), float(1 / np.sqrt(weights.sum()))
    if not tells_a_wrong_sign(slope, std):
        return []
    cause = (
        f"with the arm as drawn the residuals already follow the reading, with a slope of {slope:.2f} +- {std:.2f} "
        "(0 is expected, 2 if the sign is wrong)"
    )
    fix = f"Reverse the sign of the dial in the problem (--set sign={-probe.sign} tries it)"
    return [Finding("error", WRONG_SIGN, cause, fix)]


def tells_a_wrong_sign(slope: float, std: float) -> bool:
    """Whether residuals follow the reading with slope 2, not 0; an arm far from its drawing lies between."""
    return slope >= 5 * std and slope - 3 * std <= 2.0 <= slope + 3 * std

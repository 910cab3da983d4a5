"""Faults of a dial: its sign, seen before any fit, and turns of its pointer that were miscounted."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casacal.binding.bound_problem import BoundProblem
from casacal.binding.nominal import nominal_sight
from casacal.checks.finding import Finding
from casacal.instruments.description import readings_within
from casacal.least_squares.result import Result
from casacal.unknowns.fits import fitted_plane

WRONG_SIGN = "wrong dial sign"


def sign_before_fit(bound: BoundProblem) -> list[Finding]:
    """Regression of the nominal residuals on the reading: a slope of 2 means a wrong sign, no spread tells nothing."""
    probe, samples = bound.problem.instrument.probe, bound.block.samples
    if probe is None or probe.column is None:
        return []
    reading = samples.columns[probe.column]
    if float(reading.std()) < 5 * probe.noise_std:
        return [
            Finding(
                "remark",
                "dial sign not tested",
                "the readings are nearly constant, so these samples cannot show whether the dial's sign is wrong",
                "Let the reading vary over the dial's travel in a few touches",
            )
        ]
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
    return [
        Finding(
            "error",
            WRONG_SIGN,
            f"with the arm as drawn the residuals already follow the reading, with a slope of {slope:.2f} +- {std:.2f} "
            "(0 is expected, 2 if the sign is wrong)",
            f"Reverse the sign of the dial in the problem (--set sign={-probe.sign} tries it)",
        )
    ]


def tells_a_wrong_sign(slope: float, std: float) -> bool:
    """Whether residuals follow the reading with slope 2, not 0; an arm far from its drawing lies between."""
    return slope >= 5 * std and slope + 3 * std >= 2.0


TURNS_MM = (1.0, 0.5, 2.54, 0.2)
"""What one turn of a pointer shows, by the dials that are sold; several turns are only looked for of the first."""

SHORT_TRAVEL = 2.0
"""Travel (mm) up to which a dial has turns of less than half a millimetre."""

MOST_TURNS = 3
SURE = 4.0
"""Standard deviations within which a reading must then fit."""

SMALL = 1e-4
"""Step of the finite difference, mm."""


def lost_turns(
    bound: BoundProblem, result: Result, rows: Sequence[int], scale: float, i: int = 0
) -> dict[tuple[float, int], list[int]]:
    """Rows that fit with whole turns added to their reading, by what was added (mm) and how many turns that is.

    Args:
        bound: with a dial that has a reading; nothing is found for any other.
        result: a robust fit that these rows hardly pull.
        rows: places of outliers in the samples of one instrument.
        scale: noise of the other rows over what is used.
        i: which instrument.

    """
    probe, samples, own = bound.problem.instruments[i].probe, bound.samples[i], bound.sample_rows(i)
    if probe is None or probe.column is None or own.stop - own.start != len(samples):
        return {}
    reading, sets, (low, high) = samples.columns[probe.column], list(bound.samples), readings_within(probe.travel)
    sets[i] = replace(samples, columns={**samples.columns, probe.column: reading + SMALL})
    here = bound.residual(result.x)[own]
    slopes = (bound.on(*sets).residual(result.x)[own] - here) / SMALL
    found: dict[tuple[float, int], list[int]] = defaultdict(list)
    for k in rows:
        if abs(slopes[k]) < 1e-9:
            continue
        missing, spread = -float(here[k] / slopes[k]), SURE * scale / abs(float(slopes[k]))
        for turn in TURNS_MM:
            count = round(missing / turn)
            sharp = spread < turn / 8 and (turn >= 0.5 or high - low <= SHORT_TRAVEL)
            most = MOST_TURNS if turn == TURNS_MM[0] else 1
            if sharp and 1 <= abs(count) <= most and math.isclose(missing, count * turn, abs_tol=spread):
                found[count * turn, count].append(k)
                break
    return found

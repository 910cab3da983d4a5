"""Systematic faults, found by undoing each suspected one and fitting again."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.slots import nominal_sight
from casacal.checks.finding import Finding, times
from casacal.errors import CasacalError
from casacal.estimators import lm
from casacal.least_squares.losses import huber
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.unknowns.fits import fitted_plane

SUSPICIOUS = 2.0
"""Misfit, in stated standard deviations, above which something systematic is looked for."""
BETTER = 0.25
"""An undone fault must shrink the misfit to this part to be believed."""
ALIKE = 1.5
"""Within this factor a fault and its absence cannot be told apart."""
STEPS = 25


@dataclass(frozen=True)
class Fault:
    """A suspected fault: its name, what was done wrong, what to do, and the samples with it undone."""

    about: str
    cause: str
    fix: str
    undo: Callable[[Samples], Samples]


ANGLE_UNITS = {180 / math.pi: "radians, written as degrees", math.pi / 180: "degrees, written as radians"}


def suspected(problem: Problem) -> Iterator[Fault]:
    """Faults that people make with such samples."""
    turns = problem.robot.revolute
    for suspect in problem.instrument.suspects:
        yield Fault(suspect.about, suspect.cause, suspect.fix, _scale_columns(suspect.columns, suspect.factor))
    for factor, words in ANGLE_UNITS.items():
        cause, fix = f"the joint angles seem to be {words}", "Correct the unit in the columns' names"
        yield Fault("unit of the joints", cause, fix, _map_joints(np.diag(np.where(turns, factor, 1.0))))
    yield from flips(problem)
    for i, j in combinations(range(len(turns)), 2):
        if turns[i] == turns[j]:
            order = np.eye(len(turns))
            order[[i, j]] = order[[j, i]]
            cause, fix = f"columns q{i + 1} and q{j + 1} seem to hold each other's values", "Swap the two column names"
            yield Fault(f"joints {i + 1} and {j + 1} swapped", cause, fix, _map_joints(order))


def flips(problem: Problem) -> Iterator[Fault]:
    """Each joint counted the other way."""
    count = len(problem.robot.axes)
    for i in range(count):
        signs = np.ones(count)
        signs[i] = -1.0
        cause = f"joint {i + 1} seems to be counted in the other direction"
        fix = f"Reverse the sign of column q{i + 1}, or of the joint in the problem"
        yield Fault(f"joint {i + 1} flipped", cause, fix, _map_joints(np.diag(signs)))


def misfit(problem: Problem, samples: Samples) -> float:
    """Size of residuals and of the parameters' moves after a quick robust fit; one where all is well.

    Root of the median squared whitened residual (scaled to a standard deviation) plus the prior's cost per row: a fit
    that explains touches by bending the arm far beyond its prior is no fit. Infinite if it fails.
    """
    try:
        bound = bind(problem, samples)
    except CasacalError:
        return math.inf
    result = lm(bound, loss=huber(), max_steps=STEPS)
    size = 1.4826 * float(np.median(np.abs(bound.residual(result.x))))
    size = math.sqrt(size**2 + 2 * bound.prior_cost(result.x) / bound.rows)
    return size if math.isfinite(size) else math.inf


def name_fault(problem: Problem, samples: Samples, base: float) -> Finding | None:
    """The suspected fault whose undoing explains the misfit best, if one does."""
    sizes = [(misfit(problem, fault.undo(samples)), i, fault) for i, fault in enumerate(suspected(problem))]
    best, _, fault = min(sizes, key=lambda entry: entry[:2])
    if best > BETTER * base:
        return None
    rivals = [other.about for size, _, other in sizes if size <= ALIKE * best and other is not fault]
    also = f"; {', '.join(rivals)} would explain it as well" if rivals else ""
    return Finding(
        "error",
        fault.about,
        f"{fault.cause}: with that undone, the misfit falls from {times(base)} to {times(best)} times the stated "
        f"noise{also}",
        fault.fix,
    )


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
                "the readings are nearly constant, so these samples cannot tell whether the dial's sign is wrong",
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
            "wrong dial sign",
            f"with the arm as drawn the residuals already follow the reading, with a slope of {slope:.2f} +- {std:.2f} "
            "(0 is expected, 2 if the sign is wrong)",
            "Reverse the sign of the dial in the problem",
        )
    ]


def tells_a_wrong_sign(slope: float, std: float) -> bool:
    """Whether residuals follow the reading with slope 2, not 0; an arm far from its drawing lies between."""
    return slope >= 5 * std and slope + 3 * std >= 2.0


def _scale_columns(names: tuple[str, ...], factor: float) -> Callable[[Samples], Samples]:
    def undo(samples: Samples) -> Samples:
        scaled = {name: samples.columns[name] * factor for name in names}
        return replace(samples, columns={**samples.columns, **scaled})

    return undo


def _map_joints(matrix: Array) -> Callable[[Samples], Samples]:
    return lambda samples: replace(samples, joints=samples.joints @ matrix.T)

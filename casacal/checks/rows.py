"""What rows say of themselves: repeats, readings outside travel, joints outside limits, coarse rounding."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.checks.finding import Finding, Severity
from casacal.instruments.description import readings_within
from casacal.problem.problem import Problem
from casacal.samples.repeats import copies_of
from casacal.samples.samples import Samples
from casacal.wording import counted

GRIDS_DEG = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
GRIDS_MM = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
LITTLE = 0.01
"""Part of its travel by which a dial may show more."""
ENOUGH_ROWS = 12
"""Rows from which a common grid of values cannot be chance."""


def repeated(samples: Samples) -> list[Finding]:
    """Rows that hold the same joints, columns and labels as an earlier one."""
    again = copies_of(samples)
    if not again.any():
        return []
    return [
        Finding(
            "warning",
            "repeated rows",
            f"{counted(int(again.sum()))} with the same joints and readings as an earlier row",
            "Remove them, unless the arm really went there twice and the dial read the same; each counts once",
            _lines(samples, again),
        )
    ]


def outside(problem: Problem, samples: Samples) -> list[Finding]:
    """Readings outside the dial's travel, joints outside their limits, angles that no joint turns to."""
    findings = []
    probe = problem.instrument.probe
    if probe is not None and probe.column is not None:
        reading, (low, high) = samples.columns[probe.column], readings_within(probe.travel)
        beyond = np.maximum(low - reading, reading - high)
        bad = beyond > 0
        if bad.any():
            least, most = float(reading.min()), float(reading.max())
            little = float(beyond.max()) <= LITTLE * (high - low)
            cause = (
                f"{counted(int(bad.sum()), 'reading')} outside {low:g} to {high:g} mm (from {least:g} to {most:g} mm)"
            )
            fix = "Dials show a little more than their travel; see that the plunger was not at its end there"
            fix = fix if little else _declared(least, most, low)
            severity: Severity = "warning" if little else "error"
            findings.append(Finding(severity, "readings outside travel", cause, fix, _lines(samples, bad)))
    for i, (lower, upper) in enumerate(zip(*problem.robot.limits, strict=True)):
        bad = (samples.joints[:, i] < lower - 0.02) | (samples.joints[:, i] > upper + 0.02)
        if bad.any():
            findings.append(
                Finding(
                    "warning",
                    f"joint {i + 1} outside its limits",
                    f"{counted(int(bad.sum()), 'value')} outside the limits that the problem declares",
                    "Check the order, signs and units of the joint columns, or the limits",
                    _lines(samples, bad),
                )
            )
    return findings


def _declared(least: float, most: float, low: float) -> str:
    """What to do about readings from least to most (mm) where the smallest should be `low`."""
    ends = f"{math.floor(min(least, low)):g}:{math.ceil(most):g}"
    if least >= low:
        longer = f"{math.ceil(most)}" if low == 0 else ends
        return f"Check the column's unit and the dial's zero, or declare its travel (--set travel={longer})"
    middle = f"If the dial was set to zero within its travel, declare it (--set travel={ends})"
    if most < 0 <= low:
        return f"{middle}. If the sign of the column is reversed, write the readings without the minus"
    return f"{middle}; otherwise check these rows and the unit of the column"


def rounded(bound: BoundProblem) -> list[Finding]:
    """Joint values or readings written so coarsely that rounding outweighs the stated noise."""
    samples, findings = bound.block.samples, []
    noise = float(np.median(bound.block.noise))
    for kind, grids in (("revolute", np.radians(GRIDS_DEG)), ("prismatic", np.array(GRIDS_MM))):
        joints = [i for i, joint in enumerate(bound.problem.robot.axes) if joint.kind == kind]
        steps = {i: _grid(samples.joints[:, i], grids) for i in joints}
        coarse = [i for i, step in steps.items() if step]
        effect = _blur(bound, {i: steps[i] for i in coarse}) if coarse else 0.0
        if effect > 0.5 * noise:
            step = max(steps[i] for i in coarse)
            shown = f"{math.degrees(step):g} degrees" if kind == "revolute" else f"{step:g} mm"
            findings.append(
                Finding(
                    "error" if effect > 2 * noise else "warning",
                    "joints rounded",
                    f"joints {', '.join(str(i + 1) for i in coarse)} are written in steps of {shown}, which moves the "
                    f"tip by up to {effect:.2g} mm; the stated noise is {noise:.2g} mm",
                    "Log the joints with more digits, or declare the joint repeatability",
                )
            )
    lengths = [name for name, kind in bound.problem.instrument.columns.items() if kind == "length"]
    step = max((_grid(samples.columns[name], np.array(GRIDS_MM)) for name in lengths), default=0.0)
    if step / math.sqrt(12) > noise:
        findings.append(
            Finding(
                "warning",
                "readings rounded",
                f"readings are written in steps of {step:g} mm; the stated noise is {noise:.2g} mm",
                "Read the dial more finely, or declare a larger noise_std",
            )
        )
    return findings


def _blur(bound: BoundProblem, steps: dict[int, float]) -> float:
    """RMS residual (mm) that joints rounded to steps (rad, mm) cause: the noise model with that much repeatability."""
    problem = bound.problem
    joints = [
        replace(joint, repeatability_std=steps.get(i, 0.0) / math.sqrt(12))
        for i, joint in enumerate(problem.robot.axes)
    ]
    exact = [replace(joint, repeatability_std=0.0) for joint in problem.robot.axes]
    noise = [
        BoundProblem(
            Problem(replace(problem.robot, joints=kind), *problem.instruments), bound.slots, bound.samples
        ).block.noise
        for kind in (joints, exact)
    ]
    return math.sqrt(max(float((noise[0] ** 2 - noise[1] ** 2).mean()), 0.0))


def _grid(values: Array, grids: Array) -> float:
    """The coarsest grid that holds all values, or zero; the finest of the list tells nothing."""
    if len(values) < ENOUGH_ROWS or np.ptp(values) == 0:
        return 0.0
    for step in grids:
        if np.abs(values / step - np.round(values / step)).max() < 1e-4:
            return float(step)
    return 0.0


def _lines(samples: Samples, bad: NDArray[np.bool_]) -> tuple[int, ...]:
    return tuple(samples.lines[i] for i in np.flatnonzero(bad).tolist())

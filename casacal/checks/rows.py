"""What rows say of themselves: repeats, readings outside travel, joints outside limits, rounding."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.checks.finding import Finding, Severity
from casacal.instruments.description import OVERTRAVEL, Dimension, readings_within
from casacal.problem.problem import Problem
from casacal.samples.repeats import copies_of
from casacal.samples.samples import Samples
from casacal.samples.write import WRITTEN
from casacal.wording import counted

OUTSIDE, OUT_OF_LIMITS = "readings outside travel", "readings outside limits"
SHOWN_UNITS = {"angle": " degrees", "length": " mm", "number": ""}
GRIDS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)  # degrees, or mm
ENOUGH_ROWS = 12  # rows from which a common grid of values cannot be chance


def repeated(samples: Samples) -> list[Finding]:
    """Rows that hold the same joints, columns and labels as an earlier one."""
    again = copies_of(samples)
    if not again.any():
        return []
    cause = f"{counted(int(again.sum()))} with the same joints and readings as an earlier row"
    fix = "Remove them, unless the arm really went there twice and the dial read the same; each counts once"
    return [Finding("warning", "repeated rows", cause, fix, _lines(samples, again))]


def outside(problem: Problem, samples: Samples) -> list[Finding]:
    """Readings outside the dial's travel, joints outside their limits, angles that no joint turns to."""
    findings, instrument = list[Finding](), problem.instrument
    probe = instrument.probe
    if probe is not None and probe.column is not None:
        reading, (low, high) = samples.columns[probe.column], readings_within(probe.travel)
        beyond = np.maximum(low - reading, reading - high)
        bad = beyond > 0
        if bad.any():
            least, most = float(reading.min()), float(reading.max())
            little = float(beyond.max()) <= OVERTRAVEL * (high - low)
            cause = (
                f"{counted(int(bad.sum()), 'reading')} outside {low:g} to {high:g} mm (from {least:g} to {most:g} mm)"
            )
            fix = "Dials show a little more than their travel; see that the plunger was not at its end there"
            fix = fix if little else _declared(least, most, low, high)
            severity: Severity = "warning" if little else "error"
            findings.append(Finding(severity, OUTSIDE, cause, fix, _lines(samples, bad)))
    for name, kind in instrument.columns.items():
        findings += _beyond_limits(samples, name, kind, instrument.reading_limits.get(name, (-math.inf, math.inf)))
    for i, (lower, upper) in enumerate(zip(*problem.robot.limits, strict=True)):
        bad = (samples.joints[:, i] < lower - 0.02) | (samples.joints[:, i] > upper + 0.02)
        if bad.any():
            cause = f"{counted(int(bad.sum()), 'value')} outside the limits that the problem declares"
            fix = "Check the order, signs and units of the joint columns, or the limits"
            findings.append(Finding("warning", f"joint {i + 1} outside its limits", cause, fix, _lines(samples, bad)))
    return findings


def _beyond_limits(samples: Samples, name: str, kind: Dimension, ends: tuple[float, float]) -> Iterator[Finding]:
    """An error on readings outside what an instrument of one's own says that it can show."""
    _, factor, _ = WRITTEN[kind]
    reading, (low, high) = samples.columns[name] * factor, (end * factor for end in ends)
    bad = (reading < low) | (reading > high)
    if bad.any():
        unit = SHOWN_UNITS[kind]
        cause = f"{counted(int(bad.sum()), 'value')} of '{name}' outside its reading_limits, {low:g} to {high:g}{unit}"
        mirrored = ((-reading >= low) & (-reading <= high)).all()
        fix = (
            f"Reverse the sign of column '{name}'" if mirrored else "Check these rows, the column's unit, or the limits"
        )
        yield Finding("error", OUT_OF_LIMITS, cause, fix, _lines(samples, bad))


def _declared(least: float, most: float, low: float, high: float) -> str:
    """What to do about readings from least to most (mm) where they should be from low to high."""
    rest = "otherwise check these rows and the unit of the column"
    top = math.ceil(most if low == 0 else max(most, high))  # two ends that were declared are kept where they suffice
    ends = f"{math.floor(min(least, low)):g}:{top:g}"
    if least >= low:
        longer = f"{top:g}" if low == 0 else ends
        return f"If the dial is longer, or its zero elsewhere, declare its travel (--set travel={longer}); {rest}"
    middle = f"If the dial was set to zero within its travel, declare it (--set travel={ends})"
    if most < 0 <= low:
        return f"{middle}. If the sign of the column is reversed, write the readings without the minus"
    return f"{middle}; {rest}"


def rounded(bound: BoundProblem) -> list[Finding]:
    """Joint values or readings written so coarsely that rounding outweighs the stated noise."""
    samples, findings = bound.block.samples, []
    noise = float(np.median(bound.block.noise))
    for kind, grids in (("revolute", np.radians(GRIDS)), ("prismatic", np.array(GRIDS))):
        joints = [i for i, joint in enumerate(bound.problem.robot.axes) if joint.kind == kind]
        steps = {i: _grid(samples.joints[:, i], grids) for i in joints}
        coarse = [i for i, step in steps.items() if step]
        effect = _blur(bound, {i: steps[i] for i in coarse}) if coarse else 0.0
        if effect > 0.5 * noise:
            step = max(steps[i] for i in coarse)
            shown = f"{math.degrees(step):g} degrees" if kind == "revolute" else f"{step:g} mm"
            cause = (
                f"joints {', '.join(str(i + 1) for i in coarse)} are written in steps of {shown}, which moves the "
                f"tip by up to {effect:.2g} mm; the stated noise is {noise:.2g} mm"
            )
            fix = "Log the joints with more digits, or declare the joint repeatability"
            findings.append(Finding("error" if effect > 2 * noise else "warning", "joints rounded", cause, fix))
    lengths = [name for name, kind in bound.problem.instrument.columns.items() if kind == "length"]
    step = max((_grid(samples.columns[name], np.array(GRIDS)) for name in lengths), default=0.0)
    if step / math.sqrt(12) > noise:
        cause = f"readings are written in steps of {step:g} mm; the stated noise is {noise:.2g} mm"
        fix = "Read the dial more finely, or declare a larger noise_std"
        findings.append(Finding("warning", "readings rounded", cause, fix))
    return findings


def _blur(bound: BoundProblem, steps: dict[int, float]) -> float:
    """RMS residual (mm) that joints rounded to steps (rad, mm) cause: the noise model with that much repeatability."""
    problem = bound.problem

    def noise(steps: dict[int, float]) -> Array:
        stds = [steps.get(i, 0.0) / math.sqrt(12) for i in range(len(problem.robot.axes))]
        joints = [replace(joint, repeatability_std=std) for joint, std in zip(problem.robot.axes, stds, strict=True)]
        rounded_so = Problem(replace(problem.robot, joints=joints), *problem.instruments)
        return BoundProblem(rounded_so, bound.slots, bound.samples).block.noise

    return math.sqrt(max(float((noise(steps) ** 2 - noise({}) ** 2).mean()), 0.0))


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

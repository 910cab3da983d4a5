"""What rows say of themselves: repeats, readings outside travel, joints outside limits, rounding, odd labels."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.checks.finding import Finding, Severity
from casacal.instruments.description import OVERTRAVEL, readings_within
from casacal.problem.problem import Problem
from casacal.samples.repeats import copies_of
from casacal.samples.samples import Samples
from casacal.wording import counted

OUTSIDE, LABELS_ALIKE = "readings outside travel", "labels alike"
GRIDS_DEG = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
GRIDS_MM = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
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
    findings = []
    probe = problem.instrument.probe
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
    for i, (lower, upper) in enumerate(zip(*problem.robot.limits, strict=True)):
        bad = (samples.joints[:, i] < lower - 0.02) | (samples.joints[:, i] > upper + 0.02)
        if bad.any():
            cause = f"{counted(int(bad.sum()), 'value')} outside the limits that the problem declares"
            fix = "Check the order, signs and units of the joint columns, or the limits"
            findings.append(Finding("warning", f"joint {i + 1} outside its limits", cause, fix, _lines(samples, bad)))
    return findings


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
    for kind, grids in (("revolute", np.radians(GRIDS_DEG)), ("prismatic", np.array(GRIDS_MM))):
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
    step = max((_grid(samples.columns[name], np.array(GRIDS_MM)) for name in lengths), default=0.0)
    if step / math.sqrt(12) > noise:
        cause = f"readings are written in steps of {step:g} mm; the stated noise is {noise:.2g} mm"
        fix = "Read the dial more finely, or declare a larger noise_std"
        findings.append(Finding("warning", "readings rounded", cause, fix))
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


MARGIN = 2  # rows that a label needs beside one for each unknown of its own
RARE = 0.03
FEW = 3  # a label of no more rows, in no more than this part of all, is rare
SHORTEST = 4  # letters from which one letter more or less is a slip and not another name
MOST_LABELS = 200  # labels that are compared with one another; where there are more they are numbers, not names


def absent_labels(problem: Problem, samples: Samples) -> list[Finding]:
    """Warnings on columns by which a problem declares its unknowns to differ, and which the samples do not have.

    Columns by which an instrument's unknowns differ anyhow, such as `plane`, may be left out where there is one.
    """
    found = []
    for key, unknown in problem.instrument.unknowns.items():
        usual = getattr(getattr(type(problem.instrument), key, None), "per", None)
        column = unknown.per
        if column is not None and column != usual and samples.labels[column].names == (column,):
            cause = (
                f"there is no column '{column}', which '{key}' is declared to depend on; all rows count as one group"
            )
            found.append(Finding("warning", "labels absent", cause, f"Add the column, or declare '{key}' without it"))
    return found


def odd_labels(problem: Problem, samples: Samples) -> list[Finding]:
    """Warnings on labels that occur in few rows or hardly differ from another one; a label is named once."""
    column = problem.instrument.groups
    if column is None or column not in samples.labels:
        return []
    labels = samples.labels[column]
    counts = dict(zip(labels.names, np.bincount(labels.codes, minlength=len(labels.names)).tolist(), strict=True))
    declared = {label for known in problem.instrument.known_columns.values() for label in known}
    alike = _alike(counts) if len(counts) <= MOST_LABELS else {}
    findings, totals = [], _rows_of_unknowns(problem, counts, column)
    for name, rows in labels.rows().items():
        if name in declared:
            continue
        lines = tuple(samples.lines[i] for i in rows.tolist())
        if name in alike:
            other = alike[name]
            cause = f"'{name}' ({counted(counts[name])}) hardly differs from '{other}' ({counted(counts[other])})"
            what = problem.instrument.words.group
            fix = f"Write '{other}' there if it is the same {what}; now it counts as a separate {what}"
            findings.append(Finding("warning", LABELS_ALIKE, cause, fix, lines))
        elif said := _rare(problem, name, counts, column, totals.get(name, counts[name])):
            findings.append(Finding("warning", "rare label", *said, lines))
    return findings


def _rare(problem: Problem, name: str, counts: dict[str, int], column: str, total: int) -> tuple[str, str] | None:
    """Cause and fix for a label of too few rows; None where it has enough."""
    own = _own_unknowns(problem, name, column)
    group, components = problem.instrument.words.group, problem.models[0].components
    few = own > 0 and total * components < own + MARGIN
    rare = len(counts) > 1 and counts[name] <= FEW and counts[name] < RARE * sum(counts.values())
    if not few and not rare:
        return None
    others = [repr(other) for other in counts if other != name]
    slip = f"Correct it if you mean {' or '.join(others[:FEW])}, or take" if others else "Take"
    beside = f"; each {group} has {counted(own, 'unknown')} of its own" if own else ""
    least = -(-(own + MARGIN) // components)
    return f"'{name}' occurs in {counted(counts[name])}{beside}", f"{slip} {least} rows or more there"


def _alike(counts: dict[str, int]) -> dict[str, str]:
    """For each label that looks like a slip of another one, that other one: of two, the one of fewer rows."""
    close: dict[str, list[str]] = defaultdict(list)
    for one, two in combinations(counts, 2):
        rare, often = (one, two) if counts[one] < counts[two] else (two, one)
        if _slip(rare, often, both_common=2 * counts[rare] > counts[often]):
            close[rare].append(often)
    return {name: max(others, key=lambda other: counts[other]) for name, others in close.items()}


def _slip(one: str, two: str, *, both_common: bool) -> bool:
    """Whether two labels differ by case, blanks or one letter; 'face1' and 'face2' do not, nor 'sideA' and 'sideB'."""
    if "".join(one.split()).casefold() == "".join(two.split()).casefold():
        return True
    short, long = sorted((one.casefold(), two.casefold()), key=len)
    if len(short) < SHORTEST - 1 or len(long) < SHORTEST or len(long) - len(short) > 1:
        return False
    start = next((i for i, (a, b) in enumerate(zip(short, long, strict=False)) if a != b), len(short))
    if len(short) == len(long):
        if short[start + 1 :] != long[start + 1 :] or not (short[start].isalpha() and long[start].isalpha()):
            return False
        return not (both_common and start == len(short) - 1)
    return short[start:] == long[start + 1 :] and long[start].isalpha()


def _own_unknowns(problem: Problem, name: str, column: str) -> int:
    """Unknowns of the instrument that a label has for itself; none where it shares the plane of another one."""
    instrument = problem.instrument
    return sum(
        unknown.size
        for key, unknown in instrument.unknowns.items()
        if unknown.per == column and instrument.instance(key, name) == name
    )


def _rows_of_unknowns(problem: Problem, counts: dict[str, int], column: str) -> dict[str, int]:
    """Rows that tell of each label's unknowns: its own, and those of labels that share them, such as a step's."""
    instrument, fewest = problem.instrument, dict[str, int]()
    for key in (key for key, unknown in instrument.unknowns.items() if unknown.per == column):
        totals = Counter[str]()
        for name, count in counts.items():
            totals[instrument.instance(key, name)] += count
        for name in counts:
            fewest[name] = min(fewest.get(name, totals[name]), totals[name])
    return fewest

"""Checks of rows and set-up before any fit: repeats, ranges, rounding, labels, the dial's sign, small faces."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import get_args

import numpy as np

from casacal.calibration.finding import Finding, Severity
from casacal.data.columns import Dimension
from casacal.data.repeats import copies_of, repeats_in, standstills
from casacal.data.samples import WRITTEN, Measurements, Samples
from casacal.data.text import is_number
from casacal.fit.bound_problem import ABSURD, BoundProblem, each_alone
from casacal.fit.nominal import nominal_sight
from casacal.model.geometry import fitted_plane
from casacal.model.instrument import OVERTRAVEL, readings_within
from casacal.model.problem import Problem
from casacal.model.robot import random_joints
from casacal.values import Array, Rows
from casacal.wording import counted, figures, shortened

OUTSIDE, OUT_OF_LIMITS = "readings outside travel", "readings outside limits"
SHOWN_UNITS = {"angle": " degrees", "length": " mm", "number": ""}
GRIDS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)  # degrees, or mm
ENOUGH_ROWS = 12  # rows from which a common grid of values cannot be chance
LABELS_ALIKE = "labels alike"
MARGIN = 2  # rows that a label needs beside one for each unknown of its own
RARE = 0.03
FEW = 3  # a label of no more rows, in no more than this part of all, is rare
SHORTEST = 4  # letters from which one letter more or less is a slip and not another name
MOST_LABELS = 200  # labels that are compared with one another; where there are more they are numbers, not names
WRONG_SIGN = "wrong dial sign"
FAR = 10.0  # times its travel by which no dial is outside it
LOST_STEP, TWO_READINGS = "step without a face", "one posture, two readings"
SMALLEST_TILT = 5.0  # degrees between plunger and normal below which touches count as normal; 10 remove the blindness
SMALLEST_FACE = 0.05  # fraction of the arm's reach that touches of a face should span
SMALLEST_ANGLE = 20.0  # degrees between faces below which they count as parallel
ROWS_PER_UNKNOWN = 1.5  # fewer leave little to tell the noise and single bad rows by; as a plan takes at least
CLEARLY = 4.0  # times as far or as near as it might be by chance
NO_LENGTH = "no length was measured"
IN_METRES = 0.1, 20.0  # extent (mm) of a flange's way over random postures that only an arm in metres has
POSTURES = 40
DIFFERENT = 1.0  # mm by which readings of one posture differ only where they are not of one posture


def repeated(samples: Samples) -> list[Finding]:
    """Rows that hold the same joints, columns and labels as an earlier one, and standstills that were recorded."""
    if (stood := int(standstills(samples).max(initial=-1)) + 1) < len(samples):
        cause = f"{counted(len(samples), 'line')} are of {counted(stood, 'standstill')}, as a recorder writes them"
        return [Finding("remark", "recorded standstills", cause, "Nothing to do: each counts once, as its mean")]
    again = copies_of(samples)
    if not again.any():
        return []
    cause = f"{counted(int(again.sum()))} with the same joints and readings as an earlier row"
    fix = "Remove them, unless the arm really went there twice and the dial read the same; each counts once"
    return [Finding("warning", "repeated rows", cause, fix, lines_of(samples, again))]


def outside(problem: Problem, samples: Samples) -> Iterator[Finding]:
    """Readings outside the dial's travel, joints outside their limits, and readings that contradict each other."""
    instrument, probe = problem.instrument, problem.instrument.probe
    if probe is not None and probe.column is not None:
        reading, (low, high) = samples.columns[probe.column], readings_within(probe.travel)
        beyond = np.maximum(low - reading, reading - high)
        bad = beyond > 0
        if bad.any():
            least, most = float(reading.min()), float(reading.max())
            little = float(beyond.max()) <= OVERTRAVEL * (high - low)
            many = counted(int(bad.sum()), "reading")
            cause = f"{many} outside {low:g} to {high:g} mm (from {least:g} to {most:g} mm)"
            fix = "Dials show a little more than their travel; see that the plunger was not at its end there"
            fix = fix if little else _declared(least, most, low, high)
            severity: Severity = "warning" if little else "error"
            yield Finding(severity, OUTSIDE, cause, fix, lines_of(samples, bad))
    for name, kind in instrument.columns.items():
        factor, ends = WRITTEN[kind][1], instrument.reading_limits.get(name, (-math.inf, math.inf))
        value, (low, high) = samples.columns[name] * factor, (end * factor for end in ends)
        bad = (value < low) | (value > high)
        if bad.any():
            many, span = counted(int(bad.sum()), "value"), f"{low:g} to {high:g}{SHOWN_UNITS[kind]}"
            mirrored = ((-value >= low) & (-value <= high)).all()
            fix = "Check these rows, the column's unit, or the limits"
            fix = f"Reverse the sign of column '{name}'" if mirrored else fix
            cause = f"{many} of '{name}' outside its reading_limits, {span}"
            yield Finding("error", OUT_OF_LIMITS, cause, fix, lines_of(samples, bad))
    for i, (lower, upper) in enumerate(zip(*problem.robot.limits, strict=True)):
        bad = (samples.joints[:, i] < lower - 0.02) | (samples.joints[:, i] > upper + 0.02)
        bad &= not (problem.robot.revolute[i] and upper - lower == 2 * math.pi)  # it turns on and on, however counted
        if bad.any():
            cause = f"{counted(int(bad.sum()), 'value')} outside the limits that the problem declares"
            fix = "Check the order, signs and units of the joint columns, or the limits"
            yield Finding("warning", f"joint {i + 1} outside its limits", cause, fix, lines_of(samples, bad))
    yield from _contradicted(problem, samples)


def _contradicted(problem: Problem, samples: Samples) -> Iterator[Finding]:
    """An error on touches of one posture and face that a dial read differently, as where rows were pasted."""
    probe = problem.instrument.probe
    if probe is None or probe.column is None or len(samples.faces(probe.zero_label).names) > 1:
        return
    again, reading = repeats_in(Measurements.of(samples), [probe.label]), samples.columns[probe.column]
    highest, lowest = np.full(len(again.sizes), -math.inf), np.full(len(again.sizes), math.inf)
    np.maximum.at(highest, again.codes, reading)
    np.minimum.at(lowest, again.codes, reading)
    off = (highest - lowest > DIFFERENT)[again.codes]
    if not off.any():
        return
    cause = f"{counted(int(off.sum()))} of postures that come again read more than {DIFFERENT:g} mm apart"
    fix = "Look which of them are right, and remove the others"
    yield Finding("error", TWO_READINGS, cause, fix, lines_of(samples, off))


def _declared(least: float, most: float, low: float, high: float) -> str:
    """Advice on readings that span least to most (mm) where low to high is declared."""
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


def rounded(bound: BoundProblem) -> Iterator[Finding]:
    """Joint values or readings written so coarsely that rounding outweighs the stated noise."""
    samples, noise = bound.block.samples, float(np.median(bound.block.noise))
    for kind, grids in (("revolute", np.radians(GRIDS)), ("prismatic", np.array(GRIDS))):
        joints = [i for i, joint in enumerate(bound.problem.robot.axes) if joint.kind == kind]
        steps = {i: _grid(samples.joints[:, i], grids) for i in joints}
        coarse = [i for i, step in steps.items() if step]
        effect = _blur(bound, {i: steps[i] for i in coarse}) if coarse else 0.0
        if effect > 0.5 * noise:
            step = max(steps[i] for i in coarse)
            shown = f"{math.degrees(step):g} degrees" if kind == "revolute" else f"{step:g} mm"
            which, blurs = ", ".join(str(i + 1) for i in coarse), f"blurs the residual by {figures(effect, 2)} mm RMS"
            cause = f"joints {which} are written in steps of {shown}, which {blurs}; "
            cause += f"the stated noise is {figures(noise, 2)} mm"
            fix = "Log the joints with more digits, or declare the joint repeatability"
            yield Finding("error" if effect > 2 * noise else "warning", "joints rounded", cause, fix)
    instrument, here = bound.problem.instrument, bound.residual(bound.x0)
    whole = any(block.unit == "rad" for block in instrument.blocks)  # poses; other angles and numbers may be settings
    for dimension in get_args(Dimension) if whole else ("length",):
        unit, moved, largest = 1 / WRITTEN[dimension][1], np.zeros(bound.rows), 0.0
        for name in (name for name, each in instrument.columns.items() if each == dimension):
            step = _grid(samples.columns[name], unit * np.array(GRIDS))
            if step and all(name != block.std for block in instrument.blocks):
                shifted = replace(samples, columns={**samples.columns, name: samples.columns[name] + step})
                moved += (bound.on(shifted).residual(bound.x0) - here) ** 2 / 12
                largest = max(largest, step / unit)
        blur = math.sqrt(float(moved.reshape(len(samples), -1).mean(axis=0).max()))
        if blur > 1:
            by = f"{blur:.2g} times the stated noise"
            cause = f"readings are written in steps of {largest:g}{SHOWN_UNITS[dimension]}, which blurs them by {by}"
            fix = "Read them more finely and write more digits, or declare a larger noise"
            yield Finding("warning", "readings rounded", cause, fix)


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
    """The coarsest grid that holds all values; zero where none does."""
    if len(values) < ENOUGH_ROWS or np.ptp(values) == 0:
        return 0.0
    for step in grids:
        if np.abs(values / step - np.round(values / step)).max() < 1e-4:
            return float(step)
    return 0.0


def lines_of(samples: Samples, bad: Rows) -> tuple[int, ...]:
    """Lines of the file of some rows (N,)."""
    return tuple(samples.lines[i] for i in np.flatnonzero(bad).tolist())


def odd_labels(problem: Problem, samples: Samples) -> list[Finding]:
    """Warnings on labels that occur in few rows or hardly differ from another one; a label is named once."""
    instrument, column = problem.instrument, problem.instrument.groups
    if column is None or column not in samples.labels:
        return []
    labels, group = samples.labels[column], instrument.words.group
    counts = dict(zip(labels.names, np.bincount(labels.codes, minlength=len(labels.names)).tolist(), strict=True))
    declared = {label for known in instrument.known_columns.values() for label in known}
    alike = _alike(counts) if len(counts) <= MOST_LABELS else {}
    keys = [key for key, unknown in instrument.unknowns.items() if unknown.per == column]
    findings, totals, components = [], dict[str, int](), problem.models[0].components
    for key in keys:
        shared = Counter[str]()  # the rows that determine a label's unknowns, with those that share them, as a step's
        for name, count in counts.items():
            shared[instrument.instance(key, name)] += count
        for name in counts:
            totals[name] = min(totals.get(name, shared[name]), shared[name])
    for name, rows in labels.rows().items():
        if name in declared:
            continue
        lines, count = tuple(samples.lines[i] for i in rows.tolist()), counts[name]
        if name in alike:
            other = alike[name]
            cause = f"'{name}' ({counted(count)}) hardly differs from '{other}' ({counted(counts[other])})"
            fix = f"Write '{other}' there if it is the same {group}; now it counts as a separate {group}"
            findings.append(Finding("warning", LABELS_ALIKE, cause, fix, lines))
            continue
        # unknowns that it has for itself: none where it shares the plane of another one
        own = sum(instrument.unknowns[key].size for key in keys if instrument.instance(key, name) == name)
        few = own > 0 and totals.get(name, count) * components < own + MARGIN
        if few or (len(counts) > 1 and count <= FEW and count < RARE * sum(counts.values())):
            others = [repr(other) for other in counts if other != name]
            slip = f"Correct it if you mean {' or '.join(others[:FEW])}, or take" if others else "Take"
            extra = f"; each {group} has {counted(own, 'unknown')} of its own" if own else ""
            cause, least = f"'{name}' occurs in {counted(count)}{extra}", -(-(own + MARGIN) // components)
            findings.append(Finding("warning", "rare label", cause, f"{slip} {least} rows or more there", lines))
    return findings


def labels_alike(problem: Problem, measured: Measurements) -> tuple[Finding, ...]:
    """Warnings of labels that may be slips of others, such as Floor beside floor."""
    found = (odd_labels(alone.problem, alone.samples) for alone in each_alone(problem, measured.sets))
    return tuple(finding for findings in found for finding in findings if finding.about == LABELS_ALIKE)


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
    if is_number(one) and is_number(two):
        return float(one.replace(",", ".")) == float(two.replace(",", "."))  # 1 beside 1.0, as a spreadsheet makes it
    short, long = sorted((one.casefold(), two.casefold()), key=len)
    if len(short) < SHORTEST - 1 or len(long) < SHORTEST or len(long) - len(short) > 1:
        return False
    start = next((i for i, (a, b) in enumerate(zip(short, long, strict=False)) if a != b), len(short))
    if len(short) == len(long):
        if short[start + 1 :] != long[start + 1 :] or not (short[start].isalpha() and long[start].isalpha()):
            return False
        return not (both_common and start == len(short) - 1)
    return short[start:] == long[start + 1 :] and long[start].isalpha()


def sign_before_fit(bound: BoundProblem) -> list[Finding]:
    """Regress the nominal residuals on the reading: slope 2 means a wrong sign; a constant reading tests nothing."""
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
    said = f"a slope of {slope:.2f} +- {std:.2f} (0 is expected, 2 if the sign is wrong)"
    cause = f"with the arm as drawn the residuals already follow the reading, with {said}"
    fix = f"Reverse the sign of the dial in the problem (--set sign={-probe.sign} tries it)"
    return [Finding("error", WRONG_SIGN, cause, fix)]


def tells_a_wrong_sign(slope: float, std: float) -> bool:
    """Whether residuals follow the reading with slope 2, not 0; an arm far from its drawing lies between."""
    return slope >= 5 * std and slope - 3 * std <= 2.0 <= slope + 3 * std


def lost_targets(problem: Problem, samples: Samples) -> tuple[list[Finding], Samples]:
    """An error on rows in which a device tells nothing, and the other rows.

    Of a device that tells places: exact zeros, or one place in all rows. Of a dial: one reading far outside its travel
    in all rows. Of both: numbers that nothing shows.
    """
    instrument, probe = problem.instrument, problem.instrument.probe
    names = [name for name, kind in instrument.columns.items() if kind == "length"]
    if probe is not None and probe.column is not None:
        about, why, names, travel = "lost reading", "of a dial that was not read", [probe.column], probe.travel
    elif instrument.words.accuracy and len(names) >= 3:
        about, why, travel = "lost target", "of a target that was lost", -math.inf
    else:
        names = []
    if not names or not len(samples):
        return [], samples
    told, (low, high) = np.column_stack([samples.columns[name] for name in names]), readings_within(travel)
    lost = (np.abs(told) >= ABSURD).any(axis=1) | ((told == 0).all(axis=1) & (high < low))
    far = max(low - told[0, 0], told[0, 0] - high) > FAR * (high - low)
    lost |= len(told) > 2 and far and (told == told[0]).all()
    if not lost.any() or len(lost) / 2 < lost.sum() < len(lost):
        return [], samples
    shown = " or ".join(dict.fromkeys(", ".join(f"{value:g}" for value in each) for each in told[lost]))
    cause = f"the device tells nothing {'in any row' if lost.all() else 'there'} ({shown[:60]}), as {why}"
    fix = "Remove these lines, or measure them again"
    fix = "Measure again, and see that it tells something" if lost.all() else fix
    return [Finding("error", about, cause, fix, lines_of(samples, lost))], samples.take(np.flatnonzero(~lost))


def lost_labels(problem: Problem, samples: Samples) -> Iterator[Finding]:
    """Columns by which a problem declares its unknowns to differ and which the samples lack, and steps without a face.

    Columns by which an instrument's unknowns differ anyhow, such as `plane`, may be left out where there is one. A step
    in rows that stands on a face without rows is an error, a step that no row is on is worth a warning.
    """
    for key, unknown in problem.instrument.unknowns.items():
        usual, column = getattr(getattr(type(problem.instrument), key, None), "per", None), unknown.per
        if column is not None and column != usual and samples.labels[column].names == (column,):
            cause = (
                f"there is no column '{column}', which '{key}' is declared to depend on; all rows count as one group"
            )
            yield Finding("warning", "labels absent", cause, f"Add the column, or declare '{key}' without it")
    probe = problem.instrument.probe
    names = () if probe is None or probe.label is None else samples.faces(probe.label).names
    if probe is None or names in ((), (probe.label,)):
        return
    there = f"The labels there are: {shortened(names)}"
    for step in probe.steps:
        on = problem.instrument.instance("plane", step)
        if step in names and on not in names:
            cause = f"'{step}' is declared to stand on '{on}', and no row is on '{on}', so its height tells nothing"
            yield Finding("error", LOST_STEP, cause, f"Correct the step in the problem, or the labels. {there}")
        elif step not in names:
            cause = f"'{step}' is declared as a step on '{on}', and no row is on '{step}', so its height tells nothing"
            yield Finding("warning", LOST_STEP, cause, f"Touch it, or correct the label. {there}")


def setup_findings(bound: BoundProblem) -> Iterator[Finding]:
    """Set-ups that leave the arm blind or weak, however good the readings."""
    probe, samples = bound.problem.instrument.probe, bound.block.samples
    yield from enough_rows(bound)
    if probe is None:
        return
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
        cause = f"the tool is within {tilt:.1f} degrees of the normal in every touch, so some combinations of "
        cause += "parameters that move the tip stay unseen"
        fix = "Tilt the tool by 10 degrees or more, in several directions"
        yield Finding("warning", "tilt too small", cause, fix)
    if small:
        cause = f"the touches cover a small region for an arm that reaches {reach:.0f} mm: {', '.join(small)}"
        fix = "Use larger faces, or spread the touches over them"
        yield Finding("warning", "faces too small", cause, fix)
    angles = np.degrees(np.arccos(np.clip(np.abs(normals @ np.transpose(normals)), 0, 1)))
    same = "there is only one face"
    if len(normals) > 1:
        same = f"all {len(normals)} faces look the same way, within {max(angles.max(), 1):.0f} degrees"
    if float(angles.max()) < SMALLEST_ANGLE and not probe.knows_angles:
        fix = "Add a face at an angle; three at right angles are best"
        yield Finding("warning", "faces nearly parallel", same, fix)
    # on faces of certified angles a sliding joint is a ruler
    if not probe.steps and not (probe.knows_angles and not bound.problem.robot.revolute.all()):
        cause = "faces determine angles; the size of the arm comes from the prior"
        cause += " and a few millimetres of dial travel" if probe.column is not None else ""
        fix = "Measure one known length, such as a gauge block's step, declared as a Step in the problem"
        yield Finding("remark", NO_LENGTH, cause, fix)


def enough_rows(bound: BoundProblem) -> list[Finding]:
    """An error where rows are fewer than the unknowns of the geometry, a warning where they are hardly more."""
    unknowns = bound.beside.count("")  # those of effects are small, and their priors say by how much
    ratio = bound.rows / max(unknowns, 1)
    if ratio >= ROWS_PER_UNKNOWN:
        return []
    fix = f"Take at least {math.ceil(ROWS_PER_UNKNOWN * unknowns)} rows, or hold parameters with --fix"
    return [Finding("error" if ratio < 1 else "warning", "few rows", f"{bound.rows} rows for {unknowns} unknowns", fix)]


def upside_down(bound: BoundProblem, scatter: float) -> Iterator[Finding]:
    """An error where a step lies as far below the face it stands on as it should stand out, seen from the tool.

    A fit cannot tell: with the plane's normal the other way round, all rows fit. scatter: distance (mm) that prior
    errors of the arm explain.
    """
    probe, samples, instrument = bound.problem.instrument.probe, bound.block.samples, bound.problem.instrument
    if probe is None or not probe.steps:
        return
    rows, sight = samples.faces(probe.label).rows(), nominal_sight(bound.problem, 0, samples)
    assert sight.plungers is not None
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
            yield Finding("error", "labels exchanged", cause, fix)


def in_metres(problem: Problem, samples: Samples) -> list[Finding]:
    """An error on an arm whose flange moves by millimetres: its numbers, or what its pose gives, are metres."""
    joints = random_joints(problem.robot, POSTURES, np.random.default_rng(0))
    anywhere = replace(samples.take(np.zeros(POSTURES, dtype=np.intp)), joints=joints)
    extent = float(np.linalg.norm(np.ptp(nominal_sight(problem, 0, anywhere).poses[:, :3, 3], axis=0)))
    if not IN_METRES[0] < extent < IN_METRES[1]:
        return []
    cause = f"in any postures the flange stays within {figures(extent, 2)} mm, so the arm's lengths seem to be metres"
    return [Finding("error", "arm in metres", cause, "Write them, and what the pose function returns, in mm")]

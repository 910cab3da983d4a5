"""Checks of a set-up before any fit: what is missing, too few rows, small or parallel faces, an arm in metres."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from casacal.calibration.before_fit import lines_of
from casacal.calibration.finding import Finding
from casacal.data.samples import Samples
from casacal.fit.bound_problem import ABSURD, BoundProblem
from casacal.fit.nominal import nominal_sight
from casacal.model.geometry import fitted_plane
from casacal.model.instrument import readings_within
from casacal.model.problem import Problem
from casacal.model.robot import random_joints
from casacal.wording import figures, shortened

FAR = 10.0  # times its travel by which no dial is outside it
LOST_STEP = "step without a face"
SMALLEST_TILT = 5.0
"""Degrees between plunger and normal below which touches count as normal; 10 or more remove the blindness."""
SMALLEST_FACE = 0.05  # fraction of the arm's reach that touches of a face should span
SMALLEST_ANGLE = 20.0  # degrees between faces below which they count as parallel
ROWS_PER_UNKNOWN = 1.5  # fewer leave little to tell the noise and single bad rows by; as a plan takes at least
CLEARLY = 4.0  # times as far or as near as it might be by chance
NO_LENGTH = "no length was measured"
IN_METRES = 0.1, 20.0
"""Extent (mm) of the flange's way over random postures that only an arm has whose lengths are metres."""
POSTURES = 40


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
        return [], samples
    if not len(samples):
        return [], samples
    told, (low, high) = np.column_stack([samples.columns[name] for name in names]), readings_within(travel)
    lost = (np.abs(told) >= ABSURD).any(axis=1) | ((told == 0).all(axis=1) & (high < low))
    far = max(low - told[0, 0], told[0, 0] - high) > FAR * (high - low)
    lost |= len(told) > 2 and far and (told == told[0]).all()
    if not lost.any() or len(lost) / 2 < lost.sum() < len(lost):
        return [], samples
    shown = " or ".join(dict.fromkeys(", ".join(f"{value:g}" for value in each) for each in told[lost]))
    cause = f"the device tells nothing {'in any row' if lost.all() else 'there'} ({shown[:60]}), as {why}"
    fix = (
        "Measure again, and see that it tells something" if lost.all() else "Remove these lines, or measure them again"
    )
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
        cause = (
            f"the tool is within {tilt:.1f} degrees of the normal in every touch, so some combinations of "
            f"parameters that move the tip stay unseen"
        )
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

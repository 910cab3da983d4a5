"""Rows that any residual fits: random postures, and readings at which the residual vanishes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casacal.array_types import Array, Index, Rows
from casacal.errors import SimulationError
from casacal.problem.problem import Problem
from casacal.robots.joint_space import inside_limits, random_joints
from casacal.samples.samples import Samples
from casacal.simulation.bench import Bench, bench_of
from casacal.simulation.cell import Disturbances
from casacal.simulation.faults import ArmErrors, drawn_waves, last_moves, rounded, unwaved, waved
from casacal.simulation.true_arm import Draw, check_asked, own_noise, row_labels
from casacal.tables.columns import Labels

CANDIDATES = 80  # random postures for each row; the one that fits best is where its search begins
ROUNDS, STEPS = 30, 40  # times that rows are tried afresh, and Gauss-Newton steps of each
FITS = 1e-9  # residual, in units of the largest of its noise or a thousandth of a unit, below which a row fits
SLOW = 1e-3  # what a reading costs in the step that is sought, where a radian costs one: readings move before joints do


def fitting_rows(
    problem: Problem, cell: Disturbances, samples: int | Samples, draw: Draw
) -> tuple[Samples, Bench, ArmErrors]:
    """Samples of an instrument that is shown no faces, the true arm before it, and the arm's errors.

    samples: how many, or the postures in which to measure; those in which the true arm cannot are left out. Raises
    SimulationError when no posture inside the joint limits fits, or a cell asks for what only faces have.
    """
    check_asked(problem, cell)
    truth_rng, pose_rng, noise_rng, _, gear_rng = draw.streams(5, of_the_arm=(0, 4))
    given, count = (samples, len(samples)) if isinstance(samples, Samples) else (None, samples)
    labels = row_labels(problem, cell, count) if given is None else dict(given.labels)
    bench = bench_of(problem, cell, labels, truth_rng, count, draw)
    instrument, n = problem.instrument, len(problem.robot.axes)
    gross = noise_rng.random(count) < cell.outliers
    outlier = gross * noise_rng.choice([-1.0, 1.0], size=count) * cell.outlier_size * noise_rng.uniform(1, 2, count)
    own = own_noise(problem) if cell.repeatability is None else cell.repeatability
    target = noise_rng.normal(size=(count, problem.model.components)) * own + outlier[:, None]
    scatter = noise_rng.normal(size=(count, n)) * cell.joint_std
    arm = ArmErrors(drawn_waves(problem.robot, cell.waves, gear_rng))
    if given is None:
        free, met = _found(bench, target, pose_rng)
        if not met.all():
            raise SimulationError(
                f"No posture inside the limits of '{problem.robot.name}' and its readings makes the residual of "
                f"{type(instrument).__name__} vanish in {(~met).sum()} of {count} rows",
                "Give its unknowns nominal values within the arm's reach, or give the instrument a `probe`",
            )
        lag = last_moves(free[:, :n]) * cell.backlash / 2
        said = unwaved(arm.waves, free[:, :n] - scatter + lag)
    else:
        standing = waved(arm.waves, given.joints) + scatter - last_moves(given.joints) * cell.backlash / 2
        free, met = _read_there(bench, standing, target)
        said = given.joints + free[:, :n] - standing
    recorded = rounded(said, cell.encoder_step)
    columns, read = {}, instrument.as_read(dict(zip(instrument.columns, free[:, n:].T, strict=True)))
    for name, dimension in instrument.columns.items():
        shown = read[name] + noise_rng.normal(size=count) * instrument.column_stds.get(name, 0.0)
        columns[name] = rounded(shown, cell.resolution if dimension == "length" else 0.0)
    file = draw.name if given is None else given.file
    rows = Samples(recorded, columns, labels, tuple(range(1, count + 1)), {}, file, draw.name)
    return rows if met.all() else rows.take(np.flatnonzero(met)), bench, arm


def exact_rows(bench: Bench, labels: Mapping[str, Labels], rng: np.random.Generator, *, rounds: int) -> Samples:
    """Rows without any error in random postures: those of the labelled ones that a few rounds of tries find."""
    count, model, instrument = len(bench.z), bench.problem.model, bench.problem.instrument
    free, met = _found(bench, np.zeros((count, model.components)), rng, rounds)
    which = np.flatnonzero(met)
    joints, read = np.split(free[which], [len(bench.problem.robot.axes)], axis=1)
    columns = dict(instrument.as_read(dict(zip(instrument.columns, read.T, strict=True))))
    known = {name: each.take(which) for name, each in labels.items()}
    return Samples(joints, columns, known, tuple(range(1, len(which) + 1)), {}, "", "")


def _found(bench: Bench, target: Array, rng: np.random.Generator, rounds: int = ROUNDS) -> tuple[Array, Rows]:
    """Joints and readings (N, n) at which the residuals (N, m) are met, joints inside their limits, and where."""
    count = len(target)
    free = np.full((count, len(bench.problem.robot.axes) + bench.read), np.nan)
    waiting = np.arange(count)
    for _ in range(rounds):
        start = _starts(bench, target, waiting, rng)
        found, met = _met(bench, start, target[waiting], waiting)
        met &= _inside(bench, found) & (bench.beyond(found, waiting) < 1e-6)
        free[waiting[met]] = found[met]
        waiting = waiting[~met]
        if not waiting.size:
            break
    return free, ~np.isnan(free).any(axis=1)


def _inside(bench: Bench, free: Array) -> Rows:
    """Which joints and readings (N, n) are inside their limits."""
    instrument, n = bench.problem.instrument, len(bench.problem.robot.axes)
    ends = [instrument.reading_limits.get(name, (-np.inf, np.inf)) for name in instrument.columns]
    least, most = np.array(ends).reshape(-1, 2).T
    readings = free[:, n:]
    return inside_limits(bench.problem.robot, free[:, :n]) & ((readings >= least) & (readings <= most)).all(axis=1)


def _read_there(bench: Bench, standing: Array, target: Array) -> tuple[Array, Rows]:
    """Joints and readings (N, n) at which the residuals (N, m) are met by an arm that stands there, and where they are.

    Joints stay where readings can follow them; where there are none, the arm moves on until it meets the residual.
    """
    instrument, rows = bench.problem.instrument, np.arange(len(target))
    readings = [instrument.begins_at.get(name, 0.0) for name in instrument.columns]
    start = np.hstack([standing, np.tile(readings, (len(standing), 1))])
    found, met = _met(bench, start, target, rows, held=bench.read >= target.shape[1])
    return found, met & _inside(bench, found)


def _starts(bench: Bench, target: Array, rows: Index, rng: np.random.Generator) -> Array:
    """For each row the random posture, readings at zero, that comes nearest."""
    robot = bench.problem.robot
    tried = random_joints(robot, len(rows) * CANDIDATES, rng)
    instrument = bench.problem.instrument
    readings = [instrument.begins_at.get(name, 0.0) for name in instrument.columns]
    free = np.hstack([tried, np.tile(readings, (len(tried), 1))])
    if bench.read:  # readings follow from any posture
        return free[::CANDIDATES]
    e, _ = bench.residual(free, np.repeat(rows, CANDIDATES))
    miss = ((e - np.repeat(target[rows], CANDIDATES, axis=0)) ** 2).sum(axis=1)
    miss = (miss + bench.beyond(free, np.repeat(rows, CANDIDATES)) ** 2).reshape(len(rows), CANDIDATES)
    # one of the nearest few, so that touches do not crowd where the random postures do
    order = np.argsort(miss, axis=1)[:, : CANDIDATES // 8]
    pick = order[np.arange(len(rows)), rng.integers(order.shape[1], size=len(rows))]
    return np.asarray(free.reshape(len(rows), CANDIDATES, -1)[np.arange(len(rows)), pick])


def _met(bench: Bench, start: Array, target: Array, rows: Index, *, held: bool = False) -> tuple[Array, Rows]:
    """Where Gauss-Newton's smallest steps lead from the starts, and which rows arrive; joints may be held."""
    free = start.copy()
    n = len(bench.problem.robot.axes)
    unit = np.where(bench.problem.robot.revolute, 1.0, 1.0 / SLOW)
    ease = np.concatenate([unit * (not held), np.full(bench.read, 1.0 / SLOW)])
    size = max(float(np.abs(target).max(initial=0.0)), 1e-3)
    e, slopes = bench.residual(free, rows)
    part = np.ones(len(free))  # of each row's step; a step that would lead away from the target is tried shorter
    for _ in range(STEPS):
        miss = e - target
        if (np.abs(miss) <= FITS * size).all():
            break
        eased = slopes * ease
        gram = eased @ eased.transpose(0, 2, 1)
        eye = np.eye(gram.shape[1])
        gram += 1e-12 * np.einsum("kii->k", gram)[:, None, None] * eye + 1e-300 * eye
        step = -(eased.transpose(0, 2, 1) @ np.linalg.solve(gram, miss[..., None]))[..., 0] * ease
        largest = np.abs(step[:, :n] / unit).max(axis=1, initial=0.0)
        there = free + step * (part * np.minimum(1.0, 0.5 / np.maximum(largest, 1e-300)))[:, None]
        e_there, slopes_there = bench.residual(there, rows)
        nearer = ((e_there - target) ** 2).sum(axis=1) <= (miss**2).sum(axis=1)
        free[nearer], e[nearer], slopes[nearer] = there[nearer], e_there[nearer], slopes_there[nearer]
        part = np.where(nearer, np.minimum(2 * part, 1.0), part / 4)
    return free, np.asarray((np.abs(e - target) <= 1e3 * FITS * size).all(axis=1) & np.isfinite(free).all(axis=1))

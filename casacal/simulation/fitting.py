"""A search for joints and readings at which the residuals of simulated rows vanish."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array, Index, Rows
from casacal.errors import SimulationError
from casacal.kernels.batch import Batch
from casacal.problem.cell import Face
from casacal.problem.problem import Problem
from casacal.robots.joint_space import random_joints

CANDIDATES = 80
"""Random postures for each row; the one that fits best is where its search begins."""
ROUNDS, STEPS = 100, 40
"""Times that rows are tried afresh, and Gauss-Newton steps of each."""
FITS = 1e-9
"""Residual, in units of the largest of its noise or a thousandth of a unit, below which a row fits."""
SLOW = 1e-3
"""What a reading costs in the step that is sought, where a radian costs one: readings move before joints do."""


@dataclass(frozen=True)
class Bench:
    """A true instrument on a true arm: residuals of rows, and how they change with joints and readings."""

    problem: Problem
    evaluate: Batch
    z: Array
    """True local coordinates by row (N, nz)."""
    c: Array
    """Nominals that differ by label by row (N, nc)."""
    known: Array
    """Columns known from labels by row (N, k)."""
    faces: tuple[Face, ...]
    """The face of each row (N,); none where nothing flat is touched."""

    @property
    def read(self) -> int:
        """How many columns are read."""
        return len(self.problem.instrument.columns)

    def residual(self, free: Array, rows: Index) -> tuple[Array, Array]:
        """Residuals (k, m) of some rows at joints and readings (k, n), and their slopes (k, m, n)."""
        data = np.hstack([free, self.known[rows]])
        e, slopes = self.evaluate(self.z[rows], self.c[rows], data)
        return e, slopes.reshape(len(rows), data.shape[1], e.shape[1]).transpose(0, 2, 1)[:, :, : free.shape[1]]

    def beyond(self, free: Array, rows: Index) -> Array:
        """How far (k,; mm) the tips of some rows lie outside their faces."""
        if not self.faces:
            return np.zeros(len(rows))
        (tips,) = self.problem.model.batch.tip(self.z[rows], self.c[rows], np.hstack([free, self.known[rows]]))
        axes, centres, sizes = (
            np.array([getattr(self.faces[k], name) for k in rows]) for name in ("axes", "centre", "size")
        )
        along = np.abs(np.einsum("kx,kax->ka", tips - centres, axes[:, 1:]))
        return np.asarray(np.linalg.norm(np.maximum(along - sizes / 2, 0.0), axis=1))


def found(bench: Bench, target: Array, rng: np.random.Generator) -> Array:
    """Joints and readings (N, n) at which the residuals (N, m) are met, joints inside their limits.

    What is drawn does not depend on which rows wait, so that one that rounding decides leaves the others as they are.
    """
    robot, count = bench.problem.robot, len(target)
    n = len(robot.axes)
    lower, upper = robot.limits
    close = FITS * max(float(np.abs(target).max(initial=0.0)), 1e-3)
    free = np.full((count, n + bench.read), np.nan)
    waiting = np.arange(count)
    for _ in range(ROUNDS):
        reached, met = _met(bench, _starts(bench, target, waiting, rng), target[waiting], waiting, close)
        inside = ((reached[:, :n] >= lower) & (reached[:, :n] <= upper)).all(axis=1)
        good = met & inside & (bench.beyond(reached, waiting) < 1e-6)
        free[waiting[good]] = reached[good]
        waiting = waiting[~good]
        if not waiting.size:
            return free
    raise SimulationError(
        f"No posture inside the joint limits of '{robot.name}' makes the residual of "
        f"{type(bench.problem.instrument).__name__} vanish in {len(waiting)} of {count} rows",
        "Give its unknowns nominal values within the arm's reach, or give the instrument a `probe`",
    )


def _starts(bench: Bench, target: Array, rows: Index, rng: np.random.Generator) -> Array:
    """For each of some rows the random posture, readings at zero, that comes nearest; drawn for all rows (N, m)."""
    robot, instrument, count = bench.problem.robot, bench.problem.instrument, len(target)
    tried = random_joints(robot, count * CANDIDATES, rng).reshape(count, CANDIDATES, -1)
    among = CANDIDATES // 8  # one of the nearest few, so that touches do not crowd where the random postures do
    chosen = np.zeros(count, dtype=np.intp) if bench.read else rng.integers(among, size=count)
    begin = np.array([instrument.begins_at.get(name, 0.0) for name in instrument.columns])
    if bench.read:  # readings follow from any posture
        return np.hstack([tried[rows, 0], np.tile(begin, (len(rows), 1))])
    free, each = tried[rows].reshape(len(rows) * CANDIDATES, -1), np.repeat(rows, CANDIDATES)
    e, _ = bench.residual(free, each)
    miss = ((e - target[each]) ** 2).sum(axis=1)
    miss = (miss + bench.beyond(free, each) ** 2).reshape(len(rows), CANDIDATES)
    pick = np.argsort(miss, axis=1)[np.arange(len(rows)), chosen[rows]]
    return np.asarray(tried[rows, pick])


def _met(bench: Bench, start: Array, target: Array, rows: Index, close: float) -> tuple[Array, Rows]:
    """Where Gauss-Newton's smallest steps lead from the starts, and which rows arrive.

    Each row steps by itself, and only where that brings it nearer; else it tries half the way. Steps that are taken
    regardless wander so erratically that rounding decides where they end, and so whether a row arrives at all. Rows
    that have arrived rest.
    """
    free, part = start.copy(), np.ones(len(start))
    e, slopes = bench.residual(free, rows)
    size = _size(e - target)
    for _ in range(STEPS):
        moving = (np.abs(e - target) > close).any(axis=1)
        if not moving.any():
            break
        trial = free + _steps(bench, e - target, slopes) * part[:, None]
        trial_e, trial_slopes = bench.residual(trial, rows)
        trial_size = _size(trial_e - target)
        better = moving & (trial_size < size)
        free[better], e[better], slopes[better] = trial[better], trial_e[better], trial_slopes[better]
        size[better] = trial_size[better]
        part = np.where(better, np.minimum(1.0, 2 * part), part / 2)
    return free, np.asarray((np.abs(e - target) <= 1e3 * close).all(axis=1))


def _size(miss: Array) -> Array:
    """Squared lengths (k,) of residuals (k, m)."""
    return np.asarray((miss**2).sum(axis=1))


def _steps(bench: Bench, miss: Array, slopes: Array) -> Array:
    """The smallest steps (k, n) that would close residuals (k, m) if these were linear.

    They are cut to half a radian, of joints and of angles that are read: an orientation near half a turn asks for many,
    and a rotation vector of many turns hardly turns.
    """
    dimensions = bench.problem.instrument.columns.values()
    revolute = bench.problem.robot.revolute
    ease = np.concatenate([np.where(revolute, 1.0, 1.0 / SLOW), np.full(bench.read, 1.0 / SLOW)])
    scale = np.concatenate([ease[: len(revolute)], [1.0 if each == "angle" else np.inf for each in dimensions]])
    eased = slopes * ease
    gram = eased @ eased.transpose(0, 2, 1)
    floor = 1e-12 * np.einsum("kii->k", gram) + 1e-300
    gram += floor[:, None, None] * np.eye(gram.shape[1])
    step = -(eased.transpose(0, 2, 1) @ np.linalg.solve(gram, miss[..., None]))[..., 0] * ease
    largest = np.abs(step / scale).max(axis=1, initial=0.0)
    return np.asarray(step * np.minimum(1.0, 0.5 / np.maximum(largest, 1e-300))[:, None])

"""Where and how a simulated arm touches the faces of its cell."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.errors import SimulationError
from casacal.instruments.instrument import Probe
from casacal.problem.cell import Cell
from casacal.robots.joint_space import random_joints
from casacal.simulation.faults import form_error
from casacal.simulation.reach import Touch

EDGE = 0.05
"""Readings stay this part of the travel away from its ends."""

STARTS = 200
"""Random poses among which each target finds its start: its own, so that targets near one another differ in posture."""

ROUNDS = 60
"""Fresh targets tried for a touch before the face counts as out of reach."""


def find_touches(
    touch: Touch,
    probe: Probe,
    cell: Cell,
    which: NDArray[np.intp],
    lift: Array,
    rng: np.random.Generator,
    form_rng: np.random.Generator,
    growth: Array,
) -> tuple[Array, Array]:
    """Joint values (N, n) at which the tip truly touches, and the true readings (N,).

    lift: by how much each touch stands above its face, mm. growth: times (N,) that the tip is further from the base.
    """
    seeds = [int(form_rng.integers(2**32)) if cell.flatness > 0 else None for _ in cell.faces]
    joints, readings = np.full((len(which), len(touch.robot.axes)), np.nan), np.full(len(which), np.nan)
    waiting = np.arange(len(which))
    for _ in range(ROUNDS):
        found_joints, found_readings, good = try_touches(touch, probe, cell, which, lift, seeds, rng, waiting, growth)
        joints[waiting[good]], readings[waiting[good]] = found_joints[good], found_readings[good]
        waiting = waiting[~good]
        if not waiting.size:
            return joints, readings
    label = cell.faces[int(which[waiting[0]])].label
    raise SimulationError(
        f"'{touch.robot.name}' cannot touch face '{label}' within joint limits, tilt {math.degrees(cell.tilt):g} "
        f"degrees and the dial's travel ({len(waiting)} of {len(which)} samples are missing)",
        "Move or enlarge the face, or allow more tilt",
    )


def try_touches(
    touch: Touch,
    probe: Probe,
    cell: Cell,
    which: NDArray[np.intp],
    lift: Array,
    form_seeds: list[int | None],
    rng: np.random.Generator,
    waiting: NDArray[np.intp] | None = None,
    growth: Array | None = None,
    *,
    starts: int = STARTS,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """One try at each touch, or at those that wait: joint values, readings, and which of them succeeded.

    What is drawn does not depend on which touches wait, so that one touch that rounding decides leaves the others as
    they are. starts: random poses among which each finds where to begin.
    """
    count = len(which)
    growth = np.ones(count) if growth is None else growth
    axes = np.array([face.axes for face in cell.faces])[which]
    centres = np.array([face.centre for face in cell.faces])[which]
    half = np.array([face.size for face in cell.faces])[which] / 2
    travel = probe.travel if cell.travel is None else cell.travel
    readings = rng.uniform(EDGE, 1 - EDGE, count) * travel if probe.column is not None else np.zeros(count)
    uv = rng.uniform(-1, 1, size=(count, 2))
    targets = centres + np.einsum("ka,kax->kx", uv * half, axes[:, 1:])
    directions = _tilted(axes, cell.tilt, rng)
    poses = random_joints(touch.robot, count * starts, rng).reshape(count, starts, -1)
    if waiting is not None:
        which, lift, readings, uv = which[waiting], lift[waiting], readings[waiting], uv[waiting]
        growth = growth[waiting]
        axes, centres, half, targets, directions, poses = (
            each[waiting] for each in (axes, centres, half, targets, directions, poses)
        )
    joints = touch.reach(targets, directions, readings, touch.nearest(targets, directions, poses))
    joints, inside = touch.within_limits(joints)
    heights = lift + (axes[:, 0] * centres).sum(axis=1)
    for i, form_seed in enumerate(form_seeds):
        if form_seed is not None:
            here = which == i
            form_rng = np.random.default_rng(form_seed)
            heights[here] += form_error(form_rng, cell.flatness, uv[here], reach=cell.flatness_reach)
    heights = heights / growth  # where the arm without its growth stands as it touches
    joints = touch.land(joints, readings, axes[:, 0], heights)
    tip, direction, *_ = touch(joints, readings)
    offset = np.abs(np.einsum("kx,kax->ka", tip - centres, axes[:, 1:]))
    landed = np.abs((axes[:, 0] * tip).sum(axis=1) - heights) < 1e-7
    upright = -(axes[:, 0] * direction).sum(axis=1) >= math.cos(cell.tilt) - 1e-6
    turned, still = touch.within_limits(joints)
    good = inside & landed & upright & (offset <= half + 1e-6).all(axis=1) & still
    return np.where(np.abs(turned - joints) > 1.0, turned, joints), readings, good


def _tilted(axes: Array, tilt: float, rng: np.random.Generator) -> Array:
    """Directions (N, 3) into the faces, uniform over the cone of half-angle `tilt`."""
    cosine = rng.uniform(math.cos(tilt), 1.0, len(axes))
    sine, azimuth = np.sqrt(1 - cosine**2), rng.uniform(0, 2 * math.pi, len(axes))
    parts = np.column_stack([-cosine, sine * np.cos(azimuth), sine * np.sin(azimuth)])
    return np.asarray(np.einsum("ka,kax->kx", parts, axes))

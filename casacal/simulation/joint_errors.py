"""Where joints stand when the controller says where they are: waves of gears, sag, lag behind the last move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.robots.robot import Robot
from casacal.simulation.reach import Touch

ROUNDS = 60
"""Fixed-point steps; the steepest waves halve the miss with each, those of real gears end it in three."""


@dataclass(frozen=True)
class GearWave:
    """A wave of every joint that turns: amplitude (rad) * sin(order q + phase); amplitudes and phases by joint (n,)."""

    order: int
    amplitudes: tuple[float, ...]
    phases: tuple[float, ...]

    def __call__(self, joints: Array) -> Array:
        """How far joints (N, n) stand off, rad."""
        return np.asarray(np.array(self.amplitudes) * np.sin(self.order * joints + np.array(self.phases)))


def drawn_waves(robot: Robot, waves: Sequence[tuple[int, float]], rng: np.random.Generator) -> tuple[GearWave, ...]:
    """Waves of the given orders and amplitudes (rad), with random phases."""
    found = []
    for order, amplitude in waves:
        phases = rng.uniform(0, 2 * math.pi, len(robot.axes))
        found.append(GearWave(order, tuple((amplitude * robot.revolute).tolist()), tuple(phases.tolist())))
    return tuple(found)


def waved(waves: Sequence[GearWave], joints: Array) -> Array:
    """Joints (N, n) as they stand where the controller says `joints`."""
    return sum((wave(joints) for wave in waves), start=joints)


def unwaved(waves: Sequence[GearWave], joints: Array) -> Array:
    """What the controller says (N, n) where joints stand at `joints`: the inverse of `waved`."""
    said = joints
    for _ in range(ROUNDS if waves else 0):
        said, before = joints - (waved(waves, said) - said), said
        if np.array_equal(said, before):
            break
    return said


def yielding(touch: Touch, joints: Array, readings: Array) -> tuple[Array, Array]:
    """Deflections (N, n) of joints that yield to their own torque, J' of the tip's height, and the tip's moves (N,)."""
    _, _, slope, _ = touch(joints, readings)
    lever = slope[:, 2, :]
    found = -lever * touch.robot.revolute
    return found, np.linalg.norm(np.einsum("kai,ki->ka", slope, found), axis=1)


def last_moves(joints: Array) -> Array:
    """Ways (N, n) by which joints came, -1, 0 or 1: from row to row as they stand, to the first from all at zero."""
    return np.sign(np.diff(joints, axis=0, prepend=np.zeros((1, joints.shape[1]))))


def ways(
    joints: Array,
    turn: NDArray[np.intp],
    repeats: int,
    approach: Literal["same", "alternating", "random"],
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Ways by which joints (N, n) and plunger (N,) came to each row, -1, 0 or 1; of the plunger 1 is pushed in.

    joints: of each place (P, n), touched `repeats` times in a row. turn: the how manieth touch of its face a row is.
    """
    count, n = len(turn), joints.shape[1]
    if approach == "random":
        signs = rng.choice([-1.0, 1.0], size=(count, n + 1))
        return signs[:, :n], signs[:, n]
    if approach == "alternating":
        side = np.where(turn % 2 == 0, 1.0, -1.0)
        return np.repeat(side[:, None], n, axis=1), side
    return np.repeat(last_moves(joints), repeats, axis=0)[:count], np.ones(count)


def rounded(joints: Array, step: float) -> Array:
    """Joint values (N, n) in whole steps; 0 for none."""
    return np.asarray(np.round(joints / step) * step) if step > 0 else joints

"""Simulated non-geometric errors: gears, joint compliance, warmth, the dial, the form of faces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from casacal.errors import SimulationError
from casacal.model.robot import Robot
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.touches import TouchingArm
from casacal.values import Array, Index

TURN = 1.0  # reading of one turn of the pointer, mm
ROUNDS = 60
"""Fixed-point steps: the steepest waves halve the miss with each, and leave less than 1e-11 mm; real gears need 3."""


@dataclass(frozen=True)
class DialErrors:
    """Errors of one dial; lengths mm.

    A true way is (1 + gain) * shown + cycle * sin(2 pi shown / TURN + phase). What is shown lags by half the
    hysteresis, and grows by `drift` over a session.
    """

    gain: float = 0.0
    cycle: float = 0.0
    phase: float = 0.0
    hysteresis: float = 0.0
    drift: float = 0.0

    @staticmethod
    def drawn(cell: Cell, rng: np.random.Generator) -> DialErrors:
        """Errors of one dial, drawn for a cell."""
        gain, phase = cell.dial_gain * float(rng.normal()), float(rng.uniform(0, 2 * math.pi))
        return DialErrors(gain, cell.dial_cycle, phase, cell.hysteresis, cell.drift)

    def shown(self, ways: Array, came: Array, when: Array) -> Array:
        """Readings (N,) at travels (N,), approached upwards (1) or downwards (-1), at times 0 to 1 of a session."""
        shown = ways
        for _ in range(ROUNDS if self.gain or self.cycle else 0):
            wave = self.cycle * np.sin(2 * math.pi * shown / TURN + self.phase)
            shown = (ways - wave) / (1 + self.gain)
        return np.asarray(shown - came * self.hysteresis / 2 + self.drift * when)


@dataclass(frozen=True)
class GearWave:
    """A wave of every joint that turns: amplitude (rad) * sin(order q + phase); amplitudes and phases by joint (n,)."""

    order: int
    amplitudes: tuple[float, ...]
    phases: tuple[float, ...]

    def __call__(self, joints: Array) -> Array:
        """Deviations of joints (N, n) by the waves, rad."""
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
    """Controller joint values (N, n) at true joint values `joints`: the inverse of `waved`."""
    said = joints
    for _ in range(ROUNDS if waves else 0):
        said, before = joints - (waved(waves, said) - said), said
        if np.array_equal(said, before):
            break
    return said


def yielding(touch: TouchingArm, joints: Array, readings: Array) -> tuple[Array, Array]:
    """Deflections (N, n) of joints that yield to their own torque, J' of the tip's height, and the tip's moves (N,)."""
    _, _, slope, _ = touch(joints, readings)
    lever = slope[:, 2, :]
    found = -lever * touch.robot.revolute
    return found, np.linalg.norm(np.einsum("kai,ki->ka", slope, found), axis=1)


LEAST_PULL = 1e3
"""Moves of a tip (mm^2) below which no joint carries a weight: an upright SCARA that leans by milliradians has 1."""


def weighed(touch: TouchingArm, joints: Array, readings: Array) -> float:
    """RMS move (mm^2) of the tip as joints yield; raises SimulationError where none of them carries a weight."""
    pull = math.sqrt(float((yielding(touch, joints, readings)[1] ** 2).mean()))
    if pull < LEAST_PULL:
        raise SimulationError(
            "The cell has compliance, and no joint of this robot carries a weight, as with an upright SCARA",
            "Leave it out: what bends there is the arm itself, which is not simulated",
        )
    return pull


def gross_errors(cell: Disturbances, count: int, rng: np.random.Generator) -> Array:
    """Gross errors added to readings (N,), one to two outlier sizes; zero for other rows."""
    gross = rng.random(count) < cell.outliers
    return np.asarray(gross * rng.choice([-1.0, 1.0], size=count) * cell.outlier_size * rng.uniform(1, 2, count))


def last_moves(joints: Array) -> Array:
    """Ways (N, n) by which joints came, -1, 0 or 1: from row to row as they stand, to the first from all at zero."""
    return np.sign(np.diff(joints, axis=0, prepend=np.zeros((1, joints.shape[1]))))


def ways(
    joints: Array,
    turn: Index,
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


SOON = 3.0  # time constants of warming up in one session
SETTLED = 10  # rounds in which an arm settles under its weight: each leaves a thousandth of the last


@dataclass(frozen=True)
class ArmErrors:
    """Errors of one arm.

    waves: of its gears. compliance: sag over some touches, mm RMS. pull: move of the tip, mm^2 RMS over these, of
    joints that yield by J' of its height. thermal: growth from the first row of a session to the last, parts of one.
    """

    waves: tuple[GearWave, ...] = ()
    compliance: float = 0.0
    pull: float = 1.0
    thermal: float = 0.0

    def sag(self, touch: TouchingArm, joints: Array, readings: Array) -> Array:
        """Deflections (N, n) under gravity of joints that stand at `joints`."""
        if self.compliance == 0:
            return np.zeros_like(joints)
        return np.asarray(yielding(touch, joints, readings)[0] * self.compliance / self.pull)

    def growth(self, when: Array) -> Array:
        """Factors (N,) of the tip's distance from the base at times 0 ... 1 of a session."""
        return np.asarray(1 + self.thermal * (1 - np.exp(-SOON * when)) / (1 - math.exp(-SOON)))

    def tips(self, touch: TouchingArm, joints: Array, readings: Array, when: Array) -> Array:
        """True tips (N, 3; mm) where the controller says `joints` (N, n)."""
        unladen = waved(self.waves, joints)
        standing = unladen
        for _ in range(SETTLED if self.compliance else 0):
            standing = unladen + self.sag(touch, standing, readings)
        tips, _ = touch.place(touch.local, standing, readings[:, None])
        return tips * self.growth(when)[:, None]

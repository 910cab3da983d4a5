"""The axes of an arm as drawn, from its pose function: a product of exponentials, whatever it was written as."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.kernels.block_rows import Batch
from casacal.model.kinematics import stacked_poses
from casacal.model.robot import Robot, random_joints
from casacal.values import Array

EXACT = 1e-7  # miss (mm; rad) below which the axes reproduce the robot's pose


@dataclass(frozen=True)
class Axes:
    """T(q) = exp(S_1 u_1) ... exp(S_n u_n) T(0), u = mixing q: the product of exponentials of the arm as drawn.

    Lynch and Park, Modern Robotics, eq (4.14). turns: which joints turn (n,). directions: of the axes at q = 0 (n, 3).
    points: one on each axis (n, 3), mm. turn, place: T(0), rotation (3, 3) and position (3; mm). mixing: (n, n), the
    identity but for a pose function that couples joints itself.
    """

    turns: tuple[bool, ...]
    directions: Array
    points: Array
    turn: Array
    place: Array
    mixing: Array

    def poses(self, motions: Array) -> tuple[Array, Array]:
        """Rotations (..., 3, 3) and positions (..., 3; mm) at motions u (..., n; rad, mm) of the axes."""
        turn = np.broadcast_to(self.turn, (*motions.shape[:-1], 3, 3))
        place = np.broadcast_to(self.place, (*motions.shape[:-1], 3))
        for i in reversed(range(len(self.turns))):
            place = self.carry(i, motions[..., i], place)
            if self.turns[i]:
                turn = about(self.directions[i], motions[..., i]) @ turn
        return turn, place

    def carry(self, joint: int, motion: Array, points: Array) -> Array:
        """Points (..., 3; mm) moved by one joint through `motion` (...)."""
        direction = self.directions[joint]
        if not self.turns[joint]:
            return np.asarray(points + motion[..., None] * direction)
        # Rodrigues' formula on vectors
        arm = points - self.points[joint]
        c, s = np.cos(motion)[..., None], np.sin(motion)[..., None]
        along = (arm @ direction)[..., None] * direction
        x, y, z = direction
        cross = arm @ np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
        return np.asarray(self.points[joint] + along + c * (arm - along) + s * cross)


def axes_of(robot: Robot) -> Axes:
    """Find the axes of a robot at its nominal parameters from its pose function.

    Raises ProblemError when the pose is not one motion per joint (with joints coupled as the doctor's family knows).
    """
    n, count = len(robot.axes), 12
    q = ca.SX.sym("q", n)
    symbolic = ca.vec(ca.SX(robot.flange(SimpleNamespace(**robot.traced.drawn), q)))
    pose = Batch(ca.Function("pose", [q], [ca.densify(symbolic)]))
    slope = np.array(ca.Function("slope", [q], [ca.jacobian(symbolic, q)])(np.zeros(n)))
    tried = random_joints(robot, count, np.random.default_rng(0))
    at_zero, *poses = stacked_poses(pose(np.vstack([np.zeros(n), tried]))[0])
    turns = tuple(robot.revolute.tolist())
    for mixing in _mixings(turns):
        found = _screws(turns, slope, at_zero, mixing)
        if found is None:
            continue
        turn, place = found.poses(tried @ mixing.T)
        wanted = np.array(poses)
        if np.abs(place - wanted[:, :3, 3]).max() < EXACT and np.abs(turn - wanted[:, :3, :3]).max() < EXACT:
            return found
    fix = "Give the doctor a pose without gears or links"
    raise ProblemError(f"The pose of '{robot.name}' is not one turn or slide per joint", fix)


def _mixings(turns: tuple[bool, ...]) -> Iterator[Array]:
    """Candidate couplings of joints in a pose function: none, one, or several neighbours."""
    n = len(turns)
    yield np.eye(n)
    alike = [(i, j) for i in range(n) for j in range(n) if i != j and turns[i] and turns[j]]
    for (i, j), factor in itertools.product(alike, (-1.0, 1.0)):
        mixing = np.eye(n)
        mixing[i, j] = factor
        yield mixing
    pairs = [(i, i - 1) for i in range(1, n) if (i, i - 1) in alike]
    for factors in itertools.product((0.0, -1.0, 1.0), repeat=len(pairs)):
        if sum(factor != 0 for factor in factors) > 1:
            mixing = np.eye(n)
            for (i, j), factor in zip(pairs, factors, strict=True):
                mixing[i, j] = factor
            yield mixing


def _screws(turns: tuple[bool, ...], slope: Array, at_zero: Array, mixing: Array) -> Axes | None:
    """Axes from the slope of the pose at q = 0, or None when they are not those of turns and slides."""
    turn, place = at_zero[:3, :3], at_zero[:3, 3]
    by_axis = slope @ np.linalg.inv(mixing)
    directions, points = [], []
    for turning, column in zip(turns, by_axis.T, strict=True):
        rate = column.reshape(4, 4).T
        spin = rate[:3, :3] @ turn.T
        omega, velocity = np.array([spin[2, 1], spin[0, 2], spin[1, 0]]), rate[:3, 3]
        size = np.linalg.norm(omega if turning else velocity)
        pitch = abs(omega @ velocity) if turning else np.linalg.norm(omega)
        if abs(size - 1) > EXACT or pitch > EXACT * 1e3:
            return None
        directions.append(omega if turning else velocity)
        points.append(place + np.cross(omega, velocity))
    return Axes(turns, np.array(directions), np.array(points), turn, place, mixing)


def about(direction: Array, angles: Array) -> Array:
    """Rotations (..., 3, 3) about a unit direction (3,)."""
    x, y, z = direction
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    c, s = np.cos(angles)[..., None, None], np.sin(angles)[..., None, None]
    return np.asarray(np.eye(3) + s * cross + (1 - c) * (cross @ cross))

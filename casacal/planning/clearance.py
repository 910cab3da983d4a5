"""Whether an arm keeps clear: of boxes where nothing may be, of the faces that its tip alone touches, of itself.

The arm is a chain of rods between its axes, as thick as is said; see `casacal.robots.links`. Points along the rods are
looked at, so that what is closer than half a spacing may pass unseen: give the links a little more than they measure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.errors import CasacalError
from casacal.robots.links import nodes_of
from casacal.robots.robot import Robot
from casacal.simulation.cell import Cell
from casacal.uncertainty.expectation import Box
from casacal.values import Value, is_real

ALONG = 12  # points looked at on every rod, its ends among them


@dataclass(frozen=True, eq=False)
class Clearance(Value):
    """What an arm must keep clear of.

    boxes: ranges of x, y, z (mm, base frame) where neither arm nor tool may be. link_radius: how thick its links are,
    mm, or None where only its tip and flange are looked at. The last link and the tool may come near a face.
    """

    boxes: tuple[Box, ...] = ()
    link_radius: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "boxes", tuple(self.boxes))
        for box in self.boxes:
            try:
                low, high = np.array(box, dtype=np.float64).T
                sound = low.shape == (3,) and bool((low < high).all())
            except (TypeError, ValueError):
                sound = False
            if not sound:
                raise CasacalError(f"The box to keep out of is {box!r}", "Give ranges of x, y and z in mm, each rising")
        radius = self.link_radius
        if radius is not None and not (is_real(radius) and 0 < radius < math.inf):
            raise CasacalError(f"The links' radius is {radius!r}", "Give a positive number of mm")

    def clear(self, robot: Robot, cell: Cell | None, joints: Array, tips: Array) -> NDArray[np.bool_]:
        """Which postures (N, n; rad, mm) keep clear, whose tips (N, 3, mm) touch faces of a cell."""
        good = np.ones(len(joints), dtype=bool)
        if not self.boxes and self.link_radius is None:
            return good
        nodes = nodes_of(robot, joints)
        rods = np.concatenate([nodes, tips[:, None]], axis=1)
        if self.link_radius is None:
            return good & ~_inside(rods[:, -2:], self.boxes, 0.0)
        part = np.linspace(0, 1, ALONG)[:, None]
        points = rods[:, :-1, None] * (1 - part) + rods[:, 1:, None] * part  # on rods: (N, rods, ALONG, 3)
        count, radius = len(joints), self.link_radius
        good &= ~_inside(points.reshape(count, -1, 3), self.boxes, radius)
        if cell is not None:
            arm = points[:, :-2].reshape(count, -1, 3)  # the last link holds the tool, which is what touches
            for face in cell.faces:
                good &= ~near_face(arm, np.asarray(face.centre), face.axes, np.asarray(face.size) / 2, radius)
        return good & ~_near_itself(points, radius)


def _inside(points: Array, boxes: Sequence[Box], radius: float) -> NDArray[np.bool_]:
    """Whether any point (N, k, 3) is nearer to a box than a radius."""
    found = np.zeros(len(points), dtype=bool)
    for box in boxes:
        low, high = np.array(box, dtype=np.float64).T
        beyond = np.maximum(np.maximum(low - points, points - high), 0.0)
        found |= (np.linalg.norm(beyond, axis=2) <= radius).any(axis=1)
    return found


def near_face(points: Array, centre: Array, axes: Array, half: Array, radius: float) -> NDArray[np.bool_]:
    """Whether any point (N, k, 3) is nearer to a rectangular face than a radius, or behind it."""
    local = (points - centre) @ axes.T
    aside = np.linalg.norm(np.maximum(np.abs(local[..., 1:]) - half, 0.0), axis=-1)
    near = np.hypot(aside, np.maximum(local[..., 0], 0.0)) <= radius
    behind = (local[..., 0] < 0) & (aside <= radius) & (local[..., 0] > -2 * radius)
    return np.asarray((near & (local[..., 0] >= 0) | behind).any(axis=1))


def _near_itself(points: Array, radius: float) -> NDArray[np.bool_]:
    """Whether rods that do not follow one another are nearer than two radii; those shorter than that are no rods."""
    count, rods = points.shape[:2]
    found = np.zeros(count, dtype=bool)
    long = [k for k in range(rods) if float(np.linalg.norm(points[0, k, -1] - points[0, k, 0])) > 2 * radius]
    for place, first in enumerate(long):
        for second in long[place + 2 :]:
            apart = np.linalg.norm(points[:, first, :, None] - points[:, second, None], axis=-1)
            found |= (apart < 2 * radius).any(axis=(1, 2))
    return found

"""The order in which postures are visited: a short way through the joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.robots.joint_space import AXIS_WEIGHT
from casacal.robots.robot import Robot

SWEEPS = 40
"""Times that all pairs of steps are looked at."""


def shortest_way(robot: Robot, joints: Array) -> NDArray[np.intp]:
    """An order (N,) of postures (N, n; rad, mm) that is short: the nearest next, then crossings undone (2-opt).

    What counts is the joint that has furthest to go, which takes longest; `AXIS_WEIGHT` mm of a sliding joint count as
    a radian. It begins at the posture that is nearest to mid-range.
    """
    count = len(joints)
    if count < 2:
        return np.arange(count)
    places = joints / np.where(robot.revolute, 1.0, AXIS_WEIGHT)
    middle = np.mean(robot.limits, axis=0) / np.where(robot.revolute, 1.0, AXIS_WEIGHT)
    apart = np.abs(places[:, None] - places).max(axis=2)
    order = [int(np.abs(places - middle).max(axis=1).argmin())]
    left = set(range(count)) - set(order)
    while left:
        here = np.array(sorted(left))
        order.append(int(here[apart[order[-1], here].argmin()]))
        left.remove(order[-1])
    return _uncrossed(np.array(order), apart)


def length_of(robot: Robot, joints: Array) -> float:
    """How far the joint that has furthest to go goes from posture to posture (N, n), all steps together, rad."""
    places = joints / np.where(robot.revolute, 1.0, AXIS_WEIGHT)
    return float(np.abs(np.diff(places, axis=0)).max(axis=1).sum())


def _uncrossed(order: NDArray[np.intp], apart: Array) -> NDArray[np.intp]:
    """The same with parts of the way turned round while that makes it shorter; the first posture stays."""
    count = len(order)
    for _ in range(SWEEPS):
        shorter = False
        for i in range(count - 2):
            j = np.arange(i + 2, count)
            after = np.append(apart[order[i + 1], order[j[:-1] + 1]], 0.0)
            before = np.append(apart[order[j[:-1]], order[j[:-1] + 1]], 0.0)
            change = apart[order[i], order[j]] + after - apart[order[i], order[i + 1]] - before
            best = int(change.argmin())
            if change[best] < -1e-12:
                order[i + 1 : j[best] + 1] = order[i + 1 : j[best] + 1][::-1].copy()
                shorter = True
        if not shorter:
            break
    return order

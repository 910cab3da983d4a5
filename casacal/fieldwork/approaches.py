"""The way from touch to touch: to a place above each, down to it, and back, clear of the faces all along."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array, Rows
from casacal.errors import CasacalError
from casacal.planning.choice import cell_of, drawn_touch
from casacal.planning.clearance import Clearance
from casacal.planning.route import Route
from casacal.problem.problem import Problem
from casacal.robots.joint_space import inside_limits
from casacal.robots.links import above_table
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.reach import TouchingArm
from casacal.values import Value

RETREAT = 20.0  # how far the tip stands back before and after a touch, mm
HIGHER = (1.0, 2.0, 4.0, 8.0)
"""Times of that by which it is tried to stand back where the way between two touches is not clear."""

MOST_PLACES = 40  # places through which a way is tried
ON_THE_WAY = 60  # postures looked at between two touches
FREE = 2.0  # how near the tip may come to a face between touches, mm
ARRIVED = 0.05  # by how much a place above may be missed, mm

Clear = Callable[[Array, Array], bool]  # whether the way from one posture (n,) to another keeps clear


@dataclass(frozen=True, eq=False)
class Approaches(Value):
    """Joint values (N, n; rad, mm) above each touch, and whether the way from the touch before it is clear (N,).

    retreat: how far above (N,), mm. via: joint values (N, n) through which the way leads, NaN where it is straight.
    Of a touch from which the arm cannot draw back all are NaN, and it is not clear; the way leads past it.
    """

    above: Array
    retreat: Array
    via: Array
    clear: NDArray[np.bool_]


def approaches(
    problem: Problem,
    route: Route,
    cell: Disturbances | None = None,
    *,
    retreat: float = RETREAT,
    clearance: Clearance | None = None,
) -> Approaches:
    """Where to stand before and after each touch of a plan, the plunger drawn back along itself.

    Where the straight way of the joints from one to the next would come near a face, both stand back further, up to
    eight times as far; then it leads through a place high above another touch. What is not clear then is said.

    Raises CasacalError for an instrument without a plunger, and where the arm can draw back from no touch.
    """
    probe = problem.instrument.probe
    if probe is None:
        fix = "Use the plan's CSV"
        raise CasacalError(f"{type(problem.instrument).__name__} has no plunger that could be drawn back", fix)
    still = cell_of(problem, cell)
    samples = route.samples
    arm, readings, tips, axes = drawn_touch(problem, probe, samples)
    levels = [_above(arm, samples.joints, readings, tips, axes, retreat * times) for times in HIGHER]
    back = np.isfinite(levels[0]).all(axis=1)
    if not back.any():
        what = f"From no touch can the arm draw back by {retreat:g} mm inside its joint limits"
        raise CasacalError(what, "Give a smaller --retreat")
    levels = [level[back] for level in levels]
    chosen, clear = np.zeros(int(back.sum()), dtype=int), np.ones(int(back.sum()), dtype=bool)
    if isinstance(still, Cell):
        stands = above_table(problem.robot, still.table, (clearance and clearance.link_radius) or 0.0)
        is_clear = partial(_is_clear, arm, still, clearance, stands)
        for k in range(1, len(clear)):
            clear[k] = _raised(is_clear, levels, chosen, k)
    above = np.array([levels[level][k] for k, level in enumerate(chosen)])
    via = np.full_like(above, np.nan)
    if isinstance(still, Cell):
        places = levels[-1][np.isfinite(levels[-1]).all(axis=1)]
        for k in np.flatnonzero(~clear).tolist():
            found = _through(is_clear, places, above[k - 1], above[k])
            if found is not None:
                via[k], clear[k] = found, True

    def of_all(found: Array) -> Array:
        whole = np.full((len(samples), *found.shape[1:]), np.nan)
        whole[back] = found
        return whole

    return Approaches(of_all(above), of_all(retreat * np.array(HIGHER)[chosen]), of_all(via), of_all(clear) == 1)


def _through(clear: Clear, places: Array, start: Array, end: Array) -> Array | None:
    """A place by which the way is clear, the one with the shortest way first; None where there is none."""
    ways = np.abs(places - start).max(axis=1) + np.abs(places - end).max(axis=1)
    for k in np.argsort(ways)[:MOST_PLACES]:
        if clear(start, places[k]) and clear(places[k], end):
            return np.asarray(places[k])
    return None


def _raised(clear: Clear, levels: list[Array], chosen: NDArray[np.intp], k: int) -> bool:
    """Raise both ends of the way to touch k until it is clear; whether it is."""
    for level in range(len(levels)):
        ends = [max(int(chosen[k - 1]), level), max(int(chosen[k]), level)]
        start, end = levels[ends[0]][k - 1], levels[ends[1]][k]
        if not (np.isfinite(start).all() and np.isfinite(end).all()):
            return False
        if clear(start, end):
            chosen[k - 1], chosen[k] = ends
            return True
    return False


def _is_clear(
    arm: TouchingArm,
    cell: Cell,
    clearance: Clearance | None,
    stands: Callable[[Array, Array], Rows],
    start: Array,
    end: Array,
) -> bool:
    """Whether the straight way of the joints between two postures keeps off faces, table and all else that is said."""
    part = np.linspace(0, 1, ON_THE_WAY)[:, None]
    joints = start * (1 - part) + end * part
    tips, _ = arm.place(arm.local, joints, np.zeros((len(joints), 1)))
    for face in cell.faces:
        local = (tips - face.centre) @ face.axes.T
        over = (np.abs(local[:, 1:]) <= np.asarray(face.size) / 2 + FREE).all(axis=1)
        height = local[over, 0]
        if (height < FREE).any() and not (height < -FREE).all():  # wholly behind it, it is another side's matter
            return False
    if not stands(joints, tips).all():
        return False
    return clearance is None or bool(clearance.clear(arm.robot, None, joints, tips).all())


def _above(arm: TouchingArm, joints: Array, readings: Array, tips: Array, axes: Array, retreat: float) -> Array:
    """Joint values (N, n) with the tip drawn back along the plunger; NaN where limits or reach forbid it."""
    targets = tips - retreat * axes
    found = arm.reach(targets, axes, readings, joints)
    reached, _ = arm.place(arm.local, found, readings[:, None])
    good = (np.linalg.norm(reached - targets, axis=1) < ARRIVED) & inside_limits(arm.robot, found)
    return np.where(good[:, None], found, np.nan)

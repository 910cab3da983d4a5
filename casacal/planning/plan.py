"""A plan: which touches to make so that the tip is known best where it is wanted, and in which order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.errors import CasacalError, came
from casacal.planning.exchange import Chosen, error_of, exchange
from casacal.planning.way import shortest_way
from casacal.problem.cell import Cell
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.places import default_cell
from casacal.simulation.simulate import simulate
from casacal.uncertainty.expectation import Box, joints_in_box
from casacal.uncertainty.workspace import up_to_base, workspace_joints
from casacal.values import FrozenMapping, Value, is_real

FIT, AGAIN, CHECK = "fit", "again", "check"
"""What a touch is for: to be fitted; to be made a second time at the end; never to be fitted, but judged."""

UNKNOWN = 1e-9
"""Information, in units of what filters start from, of what nobody knows beforehand."""

DRAWS = 8
"""Random plans of as many touches, for comparison."""


@dataclass(frozen=True, eq=False)
class Plan(Value):
    """Touches in the order in which they should be made, with the readings to expect there.

    samples: postures (N, n; rad, mm), what the instrument would read on the arm as drawn, and labels. purposes: of each
    (N,), "fit", "again" or "check". error: tip error to expect, mm RMS over what was asked for, apart from where the
    base stands. before: the same without any touch. at_random: of as many touches that nobody chose, the median of
    some. best: of all touches among which was chosen. curve: error by number of fitted touches.
    """

    samples: Samples
    purposes: tuple[str, ...]
    error: float
    before: float
    at_random: float
    best: float
    curve: Mapping[int, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "curve", FrozenMapping(self.curve))

    def __len__(self) -> int:
        return len(self.purposes)

    def __repr__(self) -> str:
        return f"<Plan of {len(self)} touches: expect {self.error:.3g} mm, at random {self.at_random:.3g} mm>"


def plan(
    problem: Problem,
    cell: Disturbances | None = None,
    *,
    touches: int = 60,
    pool: int = 3000,
    starts: int = 2,
    again: float = 0.05,
    check: float = 0.15,
    box: Box | None = None,
    targets: Array | None = None,
    seed: int = 0,
) -> Plan:
    """Choose touches that leave the least mean squared error of the tip (I-optimal), among many that can be made.

    The arm as drawn makes them, inside joint limits, tilt and travel of the cell; stated noise and priors are trusted.
    From random beginnings single touches are exchanged until none is better.

    Args:
        problem: a robot with one instrument.
        cell: where its faces are, and how far the tool may tilt; by default as `simulate` has it.
        touches: how many in all.
        pool: among how many they are chosen.
        starts: random beginnings, of which the best is taken.
        again: part of them that repeats others at the end, which shows noise and drift.
        check: part of them that is drawn at random and not to be fitted, for `verify`.
        box: ranges of x, y, z in the base frame (mm) in which the tip is wanted; by default the whole workspace.
        targets: joint values (M, n; rad, mm) at which it is wanted, in place of a box.
        seed: of everything that is drawn.

    Raises CasacalError for numbers that make no plan, SimulationError where faces are out of reach.

    """
    _check(problem, touches, pool, starts, again, check, box, targets)
    reachable = reachable_touches(problem, cell, pool, seed)
    bound = bind(problem, reachable)
    choice = _Choice.of(bound, _wanted(bound, box, targets))
    checks, repeats = round(check * touches), round(again * touches)
    fitted = touches - checks - repeats
    rng = np.random.default_rng([seed, 1])
    best = choice.best_of(fitted, starts, rng)
    twice = best[np.linspace(0, len(best) - 1, repeats).astype(int)] if repeats else best[:0]
    fresh = rng.choice(np.setdiff1d(np.arange(pool), best), checks, replace=False)
    way = shortest_way(problem.robot, reachable.joints[np.concatenate([best, fresh])])
    order = np.concatenate([np.concatenate([best, fresh])[way], twice])
    purposes = [FIT] * len(best) + [CHECK] * checks
    draws = [choice.error(rng.choice(pool, len(best), replace=False)) for _ in range(DRAWS)]
    return Plan(
        replace(reachable.take(order), lines=tuple(range(1, len(order) + 1))),
        (*(purposes[k] for k in way), *[AGAIN] * repeats),
        choice.error(np.concatenate([best, twice])),
        choice.error(best[:0]),
        float(np.median(draws)),
        choice.error(np.arange(pool)),
        choice.curve(best, rng),
    )


def touches_for(
    problem: Problem,
    cell: Disturbances | None,
    tolerance: float,
    *,
    box: Box | None = None,
    targets: Array | None = None,
    most: int = 240,
) -> int:
    """About the fewest touches to be fitted that bring the expected tip error below a tolerance, mm RMS.

    box, targets: where the tip is wanted, as for `plan`. Raises CasacalError where so many as `most` do not.
    """
    _check(problem, 3, 3, 1, 0.0, 0.0, box, targets)
    if not (is_real(tolerance) and 0 < tolerance < math.inf):
        raise CasacalError(f"{came(tolerance)} came as the tolerance", "Give a positive number of mm")
    bound = bind(problem, reachable_touches(problem, cell, 1000, 0))
    choice, rng = _Choice.of(bound, _wanted(bound, box, targets)), np.random.default_rng(0)
    count = 12
    while count < most:
        if choice.error(choice.best_of(count, 1, rng)) <= tolerance:
            return count
        count = min(math.ceil(count * 1.25), most)
    left = choice.error(choice.best_of(most, 1, rng))
    if left <= tolerance:
        return most
    raise CasacalError(
        f"{most} touches that were chosen best leave {left:.3g} mm, more than {tolerance:g} mm",
        "Ask for less, measure with less noise, or add a face, a step or another instrument",
    )


@dataclass(frozen=True)
class _Choice:
    """Measurements among which is chosen, in units of what each unknown may be."""

    rows: Array
    known: Array
    weight: Array

    @staticmethod
    def of(bound: BoundProblem, joints: Array) -> _Choice:
        """Of a pool at the drawing, for a tip that is wanted at some joint values (M, n)."""
        units, frame = bound.start_std, workspace_joints(bound.problem.robot)
        sets = [(bound.tips(bound.x0, q), bound.tip_jacobian(bound.x0, q)) for q in (joints, frame)]
        field = up_to_base(sets[0][1], sets[0][0], sets[1][1], sets[1][0]) * units
        rows = (bound.jacobian(bound.x0) * units).reshape(len(bound.measured), -1, bound.unknowns)
        known = np.diag(np.maximum(bound.prior_information * units**2, UNKNOWN))
        return _Choice(rows, known, field.T @ field / len(joints))

    def error(self, chosen: Chosen) -> float:
        """Tip error (mm RMS) that some measurements leave."""
        return error_of(self.rows[chosen], self.known, self.weight)

    def best_of(self, count: int, starts: int, rng: np.random.Generator) -> Chosen:
        """So many measurements, the best of some exchanges."""
        begins = [rng.choice(len(self.rows), count, replace=False) for _ in range(starts)]
        found = [exchange(self.rows, self.known, self.weight, begin) for begin in begins]
        return min(found, key=lambda each: each.error).rows

    def curve(self, best: Chosen, rng: np.random.Generator) -> dict[int, float]:
        """Error by number of measurements: half and a quarter as many, these, and half as many again."""
        counts = sorted({max(round(len(best) * part), 3) for part in (0.25, 0.5, 0.75, 1.5)} - {len(best)})
        others = {count: self.error(self.best_of(count, 1, rng)) for count in counts if count <= len(self.rows)}
        return dict(sorted({**others, len(best): self.error(best)}.items()))


def _check(
    problem: Problem, touches: int, pool: int, starts: int, again: float, check: float, box: Box | None, targets: object
) -> None:
    if not isinstance(problem, Problem):
        raise CasacalError(f"{came(problem)} came as the problem", "Give a Problem; load_problem(path).problem is one")
    if len(problem.instruments) > 1:
        names = ", ".join(problem.names)
        raise CasacalError(f"A plan is for one instrument, and there are {names}", "Plan for problem.measured_by(name)")
    for what, value, least in (("touches", touches, 3), ("pool", pool, touches), ("starts", starts, 1)):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
            raise CasacalError(f"{came(value)} came as the {what}", f"Give a whole number from {least} on")
    for what, part in (("again", again), ("check", check)):
        if not (is_real(part) and 0 <= part < 1):
            raise CasacalError(f"{came(part)} came as the part '{what}'", "Give a number from 0 to below 1")
    if touches - round(check * touches) - round(again * touches) < 3:
        raise CasacalError(f"Of {touches} touches fewer than three are fitted", "Ask for more, or check fewer")
    if box is not None and targets is not None:
        raise CasacalError("A box and targets came", "Give one of them")


def reachable_touches(problem: Problem, cell: Disturbances | None, count: int, seed: int) -> Samples:
    """Touches that the arm as drawn could make, without any error."""
    if cell is None and problem.instrument.probe is not None:
        cell = default_cell(problem)
    still = Disturbances()
    if isinstance(cell, Cell):
        still = Cell(faces=cell.faces, tilt=cell.tilt, travel=cell.travel)
    still = replace(still, error_scale=0.0, repeatability=0.0, resolution=0.0)
    return simulate(problem, still, samples=count, seed=seed).samples


def _wanted(bound: BoundProblem, box: Box | None, targets: Array | None) -> Array:
    """Joint values (M, n) at which the tip is wanted."""
    if box is not None:
        return joints_in_box(bound, bound.x0, box)
    if targets is None:
        return workspace_joints(bound.problem.robot)
    joints = np.atleast_2d(np.asarray(targets, dtype=np.float64))
    if joints.shape[1] != len(bound.problem.robot.axes) or not np.isfinite(joints).all():
        raise CasacalError(
            f"Targets came with the shape {np.shape(targets)}",
            f"Give finite joint values (M, {len(bound.problem.robot.axes)}) in rad and mm",
        )
    return joints

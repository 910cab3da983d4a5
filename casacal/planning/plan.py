"""A plan: which touches to make so that the tip is known best where it is wanted, and in which order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.nominal import nominal_tips
from casacal.binding.slots import instances, make_slots
from casacal.errors import CasacalError, came, refuse_unknown
from casacal.planning.choice import Choice, cell_of, pool_of, refuse_several, seldom, wanted_joints
from casacal.planning.clearance import Clearance
from casacal.planning.exchange import Chosen, Criterion
from casacal.planning.route import AGAIN, CHECK, FIT, Route, shortest_way
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples, joined
from casacal.simulation.cell import Cell, Disturbances
from casacal.uncertainty.expectation import Box
from casacal.values import FrozenMapping, is_real
from casacal.wording import html_table

DRAWS = 8  # random plans of as many touches, for comparison; draws of what is lost
LOST = 0.1  # part of the fitted touches of which it is said what losing them costs
ARMS = 5  # arms that the prior allows, over which an error is averaged


@dataclass(frozen=True, eq=False)
class Plan(Route):
    """Touches in the order in which they should be made, with the readings to expect there.

    samples, purposes: as of every `Route`. error: tip error to expect, mm RMS over what was asked for, apart from where
    the base stands. before: the same without any touch. at_random: of as many touches that nobody chose, the median of
    some. best: of all touches among which was chosen. curve: error by number of fitted touches. if_lost: error when a
    tenth of the fitted touches is lost, the mean of some draws. over_arms: error averaged over arms that the prior
    allows, where the drawing errs. cell: its faces, where there are any, and the table that nothing goes below.
    """

    error: float
    before: float
    at_random: float
    best: float
    curve: Mapping[int, float]
    if_lost: float = math.nan
    over_arms: float = math.nan
    cell: Disturbances = Disturbances()

    def __post_init__(self) -> None:
        object.__setattr__(self, "curve", FrozenMapping(self.curve))

    def __repr__(self) -> str:
        return f"<Plan of {len(self)} touches: expect {self.error:.3g} mm, at random {self.at_random:.3g} mm>"

    def _repr_html_(self) -> str:
        """Tip error to expect by number of fitted touches, mm RMS: what a notebook shows."""
        rows = [(count, f"{error:.3g}") for count, error in self.curve.items()]
        return html_table(repr(self), ("fitted touches", "expected tip error, mm RMS"), rows)


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
    criterion: Literal["tip", "parameters"] = "tip",
    clearance: Clearance | None = None,
    after: Samples | None = None,
    loose: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Plan:
    """Choose touches that leave the least mean squared error of the tip (I-optimal), among many that can be made.

    The arm as drawn makes them, inside joint limits, tilt and travel of the cell; stated noise and priors are trusted.
    From random beginnings single touches are exchanged until none is better.

    Args:
        problem: a robot with one instrument.
        cell: where its faces and the table are, and how far the tool may tilt; by default as `simulate` has it.
        touches: how many in all.
        pool: among how many they are chosen.
        starts: random beginnings, of which the best is taken.
        again: part of them that repeats others at the end, which shows noise and drift.
        check: part of them that is drawn at random and not to be fitted, for `verify`.
        box: ranges of x, y, z in the base frame (mm) in which the tip is wanted; by default the whole workspace.
        targets: joint values (M, n; rad, mm) at which it is wanted, in place of a box.
        criterion: "tip" as above, or "parameters" for the least volume of what the unknowns may be (D-optimal).
        clearance: what the arm must keep clear of beside the table; by default its links are not looked at.
        after: touches that were made already; those of the plan come on top of them.
        loose: what may have moved since they were made, by the name of the unknown: standard deviation, rad or mm. The
            fewest touches that restore the zero of a joint after its motor was changed are found so.
        seed: of everything that is drawn.

    Raises CasacalError for numbers that make no plan, SimulationError where faces are out of reach.

    """
    refuse_several(problem, "A plan is for one instrument", "Plan for", box, targets)
    _refuse(touches, pool, starts, again, check)
    refuse_unknown("criterion", [criterion], (each.value for each in Criterion))
    wanted = Criterion(criterion)
    still = _placed(problem, cell_of(problem, cell), after)
    reachable = pool_of(problem, still, pool, seed, clearance)
    bound = bound_pool(problem, reachable, after, loose)
    choice_at = partial(Choice.of, bound, wanted_joints(bound, box, targets), count=pool, loose=loose)
    choice = choice_at()
    checks, repeats = round(check * touches), round(again * touches)
    rng = np.random.default_rng([seed, 1])
    best, few = _enough_of_each(problem, reachable, choice, touches - checks - repeats, starts, rng, wanted)
    twice = best[np.linspace(0, len(best) - 1, repeats).astype(int)] if repeats else best[:0]
    left = np.setdiff1d(np.flatnonzero(~few) if after is None else np.arange(pool), best)
    fresh = kept_to_verify(problem.without_terms, reachable, left, checks, rng)
    way = shortest_way(problem.robot, reachable.joints[np.concatenate([best, fresh])])
    order = np.concatenate([np.concatenate([best, fresh])[way], twice])
    purposes = [FIT] * len(best) + [CHECK] * len(fresh)
    draws = [choice.error(rng.choice(pool, len(best), replace=False)) for _ in range(DRAWS)]
    fitted = np.concatenate([best, twice])
    std = np.where(np.isfinite(bound.prior_std), bound.prior_std, 0.0)
    arms = bound.x0 + std * np.random.default_rng([seed, 2]).normal(size=(ARMS, std.size))
    over_arms = [choice_at(at=arm).error(fitted) for arm in arms]
    return Plan(
        replace(reachable.take(order), lines=tuple(range(1, len(order) + 1))),
        (*(purposes[k] for k in way), *[AGAIN] * repeats),
        choice.error(fitted),
        choice.error(best[:0]),
        float(np.median(draws)),
        choice.error(np.arange(pool)),
        choice.curve(best, rng, wanted),
        choice.lost(best, LOST, DRAWS, rng),
        float(np.sqrt(np.mean(np.square(over_arms)))),
        still,
    )


ASTRAY = 50.0  # mm that a face may be off where a cell has it, before touches of it would be planned in the air


def _placed(problem: Problem, cell: Disturbances, after: Samples | None) -> Disturbances:
    """The cell; raises CasacalError where touches that were made lie far from the face that they are said to be on."""
    if not isinstance(cell, Cell) or not isinstance(after, Samples):
        return cell
    after.check(problem.layout())
    tips, rows = nominal_tips(problem, 0, after), after.faces(problem.instrument.groups).rows()
    for face in cell.faces:
        touched = rows.get(face.label, np.zeros(0, dtype=int))
        off = float(np.median((tips[touched] - face.centre) @ face.axes[0])) if len(touched) else 0.0
        if abs(off) > ASTRAY:
            what = f"Touches of '{face.label}' in {after.file} lie {abs(off):.0f} mm from where the cell has that face"
            raise CasacalError(
                what, "Say where the faces are (cell in the problem file), or on which table (--table Z)"
            )
    return cell


def _enough_of_each(
    problem: Problem,
    pool: Samples,
    choice: Choice,
    count: int,
    starts: int,
    rng: np.random.Generator,
    criterion: Criterion,
) -> tuple[Chosen, NDArray[np.bool_]]:
    """The best plan that touches each of its faces often enough to say where it is, and what it leaves out (N,).

    Fewer touches of a face tell nothing of the arm, so that an exchange leaves them where they were at random.
    """
    best, barred = choice.best_of(count, starts, rng, criterion), np.zeros(len(pool), dtype=bool)
    while True:
        few, least = seldom(problem, pool, best)
        barred = barred | least
        if not least.any() or (~barred).sum() < 2 * count:
            return best, few if (~few).sum() >= 2 * count else np.zeros(len(pool), dtype=bool)
        best = choice.best_of(count, starts, rng, criterion, barred)


TRIES = 20  # draws of what is kept to verify, until one places all that it touches


def kept_to_verify(problem: Problem, pool: Samples, left: Chosen, count: int, rng: np.random.Generator) -> Chosen:
    """So many of the measurements that are left, drawn at random, of as many faces, points or anchors as they place.

    `verify` finds each of these anew from its own rows, and takes none with fewer than that needs. Where no draw
    suffices for one, it is any.
    """
    drawn = rng.choice(left, min(count, len(left)), replace=False)
    instrument, groups = problem.instrument, [left]
    for key in instrument.datum:
        found = instances(instrument, key, instrument.unknowns[key], pool)
        groups = max(groups, [np.intersect1d(left, rows) for _, rows in found], key=len)
    for faces in range(min(len(groups), count), 0, -1):
        for _ in range(TRIES):
            order = [rng.permutation(groups[k]) for k in rng.permutation(len(groups))[:faces]]
            turns = [rows[k] for k in range(max(map(len, order))) for rows in order if k < len(rows)]
            if len(turns) < count:
                break
            try:
                make_slots(problem, [pool.take(turns[:count])])
            except CasacalError:
                continue
            return np.array(turns[:count], dtype=np.intp)
    return np.asarray(drawn)


def bound_pool(
    problem: Problem, pool: Samples, after: Samples | None, loose: Mapping[str, float] | None
) -> BoundProblem:
    """A pool and after it touches that were made; raises SamplesError for those of another problem."""
    if after is not None:
        if not isinstance(after, Samples):
            raise CasacalError(f"Got {came(after)} as touches that were made", "Give what problem.read(path) returns")
        after.check(problem.layout())
        pool = joined(pool, after)
    bound = bind(problem.without_terms, pool)  # some effects need columns that only measured rows have
    refuse_unknown("unknown", loose or {}, bound.names)
    return bound


def _refuse(touches: int, pool: int, starts: int, again: float, check: float) -> None:
    """Raise CasacalError for numbers that make no plan."""
    for what, value, least in (("touches", touches, 3), ("pool", pool, touches), ("starts", starts, 1)):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
            shown = f"{value:g}" if is_real(value) else came(value)
            raise CasacalError(f"Got {shown} as the {what}", f"Give a whole number from {least} on")
    for what, part in (("again", again), ("check", check)):
        if not (is_real(part) and 0 <= part < 1):
            raise CasacalError(f"Got {came(part)} as the part '{what}'", "Give a number from 0 to below 1")
    if touches - round(check * touches) - round(again * touches) < 3:
        raise CasacalError(f"Fewer than three of {touches} touches are fitted", "Ask for more, or check fewer")

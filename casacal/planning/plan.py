"""A plan: which touches make the tip known best where it is wanted, how many, in which order; in words and a file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np

from casacal.data.columns import Labels
from casacal.data.samples import Samples, joined
from casacal.errors import CasacalError, came, refuse_unknown
from casacal.files import write_text
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.nominal import nominal_tips
from casacal.fit.slots import instances, make_slots
from casacal.model.instrument import readings_within
from casacal.model.problem import Problem
from casacal.planning.candidates import cell_of, pool_of, refuse_several
from casacal.planning.choice import Choice, Criterion, seldom, wanted_joints
from casacal.planning.clearance import Clearance, drawn_touch
from casacal.planning.route import AGAIN, CHECK, FIT, Route, postures_text, shortest_way, touches_needed
from casacal.planning.set_ups import POOL, SetUp, worth_most
from casacal.simulation.cell import Cell, Disturbances
from casacal.values import Array, Box, FrozenMapping, Index, Rows, as_given, is_real
from casacal.wording import METRE, UNBOUNDED, figures, html_table

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
    criterion: Criterion = "tip",
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
        clearance: boxes to keep clear of beside table and faces, and how thick the links are; by default no boxes,
            and links as thick as those of arms of this reach.
        after: touches that were made already; those of the plan come on top of them.
        loose: what may have moved since they were made, by the name of the unknown: standard deviation, rad or mm. The
            fewest touches that restore the zero of a joint after its motor was changed are found so.
        seed: of everything that is drawn.

    Raises CasacalError for numbers that make no plan, SimulationError where faces are out of reach.

    """
    refuse_several(problem, "A plan is for one instrument", "Plan for", box, targets)
    _refuse(touches, pool, starts, again, check)
    refuse_unknown("criterion", [criterion], get_args(Criterion))
    still = _placed(problem, cell_of(problem, cell), after)
    reachable = pool_of(problem, still, pool, seed, clearance)
    bound = bound_pool(problem, reachable, after, loose)
    choice_at = partial(Choice.of, bound, wanted_joints(bound, box, targets), count=pool, loose=loose)
    choice = choice_at()
    checks, repeats = round(check * touches), round(again * touches)
    checks = enough_to_verify(problem, reachable, checks, touches - repeats - LEAST_FITTED)
    rng = np.random.default_rng([seed, 1])
    best, few = _enough_of_each(problem, reachable, choice, touches - checks - repeats, starts, rng, criterion)
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
        choice.curve(best, rng, criterion),
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
            fix = "Say where the faces are (cell in the problem file), or on which table (--table Z)"
            raise CasacalError(what, fix)
    return cell


def _enough_of_each(
    problem: Problem,
    pool: Samples,
    choice: Choice,
    count: int,
    starts: int,
    rng: np.random.Generator,
    criterion: Criterion,
) -> tuple[Index, Rows]:
    """The best plan that touches each of its faces often enough to say where it is, and what it leaves out (N,)."""
    best, barred = choice.best_of(count, starts, rng, criterion), np.zeros(len(pool), dtype=bool)
    while True:
        few, least = seldom(problem, pool, best)
        barred |= least
        if not least.any() or (~barred).sum() < 2 * count:
            return best, few if (~few).sum() >= 2 * count else np.zeros(len(pool), dtype=bool)
        # too few touches of a face tell nothing of the arm, so that an exchange leaves them where they were at random
        best = choice.best_of(count, starts, rng, criterion, barred)


TRIES = 20  # draws of what is kept to verify, until one places all that it touches


NEARLY = 0.75  # of the touches that verify every face, from which on there are as many


def enough_to_verify(problem: Problem, pool: Samples, count: int, most: int) -> int:
    """Measurements to verify: a few more than a count where these then place every face, point or anchor of a pool.

    Each has one to lose, such as a touch that cannot be made where the real face stands; but no more than `most`.
    """
    instrument, least, spare = problem.instrument, 0, 0
    for key in instrument.datum:
        unknown = instrument.unknowns[key]
        each = int((~np.isfinite(unknown.prior_stds)).sum()) // problem.models[0].components + 1
        there = len(instances(instrument, key, unknown, pool))
        least, spare = max(least, each * there), max(spare, (each + 1) * there)
    return max(count, spare) if count >= NEARLY * least and spare <= most else count


def _by_label(rows: Index, labels: Labels, first: str | None) -> Index:
    """Rows in an order in which their labels take turns, after three of the `first`, which say where a plane is."""
    codes = labels.codes[rows]
    turn = np.array([(codes[:k] == code).sum() for k, code in enumerate(codes)])
    turn = turn - 2.5 * np.array([labels.names[code] == first for code in codes])
    return rows[np.argsort(turn, kind="stable")]


def kept_to_verify(problem: Problem, pool: Samples, left: Index, count: int, rng: np.random.Generator) -> Index:
    """Measurements drawn at random from those left, on as many faces, points or anchors as they locate.

    `verify` finds each of these anew from its own rows, and takes none with fewer than that needs. Where no draw
    suffices for one, it is any.
    """
    drawn = rng.choice(left, min(count, len(left)), replace=False)
    instrument, groups = problem.instrument, [left]
    names: list[str | None] = [None]
    labels = pool.faces(instrument.groups)
    for key in instrument.datum:
        found = instances(instrument, key, instrument.unknowns[key], pool)
        if len(found) > len(groups):
            groups, names = [np.intersect1d(left, rows) for _, rows in found], [name for name, _ in found]
    for faces in range(min(len(groups), count), 0, -1):
        for _ in range(TRIES):
            chosen = rng.permutation(len(groups))[:faces]
            order = [_by_label(rng.permutation(groups[k]), labels, names[k]) for k in chosen]
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


LEAST_FITTED = 3  # touches, which place one face


def _refuse(touches: int, pool: int, starts: int, again: float, check: float) -> None:
    """Raise CasacalError for numbers that make no plan."""
    for what, value, least in (("touches", touches, LEAST_FITTED), ("pool", pool, touches), ("starts", starts, 1)):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
            raise CasacalError(f"Got {as_given(value)} as the {what}", f"Give a whole number from {least} on")
    for what, part in (("again", again), ("check", check)):
        if not (is_real(part) and 0 <= part < 1):
            raise CasacalError(f"Got {as_given(part)} as the part '{what}'", "Give a number from 0 to below 1")
    if touches - round(check * touches) - round(again * touches) < LEAST_FITTED:
        raise CasacalError(f"Fewer than three of {touches} touches are fitted", "Ask for more, or check fewer")


CANDIDATES = 1000  # touches among which is chosen
SPARE = 1.5  # times as many as there must be, so that rows also tell the noise and single bad ones show
AVERAGED = 0.8  # error over that of two thirds as many, from which little but noise is averaged: sqrt(2/3) = 0.82
ON_TOP = 24  # touches that are made on top of others at least: a quarter of an hour of work
MOST = 120  # touches to be fitted that nobody is told to make unasked


def touches_for(
    problem: Problem,
    cell: Disturbances | None = None,
    tolerance: float | None = None,
    *,
    box: Box | None = None,
    targets: Array | None = None,
    clearance: Clearance | None = None,
    after: Samples | None = None,
    loose: Mapping[str, float] | None = None,
    again: float = 0.0,
    check: float = 0.0,
    most: int = 240,
) -> int:
    """About the fewest touches that bring the expected tip error below a tolerance, mm RMS, when they are fitted.

    Without a tolerance, as many as tell more than the noise of the others averaged: where noise alone is left, half as
    many again leave sqrt(2/3) of the error. Then never fewer than half as many again as `calibrate` takes at least,
    and, unless that is more, at most 120.

    box, targets, clearance, after, loose: as for `plan`. again, check: parts that come on top, repeated or kept to
    verify. Raises CasacalError where so many as `most` miss the tolerance.
    """
    refuse_several(problem, "A plan is for one instrument", "Plan for", box, targets)
    if tolerance is not None and not (is_real(tolerance) and 0 < tolerance < math.inf):
        raise CasacalError(f"Got {as_given(tolerance)} as the tolerance", "Give a positive number of mm")
    pool = pool_of(problem, cell, CANDIDATES, 0, clearance)
    bound = bound_pool(problem, pool, after, loose)
    choice = Choice.of(bound, wanted_joints(bound, box, targets), count=len(pool), loose=loose)
    rng = np.random.default_rng(0)
    if tolerance is None:  # from the least on, until more of them only average noise
        count = ON_TOP if after is not None else math.ceil(SPARE * touches_needed(problem, pool))
        left = choice.error(choice.best_of(count, 1, rng))
        while count < MOST:
            more = min(math.ceil(count * 1.5), MOST)
            then = choice.error(choice.best_of(more, 1, rng))
            if then > AVERAGED * left:
                break
            count, left = more, then
        return _in_all(problem, pool, count, again, check)
    count = min(3 if after is not None else 12, most)
    while (left := choice.error(choice.best_of(count, 1, rng))) > tolerance:
        if count == most:
            what = f"{most} best touches leave {figures(left)} mm, more than {tolerance:g} mm"
            fix = "Ask for less, measure with less noise, or add a face, a step or another instrument"
            raise CasacalError(what, fix)
        count = min(math.ceil(count * 1.25), most)
    return _in_all(problem, pool, count, again, check)


def _in_all(problem: Problem, pool: Samples, fitted: int, again: float, check: float) -> int:
    """Touches of a plan of which so many are fitted, whatever it takes to verify every face."""
    count = round(fitted / max(1 - check - again, 0.1))
    return count + enough_to_verify(problem, pool, round(check * count), count) - round(check * count)


FLAT = 0.93  # error over that of fewer touches above which more bring little

HARDLY = "hardly a touch can be made"  # where faces are out of reach, or what stands around is in the way

ENDS = 0.7  # error of all candidates over that of a number, below which a flat part is not the end of the curve


def plan_sentences(
    plan: Plan, compared: Sequence[SetUp], *, where: str, pool: int, after: bool, every: bool = True
) -> list[str]:
    """Sentences: the set-up that is worth most, how many, what to expect, the curve and where it flattens.

    where: where the tip is wanted, in words. pool: among how many was chosen. after: whether others were made before.
    every: whether all set-ups are listed, not only one that is much better.
    """
    fitted, check, again = (plan.purposes.count(purpose) for purpose in (FIT, CHECK, AGAIN))
    without = "Without them" if after else "Priors alone"
    alone = f"{figures(plan.before)} mm" if plan.before < METRE else UNBOUNDED
    left = ", ".join(f"{count} {figures(error)}" for count, error in plan.curve.items())
    flat = [few for few, many in pairwise(sorted(plan.curve)) if plan.curve[many] > FLAT * plan.curve[few]]
    flat = [few for few in flat if plan.best > ENDS * plan.curve[few]]  # or it only seems so, and many more gain much
    left += f"; more than {flat[0]} gain little" if flat else ""
    said = []
    if better := worth_most(compared) if compared else None:
        best, now = better
        now_is = f"{figures(now.error)} mm as it is" if math.isfinite(now.error) else f"{HARDLY} as it is"
        said.append(
            f"Consider another set-up first ({best.words}): with {fitted} fitted touches of {POOL} candidates it "
            f"leaves {figures(best.error)} mm, {now_is}"
        )
    said += [
        f"{len(plan)} touches: {fitted} to fit, {again} of them once more, {check} kept to verify "
        f"({check / len(plan):.0%})",
        f"Expect a tip error of {figures(plan.error)} mm RMS {where}, apart from the pose of the base, if the "
        "stated noise and priors are right; errors of the instrument itself and effects beside the geometry are not "
        "counted",
        f"{without}: {alone}; the same number at random: {figures(plan.at_random)} mm; all {pool} candidates: "
        f"{figures(plan.best)} mm",
        f"On arms that differ from the drawing as the priors allow: {figures(plan.over_arms)} mm; with a tenth of the "
        f"touches lost: {figures(plan.if_lost)} mm",
        f"Number of fitted touches and expected tip error, mm: {left}",
    ]
    if compared and every:
        said.append(
            f"Set-ups, each with {fitted} fitted touches of {POOL} candidates, and none made before; so these figures "
            f"compare with one another, not with the plan above, chosen of {pool}:"
        )
    for each in compared if every else ():
        reach = HARDLY if math.isinf(each.error) else f"{figures(each.error)} mm"
        said.append(f"  {reach}: {each.words}{f' ({each.option})' if each.option.count('--') == 1 else ''}")
    return said


def where_faces_stand(plan: Plan, problem: Problem) -> list[dict[str, Any]]:
    """Each face of a plan: label, centre_mm (3), normal (3), size_mm (2), and off_mm, for JSON.

    off_mm: how far the real face may stand off along its normal, from and to, mm, until the first touch leaves the
    range of the dial in the posture that was planned; None where there is no dial.
    """
    probe, cell, found = problem.instrument.probe, plan.cell, list[dict[str, Any]]()
    if probe is None or not isinstance(cell, Cell):
        return found
    arm, readings, tips, _ = drawn_touch(problem, probe, plan.samples)
    beyond, _ = arm.place(arm.local, plan.samples.joints, readings[:, None] + 1)
    ends = readings_within(probe.travel if cell.travel is None else cell.travel)
    rows = plan.samples.faces(problem.instrument.groups).rows()
    for face in cell.faces:
        touched = rows.get(face.label, np.arange(len(plan)) if len(cell.faces) == 1 else np.zeros(0, dtype=int))
        off = None
        if probe.column is not None and len(touched):
            rise = (beyond - tips)[touched] @ face.axes[0]
            ways = np.sort([(end - readings[touched]) * rise for end in ends], axis=0)
            off = [float(ways[0].max()), float(ways[1].min())]
        found.append({"label": face.label, "centre_mm": face.centre, "normal": face.axes[0], "size_mm": face.size})
        found[-1] |= {"touches": len(touched), "off_mm": off}
    return found


def cell_words(plan: Plan, problem: Problem, clearance: Clearance | None) -> list[str]:
    """Sentences for setting up the cell: where each face stands, and what the plan keeps clear of."""
    said = [(clearance or Clearance()).around(problem.robot, plan.cell).words]
    faces = where_faces_stand(plan, problem)
    for each in faces:
        (x, y, z), (u, v, w), (wide, deep) = each["centre_mm"], each["normal"], each["size_mm"]
        place = f"centre ({x:.0f}, {y:.0f}, {z:.0f}) mm, normal ({u:.3f}, {v:.3f}, {w:.3f}), {wide:.0f} x {deep:.0f} mm"
        off = each["off_mm"]
        may = "" if off is None else f"; may stand off by {off[0]:+.1f} to {off[1]:+.1f} mm along its normal"
        may = may if each["touches"] else "; left out, no touch is planned on it"
        said.append(f"Face {each['label']}: {place}{may}")
    if not all(each["touches"] for each in faces):
        said.append(
            "A face is left out where the few touches that it would get could only say where it stands, while other "
            "faces tell more of the arm. More touches may take it in"
        )
    if faces:
        said.append(
            "Places are in the base frame. Where a real face stands further off, bring the tip to it along the plunger "
            "and take the joint values that the controller shows: the fit finds the face"
        )
    return said


def document(
    plan: Plan, problem: Problem, compared: Sequence[SetUp], written: Sequence[str], clearance: Clearance | None = None
) -> dict[str, Any]:
    """The plan as data for other programs."""
    counts = {purpose: plan.purposes.count(purpose) for purpose in dict.fromkeys(plan.purposes)}
    errors = {
        "expected": plan.error,
        "at_random": plan.at_random,
        "before": plan.before,
        "of_all": plan.best,
        "if_a_tenth_is_lost": plan.if_lost,
        "over_arms": plan.over_arms,
    }
    curve = [{"touches": count, "expected_mm": error} for count, error in plan.curve.items()]
    found: dict[str, Any] = {"touches": counts, "tip_rms_mm": errors, "curve": curve, "written": list(written)}
    around = (clearance or Clearance()).around(problem.robot, plan.cell)
    found |= {"table_mm": plan.cell.table, "collisions_checked": around.radius > 0, "link_radius_mm": around.radius}
    found["collisions"] = around.words
    found["faces"] = where_faces_stand(plan, problem)
    if compared:
        found["setups"] = [
            {"words": each.words, "expected_mm": each.error, "option": each.option or None} for each in compared
        ]
    return found


def plan_text(plan: Plan, problem: Problem, name: str, clearance: Clearance | None = None) -> str:
    """The plan as CSV: number, purpose, joints (degrees, mm), readings to expect, labels; above them where faces stand.

    problem: with the one instrument that it was made for. name: of the problem. Readings have other names than in
    samples, so that a plan cannot be taken for a measurement.
    """
    layout, approach = problem.layout(), problem.instrument.words.approach
    notes = [
        f"planned by casacal for {name}: not a measurement",
        f"table at z = {plan.cell.table:g} mm",
        f"expected tip error {figures(plan.error, 4)} mm RMS, apart from the pose of the base, if stated noise and "
        f"priors are right; of as many at random {figures(plan.at_random, 4)} mm",
        *cell_words(plan, problem, clearance),
        f"bring the arm to each posture; {f'{approach}; ' if approach else ''}write down the joint values that the "
        f"controller shows{', and the reading' if layout.columns else ''}",
        "purpose fit: for calibration; again: the same touch repeated at the end; check: kept for casacal verify",
    ]
    return postures_text(plan.samples, plan.purposes, layout, notes)


def write_plan(path: str | Path, plan: Plan, problem: Problem, name: str, clearance: Clearance | None = None) -> None:
    """Write `plan_text` to a file, whole or not at all."""
    write_text(path, plan_text(plan, problem, name, clearance))

"""Mistakes people make in samples and problem file, each with what undoes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations, permutations
from typing import Any

import numpy as np

from casacal.calibration.conventions import in_problem
from casacal.calibration.finding import SUSPICIOUS, Fault, Undo, Undone, freed_of_unknowns, misfit, quick_fit
from casacal.calibration.numbers import numbers, tool_keys
from casacal.calibration.set_aside import median_plane
from casacal.data.columns import Labels
from casacal.data.samples import Samples, joined
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Result
from casacal.fit.nominal import nominal_tips
from casacal.fit.slots import ENOUGH
from casacal.model.instrument import ANGLE_UNITS, UNIT_MISTAKES, Suspect, readings_within
from casacal.model.joints import Conventions
from casacal.model.problem import Problem
from casacal.model.problem_text import conventions_line
from casacal.values import Array, Index, Rows
from casacal.wording import figures, numbered_lines

MOVED, SLIPPED = "something moved", "joint slipped"
MOST_SCALE = 0.2  # part by which readings are too large beyond which it is no error of scale
LITTLE = 0.99  # part of the squares that a step for such a size may leave
ROUNDS = 4  # Gauss-Newton steps for the size of a fault; all are nearly linear in it
PLACES = 12  # in the order of the rows, at which something may have moved, before the best is looked at closely
MOST_SHIFTS, WORTH = 3, 0.8  # shifts that are looked for; part of the misfit that a further one may leave
MOST_PAIRED = 1200  # rows beyond which it takes too long to look where they slipped
SURELY_OFF = 10.0  # times the median residual beyond which a row is off, however far
FEWEST = 5  # rows that a face needs on either side of such a place to have a plane there
HANGS = 6  # rows one after another in which a joint that moves elsewhere shows one value, before it is said to hang
AT_END = 6  # readings of one value, twice as many as of any other, that the end of a plunger's way makes
SMALL = 1e-5  # step of the finite difference, mm or mm per rad
DOCTOR = "Run casacal doctor on rows of the pendant, and write the coupling into the problem's Conventions"
OFF_PLANE = 10.0  # mm beyond which a tip is not on a plane, whatever the arm's errors
MOST_FACES = 12  # faces beyond which their labels are not exchanged two by two
MOST_SESSIONS = 6  # labels of a column beyond which units are not looked for one by one


@dataclass(frozen=True)
class OfRows:
    """What undoes a fault of the rows alone, at once: nothing is fitted for it."""

    change: Callable[[Samples], Samples]

    def __call__(self, problem: Problem, samples: Samples) -> Undone:
        """The problem as it is, and the rows without the fault."""
        return Undone(problem, self.change(samples))


def tool_elsewhere(problem: Problem, samples: Samples) -> Undone:
    """Free the tool point of its prior, and report where the samples put it."""
    keys = tool_keys(problem)
    freed = problem.free(*(key for key in keys if not problem.instrument.unknowns[key].size))
    freed = freed.with_prior(dict.fromkeys(keys, math.inf))
    fitted = quick_fit(freed, samples)
    if fitted is None or not keys:
        return Undone(problem, samples)
    bound, result = fitted
    moved = [j for slot in bound.slots if slot.key in keys for j in slot.columns]
    return Undone(freed, samples, ": " + ", ".join(f"{bound.names[j]} by {result.x[j]:+.2f} mm" for j in moved))


def drifting(problem: Problem, samples: Samples, *, column: str) -> Undone:
    """Readings less a drift in proportion to their place in the order of rows."""
    order = np.linspace(0.0, 1.0, len(samples))

    def less(samples: Samples, size: float) -> Samples:
        return replace(samples, columns={**samples.columns, column: samples.columns[column] - size * order})

    (size,) = fitted_sizes(problem, samples, less)
    return Undone(problem, less(samples, size), f", by {figures(size, signed=True)} mm from the first row to the last")


def scaled(problem: Problem, samples: Samples, *, columns: Sequence[str]) -> Undone:
    """Readings less a part of each by which all are too large, or too small."""

    def less(samples: Samples, size: float) -> Samples:
        changed = {name: samples.columns[name] * (1 - size) for name in columns}
        return replace(samples, columns={**samples.columns, **changed})

    (size,) = fitted_sizes(problem, samples, less)
    if abs(size) > MOST_SCALE:
        return Undone(problem, samples)
    return Undone(problem, less(samples, size), f", by {100 * size:+.3g} %")


def geared(problem: Problem, samples: Samples, *, turning: int, sliding: int) -> Undone:
    """A sliding joint that moves as another one turns, as the screw of a SCARA's quill does."""

    def with_lead(samples: Samples, size: float) -> Samples:
        joints = samples.joints.copy()
        joints[:, sliding] += size * joints[:, turning]
        return replace(samples, joints=joints)

    (size,) = fitted_sizes(problem, samples, with_lead)
    return Undone(problem, with_lead(samples, size), f", by {figures(2 * math.pi * size, 4, signed=True)} mm per turn")


def somewhere_moved(problem: Problem, samples: Samples) -> Undone:
    """Faces that count as others from some row on, at the place where all then fits best."""
    step = max(len(samples) // (PLACES + 1), 1)
    tried: dict[int, float] = {}

    def best_of(places: Sequence[int]) -> int:
        for place in places:
            if place not in tried and (later := _relabelled(problem, samples, place)) is not None:
                tried[place] = misfit(problem, later, first=True)
        return min(tried, key=tried.__getitem__, default=0)

    rough = best_of(range(step, len(samples), step))
    near = {rough + round(step * part / 3) for part in range(-3, 4)}
    place = best_of(sorted(place for place in near if 0 < place < len(samples)))
    later = _relabelled(problem, samples, place) if tried else None
    if later is None:
        return Undone(problem, samples)
    return Undone(problem, later, f" near line {samples.lines[place]}")


def zero_moved(problem: Problem, samples: Samples, *, column: str) -> Undone:
    """Readings less shifts from some rows on, where a dial was set to zero anew: wherever that gains most.

    A further shift is taken where it takes away a fifth of the misfit or more.
    """
    places: list[int] = []
    sizes: tuple[float, ...] = ()
    rows, left = samples, math.inf
    while len(places) < MOST_SHIFTS and 2 * FEWEST < len(rows) <= ENOUGH:
        if (fitted := quick_fit(problem, rows)) is None:
            break
        _, place = _best_place(*fitted, _less_shifts(rows, SMALL, column=column, places=[0]))
        less = partial(_less_shifts, column=column, places=[*places, place])
        found = fitted_sizes(problem, samples, less, start=(*sizes, 0.0))
        if (misses := misfit(problem, less(samples, *found))) > WORTH * left:
            break
        places, sizes, rows, left = [*places, place], found, less(samples, *found), misses
    shifts = sorted(zip(places, sizes, strict=True))
    said = " and".join(f" near line {samples.lines[k]}, by {figures(size, signed=True)} mm" for k, size in shifts)
    return Undone(problem, rows, said)


def _less_shifts(samples: Samples, *sizes: float, column: str, places: Sequence[int]) -> Samples:
    """Readings less a shift from each of some rows on."""
    shift = sum(size * (np.arange(len(samples)) >= place) for size, place in zip(sizes, places, strict=True))
    return replace(samples, columns={**samples.columns, column: samples.columns[column] - shift})


def _best_place(bound: BoundProblem, result: Result, shifted: Samples) -> tuple[float, int]:
    """By how much chi-square falls, and the row, where a shift from there on lowers it most.

    shifted: all rows with that shift, of size `SMALL`.
    """
    here, places = bound.residual(result.x), np.arange(FEWEST, len(shifted) - FEWEST)
    slope = (bound.on(shifted).residual(result.x) - here) / SMALL
    later = bound.sample_of[:, None] >= places
    whole, ways = freed_of_unknowns(bound, result, here, later * slope[:, None])
    gains = (ways.T @ whole) ** 2 / np.maximum((ways**2).sum(axis=0), 1e-300)
    return float(gains.max()), int(places[np.argmax(gains)])


def joint_slipped(problem: Problem, samples: Samples) -> Undone:
    """A joint's angles less a shift from some row on, as where its encoder slipped: where that gains most."""
    fitted, turning = quick_fit(problem, samples), np.flatnonzero(problem.robot.revolute).tolist()
    if fitted is None or not turning or not 2 * FEWEST < len(samples) <= ENOUGH:
        return Undone(problem, samples)
    tried = [(*_best_place(*fitted, _turned_back(samples, -SMALL, joint=i, place=0)), i) for i in turning]
    _, place, joint = max(tried)
    size = 0.0
    for _ in range(2):  # the place anew once the size is known
        (size,) = fitted_sizes(problem, samples, partial(_turned_back, joint=joint, place=place))
        if (undone := quick_fit(problem, _turned_back(samples, size, joint=joint, place=place))) is None:
            return Undone(problem, samples)
        both = (undone[0].on(rows) for rows in (samples, _turned_back(samples, size, joint=joint, place=0)))
        before, after = (each.largest(np.abs(each.residual(undone[1].x))) for each in both)
        costs = np.cumsum(before**2) - before**2 + np.cumsum((after**2)[::-1])[::-1]
        place = int(np.argmin(costs[FEWEST : len(samples) - FEWEST])) + FEWEST
    by = figures(math.degrees(size), signed=True)
    said = f": joint {joint + 1}, near line {samples.lines[place]}, by {by} degrees"
    return Undone(problem, _turned_back(samples, size, joint=joint, place=place), said)


def _turned_back(samples: Samples, size: float, *, joint: int, place: int) -> Samples:
    """Rows with a joint's angle less by so much from a place on."""
    joints = samples.joints.copy()
    joints[place:, joint] -= size
    return replace(samples, joints=joints)


def hanging(samples: Samples) -> Iterator[Fault]:
    """Joints that show one and the same value over many rows, as of an encoder or a recorder that hangs."""
    for i, values in enumerate(samples.joints.T):
        starts = np.flatnonzero(np.concatenate([[True], np.diff(values) != 0]))
        runs = np.diff([*starts, len(values)])
        still = np.repeat(runs >= HANGS, runs)
        still[starts] = False  # the first may be right
        if not still.any() or len(starts) == 1:
            continue
        lines = numbered_lines([samples.lines[k] for k in np.flatnonzero(still).tolist()])
        cause = (
            f"joint {i + 1} shows in {lines} the value of the line before, as of an encoder or a recorder that hangs"
        )
        kept, fix = np.flatnonzero(~still), "Measure these rows again"
        yield Fault(f"joint {i + 1} stuck", cause, fix, OfRows(partial(Samples.take, rows=kept)), 1, common=False)


def at_an_end(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Readings of a dial that all are the largest, or the smallest, as where its plunger was at the end of its way."""
    probe = problem.instrument.probe
    if probe is None or probe.column is None:
        return
    reading = samples.columns[probe.column]
    shown, counts = np.unique(reading, return_counts=True)
    for k, which in ((-1, "largest"), (0, "smallest")):
        if not AT_END <= counts[k] <= len(samples) / 2 or 2 * np.delete(counts, k).max(initial=0) > counts[k]:
            continue
        there = reading == shown[k]
        lines = numbered_lines([samples.lines[row] for row in np.flatnonzero(there).tolist()])
        cause = f"{lines} all read {shown[k]:g} mm, the {which} of all readings, as of a plunger at the end of its way"
        undo = OfRows(partial(Samples.take, rows=np.flatnonzero(~there)))
        yield Fault("end of the travel", cause, "Measure these rows again", undo, 1, common=False)


def step_elsewhere(problem: Problem, samples: Samples, *, label: str) -> Undone:
    """A step whose height is hardly known, and what the rows say of it."""
    dial: Any = problem.instrument
    step, key = dial.steps[label], f"step_{[*dial.steps].index(label) + 1}"
    unsure = replace(dial, steps={**dial.steps, label: replace(step, std=MOST_SCALE * abs(step.height))})
    freed = problem.with_parts(problem.robot, (unsure,))
    if (fitted := quick_fit(freed, samples)) is None:
        return Undone(problem, samples)
    by = float(fitted[1].x[fitted[0].names.index(key)])
    return Undone(freed, samples, f": {figures(step.height + by, 5)} mm, not {step.height:g}")


def _relabelled(problem: Problem, samples: Samples, place: int) -> Samples | None:
    """Rows from a place on under labels of their own; None where no face has enough rows on both sides."""
    column = problem.instrument.groups
    assert column is not None
    faces = samples.faces(column)
    after = np.arange(len(samples)) >= place
    names, codes, split = list(faces.names), faces.codes.copy(), False
    for k, name in enumerate(faces.names):
        own = faces.codes == k
        if min(int((own & after).sum()), int((own & ~after).sum())) >= FEWEST:
            names.append(f"{name}, later")
            codes[own & after] = len(names) - 1
            split = True
    return replace(samples, labels={**samples.labels, column: Labels(names, codes)}) if split else None


def fitted_sizes(
    problem: Problem, samples: Samples, change: Callable[..., Samples], *, start: tuple[float, ...] = (0.0,)
) -> tuple[float, ...]:
    """Sizes of changes at which all fits best: Gauss-Newton in them, all unknowns fitted anew at each step.

    The slopes of the residuals by the sizes are freed of what the unknowns can follow, priors included.
    """
    sizes = np.array(start)
    if len(samples) > ENOUGH:
        return start
    for _ in range(ROUNDS):
        if (fitted := quick_fit(problem, change(samples, *sizes))) is None:
            return (0.0,) * len(start)
        bound, result = fitted
        here = bound.residual(result.x)
        steps = (change(samples, *(sizes + step)) for step in SMALL * np.eye(len(sizes)))
        slopes = np.column_stack([(bound.on(changed).residual(result.x) - here) / SMALL for changed in steps])
        whole, left = freed_of_unknowns(bound, result, here, slopes)
        if not left.any(axis=0).all():
            break
        step, *_ = np.linalg.lstsq(left, whole, rcond=None)
        if ((whole - left @ step) ** 2).sum() > LITTLE * (whole**2).sum():  # it explains nothing, or is found
            break
        sizes = sizes - step
    return tuple(map(float, sizes))


def suspected(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Every mistake that is looked for; of two that explain samples alike and are as simple, the first is believed."""
    return chain(_columns_and_joints(problem), _places(problem, samples), _parts_of_the_cell(problem, samples))


def _places(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Mistakes in places that a device tells by three coordinates: targets it had lost, units that differ by label."""
    lengths = [name for name, kind in problem.instrument.columns.items() if kind == "length"]
    if len(lengths) < 3:
        return
    places = np.column_stack([samples.columns[name] for name in lengths])
    _, first, which, counts = np.unique(places, axis=0, return_index=True, return_inverse=True, return_counts=True)
    again = counts[which] > 1
    again[first[counts == 2]] = False  # of two alike, the first may have been measured
    if again.any() and 2 * again.sum() < len(places):
        lines = numbered_lines([samples.lines[k] for k in np.flatnonzero(again).tolist()])
        cause = f"{lines} hold the same place as others to the last digit, as of a target that was lost"
        kept, fix = np.flatnonzero(~again), "Remove these lines, or measure them again"
        yield Fault("lost target", cause, fix, OfRows(partial(Samples.take, rows=kept)), 1, common=False)
    for column in samples.labels:
        labels = samples.faces(column)
        if not 2 <= len(labels.names) <= MOST_SESSIONS:
            continue
        for code, name in enumerate(labels.names):
            for rows, words in ((labels.codes == code, "is"), (labels.codes != code, "is not")):
                for factor, unit in UNIT_MISTAKES.items():
                    changed = {each: np.where(rows, factor, 1.0) * samples.columns[each] for each in lengths}
                    undo = OfRows(partial(replace, columns={**samples.columns, **changed}))
                    cause = f"the lengths where {column} {words} '{name}' seem to be {unit}"
                    yield Fault(f"unit by {column}", cause, "Convert those rows", undo, 1, common=False)


def _columns_and_joints(problem: Problem) -> Iterator[Fault]:
    """Mistakes in whole columns: sign, units, joints the other way or swapped; the table's convention."""
    turns = problem.robot.revolute
    for suspect in problem.instrument.suspects:
        yield Fault(suspect.about, suspect.cause, suspect.fix, OfRows(partial(_rewritten, suspect=suspect)))
    if turns.any():
        for factor, words in ANGLE_UNITS.items():
            cause, fix = f"the joint angles look like {words}", "Correct the unit in the columns' names"
            yield Fault("unit of the joints", cause, fix, _turned(np.diag(np.where(turns, factor, 1.0))))
            for i in np.flatnonzero(turns).tolist() if turns.sum() > 1 else ():
                one = np.where(np.arange(len(turns)) == i, factor, 1.0)
                cause, fix = f"the angles of joint {i + 1} look like {words}", f"Correct the unit of column q{i + 1}"
                yield Fault(f"unit of joint {i + 1}", cause, fix, _turned(np.diag(one)), 1, common=False)
    yield from flips(problem)
    if (other := problem.robot.in_other_convention()) is not None:
        cause, fix = "the DH table seems to be of the other convention", "Correct its convention, standard or modified"
        meant = problem.with_parts(other, problem.instruments)
        yield Fault("DH convention", cause, fix, lambda _, samples: Undone(meant, samples), 1, common=False)
    for i, j in combinations(range(len(turns)), 2):
        if turns[i] == turns[j]:
            order = np.eye(len(turns))
            order[[i, j]] = order[[j, i]]
            cause, fix = f"columns q{i + 1} and q{j + 1} seem to be swapped", "Swap the two column names"
            yield Fault(f"joints {i + 1} and {j + 1} swapped", cause, fix, _turned(order))


def some_radians(problem: Problem, whole: Samples) -> Iterator[Fault]:
    """Rows whose angles are all so small that they may be radians among rows of degrees."""
    turns = problem.robot.revolute
    small = np.all(np.abs(whole.joints[:, turns]) <= math.radians(2 * math.pi), axis=1)
    if turns.any() and small.any() and not small.all():
        lines = numbered_lines([whole.lines[k] for k in np.flatnonzero(small).tolist()])
        changed = replace(whole, joints=whole.joints * np.where(np.outer(small, turns), 180 / math.pi, 1.0))
        cause, fix = f"the joint angles of {lines} look like radians, written as degrees", "Write all rows in one unit"
        yield Fault("unit of some joints", cause, fix, lambda problem, _: Undone(problem, changed), 1, common=False)


def flips(problem: Problem) -> Iterator[Fault]:
    """Each joint counted the other way."""
    count, arm = len(problem.robot.axes), problem.robot.arm
    for i in range(count):
        signs = np.ones(count)
        signs[i] = -1.0
        cause = f"joint {i + 1} seems to be counted in the other direction"
        fix = f"Reverse the sign of column q{i + 1}"
        if arm is not None:
            said = (arm.conventions or Conventions.plain(count)).flipped(i + 1)
            line = conventions_line(said, problem.robot.axes)
            fix += f", or turn the joint round in the problem, with its limits: {line}"
        yield Fault(f"joint {i + 1} flipped", cause, fix, _turned(np.diag(signs)))


def _parts_of_the_cell(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Mistakes that concern the tool, one face, two joints, or the order of the rows."""
    probe, turns, arm = problem.instrument.probe, problem.robot.revolute, problem.robot.arm
    own = None if arm is None else arm.conventions
    if tool_keys(problem):
        fix = "Measure the tool from the flange again, and correct it in the problem file"
        yield Fault("tool elsewhere", "the tool seems to be elsewhere", fix, tool_elsewhere, 3)
    if probe is not None and probe.column is not None:
        yield from _signs_of_faces(samples, probe.column, probe.label, sum(readings_within(probe.travel)))
        yield from _some_units(samples, probe.column, readings_within(probe.travel))
        yield from _under_one_label(problem, samples)
    yield from _steps(problem, samples)
    yield from numbers(problem)
    yield from _zeros(problem)
    for i, j in permutations(range(len(turns)), 2):
        about = f"joint {j + 1} coupled to joint {i + 1}"
        if turns[i] == turns[j]:
            for factor in (1.0, -1.0):
                coupled = np.eye(len(turns))
                coupled[j, i] = factor
                said = "turns" if turns[j] else "slides"
                cause = f"joint {j + 1} seems to {said[:-1]} {'with' if factor > 0 else 'against'} joint {i + 1}"
                meant = replace(Conventions.plain(len(turns)), coupling=((j + 1, i + 1, factor),))
                fix = DOCTOR + ("" if own is not None and own.coupling else in_problem(problem.robot, meant))
                yield Fault(about, cause, fix, _turned(coupled), common=False)
        elif turns[i]:
            cause = f"joint {j + 1} seems to slide as joint {i + 1} turns"
            yield Fault(about, cause, DOCTOR, partial(geared, turning=i, sliding=j), 1, False)
    lengths = [name for name, kind in problem.instrument.columns.items() if kind == "length"]
    if lengths:
        who, seem = ("readings", "readings seem") if probe is None else ("dial", "dial seems")
        fix = "Check the instrument's scale factor and its settings for air, or declare the scale as an unknown"
        if probe is not None:
            fix = "Have the dial calibrated, or declare its gain as an unknown: gain=dial_gain(2)"
        cause = f"the {seem} to be off in proportion"
        yield Fault(f"scale of the {who}", cause, fix, partial(scaled, columns=lengths), 1, False)
    if probe is not None and probe.column is not None:
        fix = "Let dial and arm warm up, fasten the stand, and measure again; touch one place at the beginning and end"
        yield Fault("drift", "the readings seem to drift", fix, partial(drifting, column=probe.column), 1)
        said = probe.zero_label or "session"
        fix = f"Give the rows from there on another value in a column '{said}'"
        fix += "" if probe.zero else ", and declare zero_shift=dial_zero() for the dial"
        cause = "the dial seems to have been set to zero anew, or to have slipped in its clamp"
        yield Fault("dial set to zero anew", cause, fix, partial(zero_moved, column=probe.column), 2, False)
    fix = "Master that joint, and measure the later rows again"
    yield Fault(SLIPPED, "the encoder of a joint seems to have slipped", fix, joint_slipped, 8, False)
    yield from hanging(samples)
    yield from at_an_end(problem, samples)
    if problem.instrument.groups is not None:
        what = f"{problem.instrument.words.group}s"
        fix = f"Fasten base, tool and {what}, and measure again, or give the {what} other labels from there on"
        yield Fault(MOVED, f"base, tool or {what} seem to have moved", fix, somewhere_moved, 9, False)


def _signs_of_faces(samples: Samples, column: str, label: str | None, ends: float) -> Iterator[Fault]:
    """The reading of one face counted the other way, from zero or from the other end; both ends add up to `ends`."""
    faces = samples.faces(label)
    if len(faces.names) < 2:
        return
    for name in faces.names:
        for end in dict.fromkeys((0.0, ends)):
            cause = f"the readings on '{name}' seem to have the wrong sign"
            fix = f"Reverse the sign of the readings on '{name}'"
            if end:
                cause = f"the readings r on '{name}' seem to be counted from the other end of the travel"
                fix = f"Write {end:g} - r in place of each r on '{name}'"

            def other(samples: Samples, name: str = name, end: float = end) -> Samples:
                reading, rows = samples.columns[column].copy(), samples.faces(label).rows()[name]
                reading[rows] = end - reading[rows]
                return replace(samples, columns={**samples.columns, column: reading})

            yield Fault(f"dial sign of '{name}'", cause, fix, OfRows(other))


def pairings(whole: Samples) -> Iterator[Fault]:
    """Readings, or these and labels, slipped by a row against the joints from some line on, as by a lost detection."""
    several = any(len(labels.names) > 1 for labels in whole.labels.values())
    possible = len(whole) <= MOST_PAIRED
    every = [(True, False, "readings"), (True, True, "readings and labels"), (False, True, "labels")]
    slips = [each for each in every if (whole.columns or not each[0]) and (several or not each[1])]
    for readings, labels, what in slips if possible else ():
        for by, which in ((-1, "previous"), (1, "next")):
            cause = f"{what} seem to belong to the joints of the {which} row"
            undo = partial(_paired, whole=whole, by=by, readings=readings, labels=labels)
            about = f"{'readings' if readings else 'labels'} one row off"
            yield Fault(about, cause, "Move their columns by one row", undo, 1, common=False)
    for i in range(whole.joints.shape[1]) if possible else ():
        for by, which in ((1, "previous"), (-1, "next")):
            cause = f"the values of joint {i + 1} seem to be those of the {which} row, in all rows"
            own = np.roll(whole.joints[:, i], -by)
            moved = replace(whole, joints=np.column_stack([whole.joints[:, :i], own, whole.joints[:, i + 1 :]]))
            kept = moved.take(range(max(-by, 0), len(whole) - max(by, 0)))
            shifted = OfRows(lambda _, kept=kept: kept)  # type: ignore[misc]
            fix = f"Move column q{i + 1} by one row"
            yield Fault(f"joint {i + 1} one row off", cause, fix, shifted, 1, common=False)


def _paired(problem: Problem, samples: Samples, *, whole: Samples, by: int, readings: bool, labels: bool) -> Undone:
    """All rows with readings of the row before (by 1) or after (by -1) from some row on, where all then fits best."""
    del samples  # thinned ones are no neighbours
    slipped = partial(_slipped, whole, by=by, readings=readings, labels=labels)
    tried = range(0, len(whole) - 1, max(len(whole) // (PLACES + 1), 1))
    sizes = {place: misfit(problem, slipped(place), first=True) for place in tried}
    place = min(sizes, key=sizes.__getitem__)
    for _ in range(2):
        if (fitted := quick_fit(problem, slipped(place))) is None:
            return Undone(problem, whole)
        bound, x = fitted[0], fitted[1].x
        most = SURELY_OFF * np.median(bound.largest(np.abs(bound.residual(x))))
        kept = np.minimum(bound.on(whole).largest(np.abs(bound.on(whole).residual(x))), most)
        there, rest = slipped(0), bound.on(slipped(0))
        moved = np.zeros(len(whole))
        moved[max(by, 0) : max(by, 0) + len(there)] = np.minimum(rest.largest(np.abs(rest.residual(x))), most)
        after = np.cumsum(moved[::-1])[::-1] - (moved if by > 0 else 0.0)  # a posture without a reading counts nothing
        place = int(np.argmin((np.cumsum(kept) - kept + after)[:-1]))
    said = f", from line {whole.lines[place - min(by, 0)]} on" if place else ""
    return Undone(problem, slipped(place), said)


def _slipped(samples: Samples, place: int, *, by: int, readings: bool, labels: bool) -> Samples:
    """Rows with readings, labels or both of the row before (by 1), or after (by -1), from a place on; one is lost."""
    rows = np.arange(len(samples))
    source = np.where(rows < place, rows, rows - by)
    kept = rows[(source >= 0) & (source < len(samples)) & ((rows != place) | (by < 0))]
    found, read = samples.take(kept), samples.take(source[kept])
    columns = read.columns if readings else found.columns
    return replace(found, columns=columns, labels=read.labels if labels else found.labels)


def _some_units(samples: Samples, column: str, ends: tuple[float, float]) -> Iterator[Fault]:
    """Some readings in another unit: those that stay within the dial's travel in it, or that it alone brings there."""
    reading, most = samples.columns[column], max(map(abs, ends))
    for factor, words in UNIT_MISTAKES.items():
        other = np.abs(reading) <= most / factor if factor > 1 else np.abs(reading) > most
        if not other.any() or other.all():
            continue
        which = f"up to {most / factor:.3g}" if factor > 1 else f"beyond {most:g}"
        cause, fix = f"the readings {which} mm seem to be {words}", "Write all readings in one unit"
        changed = {**samples.columns, column: np.where(other, factor * reading, reading)}
        yield Fault("unit of some readings", cause, fix, OfRows(partial(replace, columns=changed)), 1, False)


def _under_one_label(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Two faces whose touches have one label: a part of its tips lies on a plane, and the others far from that."""
    column = problem.instrument.groups
    if column is None or len(samples.faces(column).names) > MOST_FACES:
        return
    faces, tips = samples.faces(column), nominal_tips(problem, 0, samples)
    for code, name in enumerate(faces.names):
        own = np.flatnonzero(faces.codes == code)
        if len(own) < 4 * FEWEST:
            continue
        near = _on_plane(tips[own], tips[own])
        if (~near).sum() < 2 * FEWEST:
            continue
        other = own[~near]
        both = own[near & _on_plane(tips[other], tips[own])]  # near the edge of the two
        kept = np.setdiff1d(np.arange(len(samples)), both)
        for later in (other, np.setdiff1d(own[near], both)):  # a step stands on one of them
            codes = faces.codes.copy()
            codes[later] = len(faces.names)
            labels = {**samples.labels, column: Labels([*faces.names, f"{name} 2"], codes)}
            cause = f"'{name}' seems to be two {problem.instrument.words.group}s under one label"
            fix = f"Give these rows a label of their own: {numbered_lines([samples.lines[k] for k in later.tolist()])}"
            undo = OfRows(partial(_with_labels, labels=labels, rows=kept))
            yield Fault("two under one label", cause, fix, undo, 2, common=False)


def _with_labels(samples: Samples, *, labels: Mapping[str, Labels], rows: Index) -> Samples:
    return replace(samples, labels=labels).take(rows)


def _on_plane(some: Array, tips: Array) -> Rows:
    """Which tips (N, 3) are on the plane on which some, half of them at least, are within the errors of a drawn arm."""
    plane, _ = median_plane(some)
    off, own = (np.abs(each @ plane[:3] - plane[3]) for each in (tips, some))
    return np.asarray(off <= max(SURELY_OFF * float(np.quantile(own, 0.25)), OFF_PLANE))


def _steps(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Steps of another height, and labels of two faces exchanged, where one is a step or carries one.

    Other names carry no geometry.
    """
    column, probe = problem.instrument.groups, problem.instrument.probe
    if column is None or probe is None or not probe.steps:
        return
    for label in () if probe.knows_angles else probe.steps:
        cause, fix = f"the height of '{label}' seems to be another", "Measure it again, and correct it in the problem"
        yield Fault(f"height of '{label}'", cause, fix, partial(step_elsewhere, label=label), 1, common=False)
    names = samples.faces(column).names
    known = {*probe.steps, *(problem.instrument.instance("plane", step) for step in probe.steps)}
    pairs = combinations(names if len(names) <= MOST_FACES else (), 2)
    for one, two in (pair for pair in pairs if known & set(pair)):
        cause, fix = f"the labels '{one}' and '{two}' seem to be exchanged in all rows", "Exchange them"
        undo = OfRows(partial(exchanged, column=column, names={one: two, two: one}))
        yield Fault("labels exchanged", cause, fix, undo)


def exchanges(samples: Samples, off: Rows) -> Iterator[Fault]:
    """Two labels exchanged in all rows, where rows that lie off (N,) have no others."""
    for column, labels in samples.labels.items():
        names = [labels.names[code] for code in np.unique(labels.codes[off]).tolist()]
        if len(names) == 2:
            undo = OfRows(partial(exchanged, column=column, names={names[0]: names[1], names[1]: names[0]}))
            cause = f"the labels '{names[0]}' and '{names[1]}' seem to be exchanged in all rows"
            yield Fault("labels exchanged", cause, "Exchange them", undo, 1, common=False)


def exchanged(samples: Samples, *, column: str, names: Mapping[str, str]) -> Samples:
    """Rows with some of the labels of a column called otherwise."""
    faces = samples.faces(column)
    swapped = Labels(tuple(names.get(name, name) for name in faces.names), faces.codes)
    return replace(samples, labels={**samples.labels, column: swapped})


def exchanged_labels(problem: Problem, good: Samples, rest: Samples) -> tuple[str, str, str] | None:
    """Name, cause and cure of two labels that are exchanged in some rows alone; None where none are."""
    column = problem.instrument.groups
    names = () if column is None else rest.faces(column).names
    for one, two in combinations(names if len(names) <= MOST_FACES else (), 2):
        mended = exchanged(rest, column=column or "", names={one: two, two: one})
        if misfit(problem, joined(good, mended)) <= SUSPICIOUS:
            return "labels exchanged", f"'{one}' and '{two}' seem to be exchanged", "Correct the labels there"
    return None


def _zeros(problem: Problem) -> Iterator[Fault]:
    """The zero of a joint a quarter or half a turn from where the problem has it."""
    for i in np.flatnonzero(problem.robot.revolute).tolist():
        for turn in (90, -90, 180):
            cause = f"the zero of joint {i + 1} seems to be {turn} degrees from where the problem has it"
            fix = f"Add {turn} degrees to column q{i + 1}, or to theta of that joint; casacal doctor finds it as well"
            same = np.eye(len(problem.robot.axes))
            undo = _turned(same, math.radians(turn) * same[i])
            yield Fault(f"zero of joint {i + 1}", cause, fix, undo, 1, common=False)


def _rewritten(samples: Samples, *, suspect: Suspect) -> Samples:
    if suspect.change is not None:
        return replace(samples, columns=suspect.change(samples.columns))
    pairs = zip(suspect.columns, suspect.order or suspect.columns, strict=True)
    scaled = {name: samples.columns[true] * suspect.factor for name, true in pairs}
    return replace(samples, columns={**samples.columns, **scaled})


def _turned(matrix: Array, shift: Array | float = 0.0) -> Undo:
    return OfRows(lambda samples: replace(samples, joints=samples.joints @ matrix.T + shift))

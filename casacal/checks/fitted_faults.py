"""Faults of a size that must be found, such as a tool elsewhere, a drift or a gear."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.slots import ENOUGH
from casacal.checks.finding import FIRST_STEPS, Finding, Undone, misfit, quick_fit
from casacal.errors import CasacalError
from casacal.estimators import lm
from casacal.least_squares.result import Result
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.tables.columns import Labels
from casacal.uncertainty.figures import noise_interval
from casacal.uncertainty.prior_moves import chance_of_move
from casacal.unknowns import Parameter
from casacal.wording import listed

MOST_SCALE = 0.2  # part by which readings are too large beyond which it is no error of scale
ROUNDS = 4  # Gauss-Newton steps for the size of a fault; all are nearly linear in it

PLACES = 12
"""Places in the order of the rows at which something may have moved, before the best one is looked at closely."""

MOST_SHIFTS, WORTH = 3, 0.8  # shifts that are looked for; part of the misfit that a further one may leave

FEWEST = 5  # rows that a face needs on either side of such a place to have a plane there


def tool_keys(problem: Problem) -> list[str]:
    """Lengths of the instrument that say where its tip is; none for an instrument without one."""
    probe, unknowns = problem.instrument.probe, problem.instrument.unknowns
    moves = () if probe is None else probe.moves
    return [key for key in moves if isinstance(found := unknowns.get(key), Parameter) and found.unit == "mm"]


MEASURED = 1.0  # standard deviation, mm, with which people measure a tool
TOLD = 4.5  # cost, in units of the noise, by which rows tell two causes apart: three standard deviations


def priors_of(problem: Problem) -> Iterator[tuple[str, str, float, str]]:
    """Name, key, prior and unit of every free number of the arm that has a finite one."""
    for key, unknown in problem.robot.parameters.items():
        if isinstance(unknown, Parameter):
            for name, std, unit in zip(unknown.names(key), unknown.prior_stds, unknown.units, strict=True):
                if math.isfinite(std):
                    yield name, key, float(std), unit


def as_good(bound: BoundProblem, groups: Mapping[str, Sequence[str]], freed: Result) -> dict[str, str]:
    """Of groups of unknowns by title those that explain rows as well as a fit with something freed, and by how much.

    bound: the rows with every prior as stated. Each group is fitted with its own priors away.
    """
    found, cost = dict[str, str](), freed.cost + TOLD * max(noise_interval(freed)[0], 1.0) ** 2
    for title, keys in groups.items():
        try:
            other = bind(bound.problem.free(*keys).with_prior(dict.fromkeys(keys, math.inf)), *bound.samples)
            fitted = lm(other)
        except CasacalError:  # nothing of it can be freed
            continue
        if fitted.converged and fitted.cost <= cost:
            parts = tuple(f"{key}{sign}" for key in keys for sign in "_.")
            rows = [j for j, each in enumerate(other.names) if each in keys or each.startswith(parts)]
            far = max(rows, key=lambda j: abs(fitted.x[j]))
            found[title] = f"{other.names[far]} by {fitted.x[far]:+.3g} {other.units[far]}"
    return found


def alike_numbers(bound: BoundProblem, keys: Sequence[str]) -> dict[str, str]:
    """Numbers of the arm that explain rows as well as the tool (its keys) elsewhere does, and by how much."""
    problem = bound.problem.free(*keys)
    freed = lm(bind(problem.with_prior(dict.fromkeys(keys, math.inf)), *bound.samples))
    if problem.free_names() != bound.problem.free_names():  # a tool that is held is yet no better than one measures it
        bound = bind(problem.with_prior(dict.fromkeys(keys, MEASURED)), *bound.samples)
    return as_good(bound, {name: [name] for name, *_ in priors_of(bound.problem)}, freed)


def tool_elsewhere(problem: Problem, samples: Samples) -> Undone:
    """The tool point free of its prior, and where it then stands."""
    keys = tool_keys(problem)
    freed = problem.free(*(key for key in keys if not problem.instrument.unknowns[key].size))
    freed = freed.with_prior(dict.fromkeys(keys, math.inf))
    fitted = quick_fit(freed, samples)
    if fitted is None or not keys:
        return Undone(problem, samples)
    bound, result = fitted
    moved = {
        name: float(result.x[j])
        for slot in bound.slots
        if slot.key in keys
        for name, j in zip(slot.unknown.names(slot.name), slot.columns, strict=True)
    }
    said = ", ".join(f"{name} by {by:+.2f} mm" for name, by in moved.items())
    return Undone(freed, samples, f": {said}")


def drifting(problem: Problem, samples: Samples, *, column: str) -> Undone:
    """Readings less a drift in proportion to their place in the order of rows."""
    order = np.linspace(0.0, 1.0, len(samples))

    def less(samples: Samples, size: float) -> Samples:
        return replace(samples, columns={**samples.columns, column: samples.columns[column] - size * order})

    (size,) = _fitted(problem, samples, less)
    return Undone(problem, less(samples, size), f", by {size:+.3g} mm from the first row to the last")


def scaled(problem: Problem, samples: Samples, *, columns: Sequence[str]) -> Undone:
    """Readings less a part of each by which all are too large, or too small."""

    def less(samples: Samples, size: float) -> Samples:
        changed = {name: samples.columns[name] * (1 - size) for name in columns}
        return replace(samples, columns={**samples.columns, **changed})

    (size,) = _fitted(problem, samples, less)
    if abs(size) > MOST_SCALE:
        return Undone(problem, samples)
    return Undone(problem, less(samples, size), f", by {100 * size:+.3g} %")


def geared(problem: Problem, samples: Samples, *, turning: int, sliding: int) -> Undone:
    """A sliding joint that moves as another one turns, as the screw of a SCARA's quill does."""

    def with_lead(samples: Samples, size: float) -> Samples:
        joints = samples.joints.copy()
        joints[:, sliding] += size * joints[:, turning]
        return replace(samples, joints=joints)

    (size,) = _fitted(problem, samples, with_lead)
    return Undone(problem, with_lead(samples, size), f", by {2 * math.pi * size:+.4g} mm per turn")


def somewhere_moved(problem: Problem, samples: Samples) -> Undone:
    """Faces that count as others from some row on, at the place where all then fits best."""
    step = max(len(samples) // (PLACES + 1), 1)
    tried: dict[int, float] = {}

    def best_of(places: Sequence[int]) -> int:
        for place in places:
            if place not in tried and (later := _relabelled(problem, samples, place)) is not None:
                tried[place] = misfit(problem, later, steps=FIRST_STEPS)
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
    while len(places) < MOST_SHIFTS and (place := _where_shifted(problem, rows, column)) is not None:
        less = partial(_less_shifts, column=column, places=[*places, place])
        found = _fitted(problem, samples, less, start=(*sizes, 0.0))
        if (misses := misfit(problem, less(samples, *found))) > WORTH * left:
            break
        places, sizes, rows, left = [*places, place], found, less(samples, *found), misses
    shifts = sorted(zip(places, sizes, strict=True))
    said = " and".join(f" near line {samples.lines[place]}, by {size:+.3g} mm" for place, size in shifts)
    return Undone(problem, rows, said)


def _less_shifts(samples: Samples, *sizes: float, column: str, places: Sequence[int]) -> Samples:
    """Readings less a shift from each of some rows on."""
    shift = sum(size * (np.arange(len(samples)) >= place) for size, place in zip(sizes, places, strict=True))
    return replace(samples, columns={**samples.columns, column: samples.columns[column] - shift})


def _where_shifted(problem: Problem, rows: Samples, column: str) -> int | None:
    """The row from which a shift of the readings gains most; None where none can be told."""
    fitted, count = quick_fit(problem, rows), len(rows)
    if fitted is None or not 2 * FEWEST < count <= ENOUGH:
        return None
    bound, result = fitted
    here, places = bound.residual(result.x), np.arange(FEWEST, count - FEWEST)
    slope = (bound.on(_less_shifts(rows, SMALL, column=column, places=[0])).residual(result.x) - here) / SMALL
    later = bound.sample_of[:, None] >= places
    ways = freed_of_unknowns(bound, result, later * slope[:, None])
    gains = (ways.T @ weighted(bound, result, here)) ** 2 / np.maximum((ways**2).sum(axis=0), 1e-300)
    return int(places[np.argmax(gains)])


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


def _fitted(
    problem: Problem, samples: Samples, change: Callable[..., Samples], *, start: tuple[float, ...] = (0.0,)
) -> tuple[float, ...]:
    """Sizes of changes at which all fits best: Gauss-Newton in them, all unknowns fitted anew at each step.

    The slopes of the residuals by the sizes are freed of what the unknowns can follow, priors included.
    """
    sizes = np.array(start)
    if len(samples) > ENOUGH:
        return start
    for _ in range(ROUNDS):
        fitted = quick_fit(problem, change(samples, *sizes))
        if fitted is None:
            return (0.0,) * len(start)
        bound, result = fitted
        here = bound.residual(result.x)
        steps = (change(samples, *(sizes + step)) for step in SMALL * np.eye(len(sizes)))
        slopes = np.column_stack([(bound.on(changed).residual(result.x) - here) / SMALL for changed in steps])
        left = freed_of_unknowns(bound, result, slopes)
        if not left.any(axis=0).all():
            break
        sizes = sizes - np.linalg.lstsq(left, weighted(bound, result, here), rcond=None)[0]
    return tuple(map(float, sizes))


def weighted(bound: BoundProblem, result: Result, residual: Array) -> Array:
    """Residuals (rows + n,) of a robust fit as weighted, the prior's behind them."""
    return np.concatenate([np.sqrt(result.weights) * residual, bound.prior_rows @ (result.x - bound.x0)])


def freed_of_unknowns(bound: BoundProblem, result: Result, slopes: Array) -> Array:
    """Slopes (rows + n, k) of residuals (rows, k) as weighted, without what unknowns can follow, priors included."""
    root = np.sqrt(result.weights)[:, None]
    unknowns = np.vstack([root * bound.jacobian(result.x), bound.prior_rows])
    left = np.vstack([root * slopes, np.zeros((len(bound.prior_rows), slopes.shape[1]))])
    return np.asarray(left - unknowns @ np.linalg.lstsq(unknowns, left, rcond=None)[0])


SMALL = 1e-5  # step of the finite difference, mm or mm per rad
CHANCE = 1e-3  # chance that a tool as stated moves so far, all its components together

FAR = 2.0
"""Prior standard deviations that a component must move: where the model is wrong, small moves look improbable, too."""


def tool_elsewhere_at(bound: BoundProblem, x: Array, covariance: Array) -> list[Finding]:
    """A warning where the tool moved far beyond its prior in a fit, at its estimate (n,) with the covariance (n, n).

    Nothing for a held tool, or for one without a prior.
    """
    moves = {
        full[key]
        for instrument, full in zip(bound.problem.instruments, bound.problem.full_names, strict=True)
        if (probe := instrument.probe) is not None
        for key in probe.moves
    }
    named = {
        name: j
        for slot in bound.slots
        if slot.key in moves
        for name, j, unit in zip(slot.unknown.names(slot.name), slot.columns, slot.unknown.units, strict=True)
        if unit == "mm" and np.isfinite(bound.prior_std[j])
    }
    own = np.array(list(named.values()), dtype=np.intp)
    far = (np.abs(x[own]) > FAR * bound.prior_std[own]).any()
    if not far or chance_of_move(bound, x, covariance, own) > CHANCE:
        return []
    moved = ", ".join(f"{name} by {x[j]:+.2f} mm (its prior: {bound.prior_std[j]:.2g})" for name, j in named.items())
    cause = f"the samples put the tool in another place than the problem file does: {moved}"
    fix = "Measure the tool again, and correct its position or prior in the problem file"
    if others := alike_numbers(
        bound, [slot.key for slot in bound.slots if slot.key in moves and "mm" in slot.unknown.units]
    ):
        cause += f"; or {'; '.join(others.values())}, which these samples cannot tell from it"
        fix = f"Measure the tool from the flange first; only if it is as stated, look at {listed(list(others), 'or')}"
    return [Finding("warning", "tool elsewhere", cause, fix)]

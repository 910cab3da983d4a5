"""One thing that stood elsewhere from some row on: a face or a tool that was bumped, a joint that slipped.

Each unknown of the instrument, and each joint, may have a second value from row k on. To first order that adds columns
S_k to the residuals, the slopes by the unknown in the later rows and zeros before them, and what a fit with them leaves
is known without fitting again: w' w - |P w|^2, with w the whitened residuals and priors at the minimum and P the
projection on what the other unknowns cannot follow of S_k. This is looked at for every thing and place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from casacal.calibration.finding import Finding
from casacal.effects.selection import with_effects
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.lm import lm
from casacal.uncertainty.figures import effective_unknowns, noise_interval
from casacal.uncertainty.fresh_rows import spanned
from casacal.values import Array
from casacal.wording import listed, mm, sized, times

FEWEST = 5  # residuals that a thing needs on either side of a place
MOST_PLACES = 60  # that are looked at first; around the best of them then all
WELL = 1.3  # times the stated noise that may be left: a cause explains all, or else it is none
WORSE = 1.5  # times what is left that rows must miss by without it, also where effects beside the geometry are counted
BY_CHANCE = 1e-6  # of the best of all things and places
SMALL = 1e-5  # step of the finite difference, rad and mm


@dataclass(frozen=True)
class _Thing:
    """What may have moved: its name in a sentence, what to do, slopes (rows, k) of all residuals by its k numbers."""

    name: str
    fix: str
    slopes: Array


def moved_midway(bound: BoundProblem) -> Finding | None:
    """An error where one thing that moved once explains rows that miss otherwise, and nothing smooth does; else None.

    bound: rows of one instrument in their order, with the noise as stated.
    """
    result = lm(bound)
    rows, freedom = bound.rows, bound.rows - effective_unknowns(bound, result.x)
    if not result.converged or freedom < 2 * FEWEST:
        return None
    basis = spanned(np.vstack([bound.jacobian(result.x), bound.prior_rows]))
    whole = np.concatenate([bound.residual(result.x), bound.prior_rows @ (result.x - bound.x0)])
    before = math.sqrt(whole @ whole / freedom)
    if before < WORSE:
        return None

    def fall(thing: _Thing, place: int) -> tuple[float, int, Array]:
        """By how much chi-square falls, by how many numbers, and these (k,)."""
        later = bound.sample_of >= place
        moving = thing.slopes.any(axis=1)
        if min(int((moving & later).sum()), int((moving & ~later).sum())) < FEWEST:
            return 0.0, 1, np.zeros(0)
        ways = np.zeros((len(whole), thing.slopes.shape[1]))
        ways[:rows] = later[:, None] * thing.slopes
        ways -= basis @ (basis.T @ ways)
        numbers, _, rank, _ = np.linalg.lstsq(ways, whole, rcond=1e-9)
        return float(whole @ ways @ numbers), int(rank), numbers

    count = len(bound.measured)
    step = max(count // MOST_PLACES, 1)
    tried = [(*fall(each, place), each, place) for each in _things(bound, result.x) for place in range(1, count, step)]
    if not tried:
        return None
    thing = max(tried, key=lambda each: each[0] - each[1])[3]
    near = max((each for each in tried if each[3] is thing), key=lambda each: each[0])[4]
    places = range(max(near - step, 1), min(near + step + 1, count))
    (fallen, rank, numbers), place = max(((fall(thing, k), k) for k in places), key=lambda each: each[0][0])
    later = (bound.sample_of >= place) & thing.slopes.any(axis=1)
    place = int(bound.sample_of[np.argmax(later)])  # its own first row there
    left = math.sqrt(max(whole @ whole - fallen, 0.0) / (freedom - rank))
    if left > WELL or before < WORSE * left or _chance(fallen / rank / left**2, rank, freedom) * len(tried) > BY_CHANCE:
        return None
    smooth = lm(with_effects(bound, bound.problem))
    if smooth.converged and noise_interval(smooth)[0] < WORSE * left:
        return None
    shift = (thing.slopes @ numbers * bound.noise)[later & bound.leading]
    size, unit = math.sqrt(float((shift**2).mean())), bound.problem.words.unit
    stands = "stand" if " and " in thing.name else "stands"
    cause = f"{thing.name} {stands} elsewhere from line {bound.block.samples.lines[place]} on, by "
    cause += f"{mm(size) if unit == 'mm' else sized(size, unit)} (RMS in its readings): with that, rows miss by "
    cause += f"{times(left)} times the stated noise, not {times(before)} times"
    return Finding("error", f"{thing.name} moved", cause, thing.fix)


def _chance(ratio: float, numbers: int, freedom: float) -> float:
    """Chance of an F ratio so large, and more."""
    from scipy.special import fdtrc

    return float(fdtrc(numbers, freedom - numbers, ratio))


def _things(bound: BoundProblem, x: Array) -> Iterator[_Thing]:
    """Unknowns of the instrument, the faces that share one as well one by one, and the joints that turn."""
    jacobian, instrument, samples = bound.jacobian(x), bound.problem.instrument, bound.block.samples
    faces = samples.faces(instrument.groups)
    of_row = faces.codes[bound.sample_of]
    for slot in bound.slots:
        if slot.term or slot.key not in instrument.unknowns or not slot.unknown.size:
            continue
        slopes = jacobian[:, slot.columns.start : slot.columns.stop]
        codes = np.unique(of_row[slopes.any(axis=1)]).tolist()
        for own in [codes, *([code] for code in codes if 1 < len(codes) < len(faces.names))]:
            name, fix = f"the {slot.key}", "Fasten it, and measure the rows from there on again"
            if len(own) < len(faces.names):
                name = listed([f"'{faces.names[code]}'" for code in own])
                fix = "Measure its rows from there on again, or give them a label of their own, such as "
                fix += f"'{faces.names[own[0]]} later'"
            yield _Thing(name, fix, np.where(np.isin(of_row, own)[:, None], slopes, 0.0))
    here = bound.residual(x)
    for joint in np.flatnonzero(bound.problem.robot.revolute).tolist():
        joints = samples.joints.copy()
        joints[:, joint] += SMALL
        slope = (bound.on(replace(samples, joints=joints)).residual(x) - here) / SMALL
        fix = "Master that joint, and measure the rows from there on again"
        yield _Thing(f"joint {joint + 1}", fix, slope[:, None])

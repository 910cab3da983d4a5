"""Which cause explains the rows, and which touches would tell causes apart.

Each cause is fitted with the earlier posterior as the prior. Its evidence is the likelihood at its best, less what its
freedom costs (Occam's factor, with changes of a usual size, so that six numbers must explain more than one). A row that
is off is a cause like any other, and which of N rows it is costs the logarithm of N.

Two causes that explain the rows equally well leave the arm in two places. At new touches these differ by D, of which
each cause knows its part with a covariance S; half of D' S^-1 D is the logarithm of the odds to expect of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from casacal.array_types import Array
from casacal.calibration.fresh import Fresh
from casacal.changes.change import Change
from casacal.changes.look import Cause, Look, alone
from casacal.errors import CasacalError
from casacal.estimators import lm
from casacal.files import MADE, write_text
from casacal.least_squares.conditioned import Conditioned
from casacal.least_squares.gaussian import Gaussian
from casacal.least_squares.linalg import svd
from casacal.planning.candidates import drawn_touch, pool_of
from casacal.planning.route import FIT, postures_text, shortest_way
from casacal.problem.problem import Problem
from casacal.samples.samples import Layout, Samples
from casacal.simulation.cell import Cell, Face
from casacal.uncertainty.fresh_rows import chance, covariance_root, likelihood, occam

OFF = 100.0
"""Times its noise by which a row that is off usually is: a turn of a pointer that was not counted, 1 mm of 0.01 mm."""

SURE = 0.95  # part of the evidence from which on one cause is the one
ANYWHERE, STAYS = 100.0, 1e-3  # usual changes that what shows may be off by, and what does not show
STEPS = 60  # of the fit of a cause: the right one needs five, and a wrong one may creep along a valley for ever
UNEXPLAINED = 0.01  # chance of what a cause leaves unexplained, below which it is not the whole of it
UNUSUAL = 5.0  # usual changes, of 3 mrad or 3 mm each, beyond which one is not believed where another explains as much
NAMED = 0.02  # part of the evidence below which a cause is none of those that remain


@dataclass(frozen=True, eq=False)
class FittedCause:
    """A cause at its best: its unknowns (k,) with standard deviations, and everything.

    x (n,): all unknowns. root (n, v): of their covariance, along all that is known.
    """

    shift: Array
    std: Array
    x: Array
    root: Array


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause, or a row that is off.

    share: part of the evidence. left: chance of what it leaves unexplained. p: chance of as much explained where
    nothing changed. fitted: of a cause, but to first order.
    """

    cause: Cause | None
    row: int
    p: float
    left: float
    evidence: float
    share: float = 0.0
    fitted: FittedCause | None = None

    @property
    def far(self) -> bool:
        """Whether it would have changed by far more than would surprise nobody."""
        if self.cause is None or self.fitted is None:
            return False
        return bool((np.abs(self.fitted.shift) > UNUSUAL * self.cause.sizes).any())


def explanations(look: Look, *, linear: bool = False) -> list[Explanation]:
    """All causes that show in the rows, and single rows, the likeliest first.

    linear: causes to first order, which says nothing of where they leave the arm.
    """
    tests = look.tests
    by_cause, by_row, nothing = tests.found
    p_cause, p_row, _ = tests.p
    found = []
    for k, cause in enumerate(look.causes):
        if not look.seen(k):
            continue
        n, cost = int(tests.freedoms[k]), occam(look.slopes[k], cause.sizes)
        fitted, chi_square, p = None, nothing - float(by_cause[k]), float(p_cause[k])
        if not linear:
            _, _, rows = svd(look.slopes[k] * cause.sizes)
            used = cause.sizes[:, None] * rows[:n].T  # directions in its own unknowns along which it shows
            fitted, chi_square = _fitted(look, cause, used)
            p = chance(max(nothing - chi_square, 0.0), n, tests.noise)
        left, evidence = _judged(look, chi_square, n, cost)
        found.append(Explanation(cause, -1, p, left, evidence, fitted=fitted))
    per_row = tests.rows.shape[2]
    for k in np.flatnonzero(tests.row_freedoms > 0).tolist():
        cost = occam(alone(tests.fresh, k, per_row), np.full(per_row, OFF)) + math.log(tests.judged)
        left, evidence = _judged(look, nothing - float(by_row[k]), int(tests.row_freedoms[k]), cost)
        found.append(Explanation(None, k, float(p_row[k]), left, evidence))
    best = max((each.evidence for each in found), default=0.0)
    weights = [math.exp(each.evidence - best) for each in found]
    shared = [replace(each, share=weight / sum(weights)) for each, weight in zip(found, weights, strict=True)]
    return sorted(shared, key=lambda each: -each.share)


def _fitted(look: Look, cause: Cause, used: Array) -> tuple[FittedCause, float]:
    """A cause at its best with all that the calibration knows, and chi-square there.

    used: directions (k, n) of its unknowns along which it shows; along others it stays where it was.
    """
    fresh, n = look.fresh, look.fresh.bound.unknowns
    names = tuple(look.shifted.names[j] for j in cause.columns)
    free = ANYWHERE**2 * used @ used.T + STAYS**2 * np.diag(cause.sizes**2)
    known = fresh.gaussian.beside(Gaussian(names, np.zeros(len(names)), free))
    at = np.concatenate([fresh.x, np.zeros(look.shifted.unknowns - n)])
    kept = np.arange(at.size) < n
    kept[cause.columns] = True
    part = Conditioned(look.shifted.with_known(known), kept, at)
    found = lm(part, start=at[kept], max_steps=STEPS)
    x, covariance = part.expand(found.x), np.zeros((at.size, at.size))
    covariance[np.ix_(kept, kept)] = found.covariance
    variances = np.diagonal(covariance)
    bounded = np.flatnonzero(np.isfinite(variances) & (variances > 0))
    root = np.zeros((at.size, bounded.size))
    root[bounded] = covariance_root(covariance[np.ix_(bounded, bounded)])
    std = np.sqrt(np.maximum(variances[cause.columns], 0.0))
    return FittedCause(x[cause.columns], std, x, root), 2 * found.cost


def contenders(found: list[Explanation]) -> list[Explanation]:
    """The likeliest ones that together are sure, and whatever is nearly as likely as the last of them.

    One far beyond a usual size does not stand alone where another of a usual size explains the rows as well: a joint
    whose axis runs through the tip hardly shows, and could take over what a tool that was knocked does.
    """
    chosen, total = list[Explanation](), 0.0
    for each in found:
        if total >= SURE or (chosen and each.share < NAMED):
            break
        chosen.append(each)
        total += each.share
    if chosen and all(each.far for each in chosen):
        chosen += [each for each in found[len(chosen) :] if each.cause and each.left >= UNEXPLAINED and not each.far]
    return chosen


def _judged(look: Look, chi_square: float, freedom: int, cost: float) -> tuple[float, float]:
    """Chance of the chi-square that is left, and the evidence, after so many directions of such a cost were fitted."""
    whole, noise = look.tests.fresh.freedom, look.tests.noise
    return chance(chi_square, whole - freedom, noise), likelihood(chi_square, whole, noise) - cost


POOL = 400  # touches among which is chosen
WIDER = 1.5
"""Size of a face over the way between its touches: where somebody touched, one can touch again, and a little beside."""

LEAST = 20.0  # side of a face, mm, that has hardly been touched


def telling(
    problem: Problem, look: Look, found: list[Explanation], count: int, seed: int
) -> tuple[Samples | None, float]:
    """Touches that would tell causes apart, in the order of a short way, and the log-odds to expect of the worst pair.

    None where none are asked for, where there is but one cause beside rows that are off, where no touch is in reach.
    """
    causes = [each.fitted for each in found if each.fitted is not None]
    if not count or len(causes) < 2:
        return None, 0.0
    try:
        pool = pool_of(problem, _faces_of(problem, look.fresh), POOL, seed)
        there = look.shifted.on(replace(pool, sha256="pool"))
    except CasacalError:  # out of reach, or of faces that these rows do not know
        return None, 0.0
    told = []  # of each cause: whitened residuals (N, m), and their slopes (N, m, k) along what it leaves open
    for each in causes:
        slopes = there.jacobian(each.x) @ each.root
        told.append((there.residual(each.x).reshape(len(pool), -1), slopes.reshape(len(pool), -1, slopes.shape[1])))
    pairs = list(combinations(range(len(causes)), 2))
    chosen, odds = list[int](), 0.0
    for _ in range(min(count, len(pool))):
        gains = [
            -np.inf if k in chosen else min(_odds(told[a], told[b], [*chosen, k]) for a, b in pairs)
            for k in range(len(pool))
        ]
        chosen.append(int(np.argmax(gains)))
        odds = float(max(gains))
    order = shortest_way(problem.robot, pool.joints[chosen])
    best = pool.take([chosen[k] for k in order])
    return replace(best, lines=tuple(range(1, len(chosen) + 1)), file="planned touches"), odds


def _odds(one: tuple[Array, Array], two: tuple[Array, Array], rows: list[int]) -> float:
    """Logarithm of the odds to expect of some touches between two causes."""
    apart = (one[0][rows] - two[0][rows]).ravel()
    spread = np.eye(apart.size)
    for _, slopes in (one, two):
        part = slopes[rows].reshape(apart.size, -1)
        spread += part @ part.T / 2
    return float(apart @ np.linalg.solve(spread, apart)) / 2


def _faces_of(problem: Problem, fresh: Fresh) -> Cell | None:
    """The faces where fresh rows found them, as large as they were touched; None where none is touched."""
    probe, bound = problem.instrument.probe, fresh.bound
    if probe is None:
        return None
    samples = bound.block.samples
    _, _, tips, directions = drawn_touch(problem, probe, samples)
    rows_of, faces = samples.faces(problem.instrument.groups).rows(), list[Face]()
    for slot in bound.slots:
        kind, shown = slot.unknown.shown(slot.nominal, fresh.x[slot.columns.start : slot.columns.stop])
        label = slot.label if slot.label is not None else next(iter(rows_of))
        if kind != "planes" or label not in rows_of:
            continue
        rows, normal = rows_of[label], np.asarray(shown["normal"])
        normal = -normal if float((directions[rows] @ normal).mean()) > 0 else normal
        middle = tips[rows].mean(axis=0)
        middle -= normal * float(normal @ (middle - np.asarray(shown["point_mm"])))
        way = 2 * float(np.linalg.norm(tips[rows] - middle, axis=1).max()) / np.sqrt(2)
        side = max(WIDER * way, LEAST)
        faces.append(Face(label, tuple(middle.tolist()), tuple(normal.tolist()), (side, side)))
    # a face below the base plane was touched: the table is no higher
    return Cell(faces=tuple(faces), table=min(0.0, *(face.lowest for face in faces))) if faces else None


def write_touches(path: str | Path, found: Change, layout: Layout, name: str) -> None:
    """Write the touches of a `Change` in the form of a plan, whole or not at all; nothing where it has none."""
    if found.touches is None:
        return
    notes = [
        f"touches that would settle what changed for {name}, {MADE}: not a measurement",
        f"between {' and '.join(cause.name for cause in found.causes)}",
        "bring the arm to each posture, then along the plunger until the instrument reads; write down the joint values "
        "that the controller shows and the reading that there is, not the expected one; give them with the other rows",
    ]
    write_text(path, postures_text(found.touches, [FIT] * len(found.touches), layout, notes))

"""Which touches would tell causes apart: those at which they expect the most different readings, for their spread.

Two causes that explain the rows equally well leave the arm in two places. At new touches these differ by D, of which
each cause knows its part with a covariance S; half of D' S^-1 D is the logarithm of the odds to expect of them.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.changes.change import Change
from casacal.changes.explain import Explanation, Fitted
from casacal.changes.look import Look
from casacal.changes.posterior import Prior
from casacal.errors import CasacalError
from casacal.files import write_text
from casacal.planning.choice import drawn_touch, pool_of
from casacal.planning.route import FIT, postures_text, shortest_way
from casacal.problem.cell import Cell, Face
from casacal.problem.problem import Problem
from casacal.samples.layout import Layout
from casacal.samples.samples import Samples
from casacal.verification.fresh import Fresh

POOL = 400  # touches among which is chosen
WIDER = 1.5
"""Size of a face over the way between its touches: where somebody touched, one can touch again, and a little beside."""

LEAST = 20.0  # side of a face, mm, that has hardly been touched
TELLS = 3.0  # log-odds, twenty to one, from which touches tell causes apart


_Expected = tuple[Array, Array]
"""What a cause expects of each touch of a pool: whitened residuals (N, m), slopes (N, m, k) by its doubt."""


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
    told = [_expected(look, each, there) for each in causes]
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


def _expected(look: Look, fitted: Fitted, there: BoundProblem) -> _Expected:
    """Of an explanation: where it puts the arm, and what it leaves open."""
    posterior, count = fitted.posterior, len(there.block.samples)
    ways = np.hstack([Prior.of(look.fresh, look.shifted.unknowns).ways, fitted.ways])
    half = np.linalg.cholesky(posterior.covariance + 1e-18 * np.eye(len(posterior.covariance)))
    slopes = there.jacobian(posterior.x) @ ways @ half
    return there.residual(posterior.x).reshape(count, -1), slopes.reshape(count, -1, slopes.shape[1])


def _odds(one: _Expected, two: _Expected, rows: list[int]) -> float:
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
    return Cell(faces=tuple(faces)) if faces else None


def write_touches(path: str | Path, found: Change, layout: Layout, name: str) -> None:
    """Write the touches of a `Change` in the form of a plan, whole or not at all; nothing where it has none."""
    if found.touches is None:
        return
    notes = [
        f"touches that would settle what changed, by casacal for {name}: not a measurement",
        f"between {' and '.join(cause.name for cause in found.causes)}",
        "bring the arm to each posture, then along the plunger until the instrument reads; write down the joint values "
        "that the controller shows and the reading that there is, not the expected one; give them with the other rows",
    ]
    write_text(path, postures_text(found.touches, [FIT] * len(found.touches), layout, notes))

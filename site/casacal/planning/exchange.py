"""Which rows to take of many so that what they leave of an error is least: exchange (Fedorov 1972), I-optimal.

With C the posterior covariance of the unknowns and M the weight of their errors, trace(C M) is the mean squared error
of what is asked for (Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007, chapter 10). A row a (m, n), the m
whitened residuals of one measurement, lowers it by trace((1 + a C a')^-1 a C M C a'); without it, it rises likewise.
Rows are exchanged one by one for the best of all others until none is better. From nothing, one by one, such plans stay
on one face for ever: the first rows on another one tell of that face alone, and earn nothing. So they start at random.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array

SWEEPS = 10  # times that every row of a plan is tried against all others
BETTER = 1e-7  # part of the error by which an exchange must lower it

Chosen = NDArray[np.intp]


class Criterion(Enum):
    """What a plan makes small: the mean error of what is asked for, or the volume of what the unknowns may be."""

    TIP = "tip"
    """Trace of C M: I-optimal."""
    PARAMETERS = "parameters"
    """Determinant of C: D-optimal."""


@dataclass(frozen=True)
class Exchanged:
    """Rows of a plan (k,), the error that they leave (root of trace C M), and what was made small."""

    rows: Chosen
    error: float
    loss: float


def exchange(
    rows: Array,
    known: Array,
    weight: Array,
    start: Chosen,
    *,
    criterion: Criterion = Criterion.TIP,
    barred: NDArray[np.bool_] | None = None,
) -> Exchanged:
    """Improve a plan until no single exchange does.

    Args:
        rows: whitened slopes of every measurement that could be made (N, m, n).
        known: information (n, n) that there is without them, positive definite.
        weight: M (n, n).
        start: the plan to begin with (k,), no row twice.
        criterion: what is made small.
        barred: which measurements (N,) must not be taken.

    """
    plan, free = start.copy(), np.ones(len(rows), dtype=bool)
    free[plan] = False
    if barred is not None:
        free[barred] = False
    for _ in range(SWEEPS):
        changed = False
        for place in range(len(plan)):
            rest = np.delete(plan, place)
            covariance: Array = np.asarray(np.linalg.inv(_information(rows[rest], known)), dtype=np.float64)
            others = gains(rows, covariance, weight, criterion)
            others[~free] = -np.inf
            present = float(gains(rows[plan[place]][None], covariance, weight, criterion)[0])
            best = int(np.argmax(others))
            left = float(np.trace(covariance @ weight)) - present if criterion is Criterion.TIP else 1.0
            if others[best] > present + BETTER * left:
                free[plan[place]], free[best] = barred is None or not barred[plan[place]], False
                plan[place], changed = best, True
        if not changed:
            break
    error = error_of(rows[plan], known, weight)
    loss = error if criterion is Criterion.TIP else -float(np.linalg.slogdet(_information(rows[plan], known))[1])
    return Exchanged(plan, error, loss)


def error_of(rows: Array, known: Array, weight: Array) -> float:
    """Root of trace(C M) that some rows (k, m, n) leave."""
    return float(np.sqrt(np.trace(np.linalg.solve(_information(rows, known), weight))))


def _information(rows: Array, known: Array) -> Array:
    flat = rows.reshape(-1, known.shape[0])
    return np.asarray(known + flat.T @ flat)


def gains(rows: Array, covariance: Array, weight: Array, criterion: Criterion = Criterion.TIP) -> Array:
    """By how much each measurement (N, m, n) lowers trace(C M), or the logarithm of the determinant of C: (N,)."""
    size, unknowns = rows.shape[1:]
    flat = rows.reshape(-1, unknowns)
    seen = flat @ covariance
    moved = seen @ weight  # in one product: a stack of small ones takes many times as long
    if size == 1:
        spread = 1 + np.einsum("kn,kn->k", seen, flat)
        return np.asarray(np.log(spread) if criterion is Criterion.PARAMETERS else (moved * seen).sum(axis=1) / spread)
    seen, moved = seen.reshape(rows.shape), moved.reshape(rows.shape)
    spread = np.einsum("kin,kjn->kij", seen, rows) + np.eye(size)
    if criterion is Criterion.PARAMETERS:
        return np.asarray(np.linalg.slogdet(spread)[1])
    told = np.einsum("kin,kjn->kij", moved, seen)
    return np.asarray(np.trace(np.linalg.solve(spread, told), axis1=1, axis2=2))

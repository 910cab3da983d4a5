"""Each face predicted by the others: the arm fitted without it, its own plane alone fitted to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.estimators import lm
from casacal.least_squares.result import Result
from casacal.uncertainty.figures import HALF_WEIGHT
from casacal.uncertainty.fresh_rows import chance, covariance_root, expected

MOST_FACES = 12
"""Faces beyond which as many fits take long, and one face more or less says little."""

MOST_ROWS = 5_000
"""Rows beyond which they do, too."""


@dataclass(frozen=True)
class LeftOut:
    """A face as the others predict it: residuals of its rows, RMS in mm, found and predicted; chi-square, chance."""

    face: str
    rows: int
    actual_mm: float
    predicted_mm: float
    chi_square: float
    freedom: int
    p: float

    @property
    def ratio(self) -> float:
        """Found over predicted: about one where the model is right, more where it is not."""
        return self.actual_mm / self.predicted_mm


def leave_one_face_out(bound: BoundProblem, result: Result) -> tuple[LeftOut, ...]:
    """Fit the arm without each face in turn, and judge that face's rows by what the fit expects of them.

    Nothing where there is one face or very many, and no entry for a face without which the fit does not converge or
    which has no more rows than unknowns of its own. Rows that a robust loss ignored do not count.

    Args:
        bound: with the noise as it is used.
        result: its fit, from which each of these starts.

    """
    faces = bound.faces
    if not 2 <= len(faces.names) <= MOST_FACES or bound.rows > MOST_ROWS or bound.groups is not None:
        return ()
    found = []
    for face, rows in faces.rows().items():
        others = np.setdiff1d(np.arange(len(faces)), rows)
        one = _left_out(bound.take(others), bound, rows, result, face)
        found += [] if one is None else [one]
    return tuple(found)


def _left_out(
    others: BoundProblem, bound: BoundProblem, rows: NDArray[np.intp], result: Result, face: str
) -> LeftOut | None:
    fit = lm(others, start=result.x, loss=result.loss)
    if not fit.converged:
        return None
    known = np.isfinite(np.diagonal(fit.covariance))  # what the others do not hold, these rows alone know
    index = bound.residuals_of(rows)
    index = index[result.weights[index] >= HALF_WEIGHT]
    slopes = bound.jacobian(fit.x)[index]
    spread = slopes[:, known] @ covariance_root(fit.covariance[np.ix_(known, known)])
    judged = expected(bound.residual(fit.x)[index], spread, slopes[:, ~known])
    if judged.freedom < 1:
        return None
    of_unit = bound.leading[index]
    actual, predicted = (_rms((sizes * bound.noise[index])[of_unit]) for sizes in (judged.left, judged.std))
    p = chance(judged.chi_square, judged.freedom)
    return LeftOut(face, len(rows), actual, predicted, judged.chi_square, judged.freedom, p)


def _rms(values: Array) -> float:
    return math.sqrt(float((values**2).mean()))

"""Whether the fit, or an effect, predicts rows that it has not seen: faces, sessions, regions of postures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array, Index
from casacal.binding.bound_problem import BoundProblem
from casacal.estimators import lm
from casacal.least_squares.linalg import svd
from casacal.least_squares.result import Result
from casacal.samples.samples import Samples
from casacal.tables.columns import Labels
from casacal.uncertainty.effect_sizes import NormalEquations, evidence, told
from casacal.uncertainty.figures import HALF_WEIGHT, rms
from casacal.uncertainty.fresh_rows import FreshRows, chance, covariance_root

MOST_FACES = 12  # faces beyond which as many fits take long, and one face more or less says little
MOST_ROWS = 5_000  # rows beyond which they do, too


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
    if not 2 <= len(faces.names) <= MOST_FACES or bound.rows > MOST_ROWS:
        return ()
    found = []
    for face, rows in faces.rows().items():
        others = bound.take(np.setdiff1d(np.arange(len(faces)), rows))
        fit = lm(others, start=result.x, loss=result.loss)
        if not fit.converged:
            continue
        known = np.isfinite(np.diagonal(fit.covariance))  # what the others do not hold, these rows alone know
        index = bound.residuals_of(rows)
        index = index[result.weights[index] >= HALF_WEIGHT]
        slopes = bound.jacobian(fit.x)[index]
        spread = slopes[:, known] @ covariance_root(fit.covariance[np.ix_(known, known)])
        judged = FreshRows(bound.residual(fit.x)[index], spread, slopes[:, ~known])
        if judged.freedom < 1:
            continue
        of_unit = bound.leading[index]
        actual, predicted = (rms((sizes * bound.noise[index])[of_unit]) for sizes in (judged.left, judged.std))
        p = chance(judged.chi_square, judged.freedom)
        found.append(LeftOut(face, len(rows), actual, predicted, judged.chi_square, judged.freedom, p))
    return tuple(found)


FACES, REGIONS, INSTRUMENTS = "faces", "regions", "instruments"
"""Splits that samples have of themselves; further ones have the names of columns."""

MOST_PARTS = 12  # parts of a split; where labels are more, some are left out together
HALVINGS = 2  # how often the postures are halved into regions
GONE = 1e12  # times a prior's information by which an effect is taken away


def in_sample_gains(bound: BoundProblem, x: Array, keys: Iterable[str]) -> dict[str, float]:
    """By how much the logarithm of the rows' likelihood is larger with each effect than without it, at its size.

    That is what the whole adds up to, row by row; an effect that gains little there gains nothing elsewhere.

    Args:
        bound: with effects of sizes as found, and noise as found.
        x: its fit (n,).
        keys: of the effects.

    """
    rows, prior = told(bound, x), bound.prior_information
    whole = evidence(rows, prior)
    return {key: whole - evidence(rows, _without(bound, prior, key)) for key in keys}


def gains(bound: BoundProblem, x: Array, keys: Iterable[str]) -> dict[str, dict[str, float]]:
    """By how much the logarithm of the density of unseen rows is larger with each effect, by key and by split.

    Arguments as for `in_sample_gains`; of very many rows some stand for all. Returns no split where there is no face
    beside another, and no region that could be left out.
    """
    bound = bound.thinned(MOST_ROWS)
    slopes, r, prior = bound.jacobian(x), bound.residual(x), bound.prior_information
    heights = slopes @ (x - bound.x0) - r
    priors = {key: _without(bound, prior, key) for key in keys}
    found: dict[str, dict[str, float]] = {key: {} for key in priors}
    if len(bound.samples) == 1:
        parted = splits(bound.samples[0], bound.groups_by[0])
    else:
        every = bound.measured
        parted = _splits({FACES: bound.faces, INSTRUMENTS: Labels(every.names, every.instruments)}, every.joints)
    for name, parts in parted.items():
        rows = [bound.residuals_of(part) for part in parts]
        seen = [NormalEquations.of(slopes[part], heights[part]) for part in rows]
        whole = _densities(seen, prior)
        for key, without in priors.items():
            found[key][name] = whole - _densities(seen, without)
    return found


def _densities(seen: list[NormalEquations], prior: Array) -> float:
    """Sum over some parts of the logarithm of each one's density given the others, but for a constant."""
    whole, total = evidence(sum(seen[1:], seen[0]), prior), 0.0
    for k in range(len(seen)):
        others = [part for j, part in enumerate(seen) if j != k]
        rest = sum(others[1:], others[0])
        known = (np.diagonal(prior) > 0) | (
            np.diagonal(rest.information) > 0
        )  # a face that is left out stands where it likes
        total += whole - evidence(
            NormalEquations(rest.information[np.ix_(known, known)], rest.toward[known], rest.square),
            prior[np.ix_(known, known)],
        )
    return total


def splits(samples: Samples, face: str | None) -> dict[str, list[Index]]:
    """Rows that are left out together, by the name of the split: faces, regions, values of further columns."""
    columns = {FACES if name == face else name: labels for name, labels in samples.labels.items()}
    return _splits(columns, samples.joints)


def _splits(columns: Mapping[str, Labels], joints: Array) -> dict[str, list[Index]]:
    found = {}
    for name, labels in columns.items():
        groups = np.array_split(np.arange(len(labels.names)), min(MOST_PARTS, len(labels.names)))
        if len(groups) > 1:
            found[name] = [np.flatnonzero(np.isin(labels.codes, group)) for group in groups]
    regions = [np.arange(len(joints))]
    for _ in range(HALVINGS):
        regions = [half for region in regions for half in _halves(joints, region)]
    if len(regions) > 1:
        found[REGIONS] = regions
    return found


def _halves(joints: Array, rows: Index) -> list[Index]:
    """Rows on either side of the middle of the direction in which their postures spread most, joints all alike."""
    spread = joints.std(axis=0)
    places = joints[rows] / np.where(spread > 0, spread, 1.0)
    places = places - places.mean(axis=0)
    along = places @ svd(places)[2][0]
    order = rows[np.argsort(along, kind="stable")]
    halves = [np.sort(order[: len(order) // 2]), np.sort(order[len(order) // 2 :])]
    return [half for half in halves if half.size]


def _without(bound: BoundProblem, prior: Array, key: str) -> Array:
    """A prior's information (n, n) with an effect gone."""
    gone = np.array(bound.beside) == key
    return np.asarray(prior + np.diag(np.where(gone, GONE * np.diagonal(prior), 0.0)))

"""Noise as the rows show it: what was stated is the least, and what residuals hold on top of it is found.

A residual holds more than the instrument's repeatability: what the joints do not repeat, what the face is not, what the
model does not say. Fits, weights and intervals that take the stated noise for all of it trust the rows too much and
bend the arm to follow them. So noise is taken as stated times the factor at which found over used becomes one; the
prior stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import OTHERS, SHARED, BoundProblem
from casacal.estimators import lm
from casacal.least_squares.losses import Loss
from casacal.least_squares.result import Result
from casacal.samples.repeats import Repeats
from casacal.uncertainty.figures import HALF_WEIGHT, effective_unknowns, leverages, noise_interval, ratio_interval
from casacal.uncertainty.joint_repeatability import PureError, pure_error, repeats_in
from casacal.values import FrozenMapping, Value

SETTLED = 0.003  # relative change of the factor that ends the search
MOST_ROUNDS = 30  # fits to find it; each round leaves the part of its error that unknowns have of the rows
UNEQUAL = 1e-3  # chance of faces alike at which they are taken to differ in noise

SMOOTH = 4.0
"""Standard deviations beyond which the mean product of a face's neighbouring residuals is not that of noise."""

FEWEST = 8.0  # degrees of freedom of a face that can tell its own noise


@dataclass(frozen=True, eq=False)
class Noise(Value):
    """Found over stated noise with its 95 % interval, and the factor, one or more, with which each face is used.

    In `scale` "" stands for all faces that are not named. `repeats` is what touches of the same place say.
    """

    ratio: float
    low: float
    high: float
    scale: Mapping[str, float]
    repeats: PureError | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", FrozenMapping(self.scale))


def found_noise(bound: BoundProblem, loss: Loss | None = None) -> Noise:
    """The noise at which found over used is one, or what was stated where less was found.

    Fits of Levenberg-Marquardt, each with the noise that the one before it found. Faces get factors of their own where
    they differ more than chance explains (Bartlett's test) in what looks like noise. Where neighbouring rows of a face
    err alike, what is on top of the stated noise is no roughness of that face but something of the arm that the model
    does not say, and the other faces are not free of it because they show it less.

    Args:
        bound: with the noise as stated.
        loss: a robust loss, whose ignored rows do not count.

    """
    result, scale, shared = lm(bound, loss=loss), 1.0, 0.0
    again = None if loss is not None else repeats_in(bound)
    for _ in range(MOST_ROUNDS):
        # with a stated noise that is far too small rounding may keep a fit from its last digits; that is noise enough
        if not math.isfinite(result.cost) or (not result.converged and scale > 1):
            return noise_over_stated(result)
        known = None if again is None else pure_error(result, again)
        before, scale = (scale, shared), max(scale * _interval(result, again)[0], 1.0)
        shared = 0.0 if known is None else known.shared
        if abs(math.log(scale / before[0])) < SETTLED and abs(shared - before[1]) < SETTLED:
            break
        used = {OTHERS: scale, SHARED: shared} if shared else {OTHERS: scale}
        result = lm(bound.with_noise(used), start=result.x, loss=loss)
    own = None if shared else _by_face(result, scale)
    return noise_over_stated(result if own is None else _settled_by_face(bound, result, own, loss))


def _settled_by_face(bound: BoundProblem, result: Result, scale: Mapping[str, float], loss: Loss | None) -> Result:
    """The fit with a factor for each face."""
    for _ in range(MOST_ROUNDS):
        result = lm(bound.with_noise(scale), start=result.x, loss=loss)
        found = _by_face(result, 1.0, scale)
        if found is None or max(abs(math.log(found[name] / scale[name])) for name in found) < SETTLED:
            break
        scale = found
    return result


def noise_over_stated(result: Result) -> Noise:
    """What the residuals of a fit show over the noise as stated, whatever factors it was used with."""
    bound = result.problem
    assert isinstance(bound, BoundProblem)
    scale = bound.scale
    stated = bound.with_noise().noise
    of_a_touch = bound.with_noise({name: each for name, each in scale.items() if name != SHARED}).noise
    mean = math.sqrt(float((of_a_touch**2).sum() / (stated**2).sum()))
    if len(bound.samples) > 1:  # whose residuals may be of different units
        mean = math.sqrt(float(((of_a_touch / stated) ** 2).mean()))
    again = repeats_in(bound) if result.loss is None else None
    ratio, low, high = (mean * each for each in _interval(result, again))
    return Noise(ratio, low, high, scale, None if again is None else pure_error(result, again))


def _interval(result: Result, again: Repeats | None) -> tuple[float, float, float]:
    """Found over used noise; of groups of repeats where they share what the model leaves out."""
    bound = result.problem
    assert isinstance(bound, BoundProblem)
    if again is None or not bound.scale.get(SHARED, 0.0):
        return noise_interval(result)
    free = max(len(again.sizes) - effective_unknowns(bound, result.x), 1.0)
    alike = again.summed(bound.residual(result.x)) / np.sqrt(again.sizes)  # of the same scale as a single row
    return ratio_interval(float((alike**2).sum()), free)


def _by_face(result: Result, common: float, scale: Mapping[str, float] | None = None) -> dict[str, float] | None:
    """A factor for each face where they differ in noise, or where they did before; None where they do not."""
    bound = result.problem
    assert isinstance(bound, BoundProblem)
    faces = bound.noise_labels
    if len(faces.names) < 2:
        return None
    kept = result.weights >= HALF_WEIGHT
    squares, free = bound.residual(result.x) ** 2 * kept, kept - leverages(bound, result) * kept
    codes = faces.codes
    total, freedom = (np.bincount(codes, each, len(faces.names)).astype(np.float64) for each in (squares, free))
    if (freedom < FEWEST).any():
        return None
    if scale is None:
        if bartlett(total, freedom) > UNEQUAL or _smooth(bound, bound.residual(result.x)):
            return None
        scale = dict.fromkeys(faces.names, common)
    found = np.sqrt(total / freedom)
    return {name: max(scale[name] * float(each), 1.0) for name, each in zip(faces.names, found, strict=True)}


def _smooth(bound: BoundProblem, r: Array) -> bool:
    """Whether rows of some face that follow one another err alike: products of neighbours, of unit size each."""
    for rows in bound.faces.rows().values():
        own = r[bound.residuals_of(rows)].reshape(len(rows), -1)
        own = own / max(float(np.sqrt((own**2).mean())), 1e-300)
        products = own[1:] * own[:-1]
        if float(products.sum()) > SMOOTH * math.sqrt(max(products.size, 1)):
            return True
    return False


def bartlett(total: Array, freedom: Array) -> float:
    """Chance that variances, sums of squares (k,) over degrees of freedom (k,), differ so much (Bartlett 1937)."""
    from scipy.special import gammaincc

    if len(total) < 2:
        return 1.0  # nothing to differ from
    variance, pooled = np.maximum(total / freedom, 1e-300), max(float(total.sum() / freedom.sum()), 1e-300)
    spread = float(freedom.sum() * math.log(pooled) - (freedom * np.log(variance)).sum())
    faces = len(total)
    correction = 1 + (float((1 / freedom).sum()) - 1 / float(freedom.sum())) / (3 * (faces - 1))
    return float(gammaincc((faces - 1) / 2, max(spread / correction, 0.0) / 2))

"""Losses for rows that may be gross: how much a whitened residual costs, and what weight its row keeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from casacal.errors import ProblemError
from casacal.values import Array, as_given, is_finite

STEP = 1e-4  # standard deviations by which a residual is moved for a slope


@dataclass(frozen=True)
class Loss:
    """rho(r), which replaces r^2 / 2 in the objective, and the weight rho'(r) / r of each row; both elementwise.

    after: a loss at whose minimum to begin, where far rows lose all pull and an arm as drawn may have no other.
    """

    name: str
    cost: Callable[[Array], Array]
    weight: Callable[[Array], Array]
    after: Loss | None = None


def worth_under(loss: Loss, r: Array, unknowns: float = 0.0) -> float:
    """Factor on J'WJ at residuals r (N,) that makes it the information of the estimate.

    That of psi = rho' is J'J mean(psi')^2 / mean(psi^2), and not more than J'J: gross rows still pull, and their
    weights alone do not say so. The rows determine some unknowns n, for which it is (1 - n/N) / K^2 of that, with
    K = 1 + n/N var(psi') / mean(psi')^2 (Huber, Robust Statistics, 1981, section 7.6).
    """
    pull = loss.weight(r) * r
    ahead, behind = r + STEP, r - STEP
    slopes = (loss.weight(ahead) * ahead - loss.weight(behind) * behind) / (2 * STEP)
    slope, part = max(float(np.mean(slopes)), 0.0), min(unknowns, len(r) - 1.0) / len(r)
    spread, kept = float(np.mean(pull**2)), float(np.mean(loss.weight(r)))
    if not (spread > 0 and kept > 0 and slope > 0):
        return 1.0
    few = (1 - part) / (1 + part * float(np.var(slopes)) / slope**2) ** 2
    return min(few * slope**2 / spread, 1.0) / kept


def _checked(threshold: float) -> None:
    if not is_finite(threshold) or threshold <= 0:
        raise ProblemError(f"Got {as_given(threshold)} as the threshold of a loss", "Give a positive number")


def huber(threshold: float = 1.345) -> Loss:
    """Quadratic to `threshold` standard deviations, linear beyond: gross rows keep a bounded pull.

    1.345 keeps 95 % efficiency on Gaussian noise (Huber 1964).
    """
    _checked(threshold)

    def cost(r: Array) -> Array:
        size = np.abs(r)
        return np.where(size <= threshold, r**2 / 2, threshold * (size - threshold / 2))

    def weight(r: Array) -> Array:
        return np.minimum(1.0, threshold / np.maximum(np.abs(r), 1e-300))

    return Loss("huber", cost, weight)


WIDE = 15.0  # standard deviations beyond which a redescending loss needs no other to begin with but Huber's


def tukey(threshold: float = 4.685) -> Loss:
    """Redescending: rows beyond `threshold` standard deviations lose all pull, so it begins where `huber()` ends.

    4.685 keeps 95 % efficiency on Gaussian noise (Beaton and Tukey 1974).
    """
    _checked(threshold)

    def inside(r: Array) -> Array:
        return np.maximum(0.0, 1 - (r / threshold) ** 2)

    after = huber() if threshold > WIDE else tukey(2 * threshold)
    return Loss("tukey", lambda r: threshold**2 / 6 * (1 - inside(r) ** 3), lambda r: inside(r) ** 2, after=after)

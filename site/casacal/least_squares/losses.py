"""Losses for rows that may be gross: how much a whitened residual costs, and what weight its row keeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array


@dataclass(frozen=True)
class Loss:
    """rho(r), which replaces r^2 / 2 in the objective, and the weight rho'(r) / r of each row; both elementwise."""

    name: str
    cost: Callable[[Array], Array]
    weight: Callable[[Array], Array]


def huber(threshold: float = 1.345) -> Loss:
    """Quadratic to `threshold` standard deviations, linear beyond: gross rows keep a bounded pull.

    1.345 keeps 95 % efficiency on Gaussian noise (Huber 1964).
    """

    def cost(r: Array) -> Array:
        size = np.abs(r)
        return np.where(size <= threshold, r**2 / 2, threshold * (size - threshold / 2))

    def weight(r: Array) -> Array:
        return np.minimum(1.0, threshold / np.maximum(np.abs(r), 1e-300))

    return Loss("huber", cost, weight)


def tukey(threshold: float = 4.685) -> Loss:
    """Redescending: rows beyond `threshold` standard deviations lose all pull, so a good start is needed.

    4.685 keeps 95 % efficiency on Gaussian noise (Beaton and Tukey 1974).
    """

    def inside(r: Array) -> Array:
        return np.maximum(0.0, 1 - (r / threshold) ** 2)

    return Loss("tukey", lambda r: threshold**2 / 6 * (1 - inside(r) ** 3), lambda r: inside(r) ** 2)

"""Faces that are not flat: smooth heights without constant and tilt, which a plane would absorb."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from casacal.array_types import Array

COSINES = 100
"""Waves of random direction and length that make a Gaussian process."""


def form_error(rng: np.random.Generator, height: float, uv: Array, *, reach: float = 0.0) -> Array:
    """Smooth height (N,) of a face at positions uv (N, 2) in -1 ... 1, of the given peak-to-valley height.

    reach: distance over which heights are alike; 0 for cosines up to the second order in each direction.
    """
    field = _process(rng, reach) if reach > 0 else _cosines(rng)
    grid = _grid(21 if reach == 0 else int(np.clip(4 / reach, 21, 101)))
    return height * field(uv) / float(np.ptp(field(grid)))


def _grid(count: int) -> Array:
    side = np.linspace(-1, 1, count)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def _cosines(rng: np.random.Generator) -> Callable[[Array], Array]:
    """Cosines up to the second order in each direction."""
    orders = [(i, j) for i in range(3) for j in range(3) if i + j >= 2]
    weights, phases = rng.normal(size=len(orders)), rng.uniform(0, 2 * math.pi, size=(len(orders), 2))

    def field(points: Array) -> Array:
        return np.asarray(
            sum(
                w * np.cos(math.pi * i * points[:, 0] / 2 + a) * np.cos(math.pi * j * points[:, 1] / 2 + b)
                for (i, j), w, (a, b) in zip(orders, weights, phases, strict=True)
            )
        )

    return field


def _process(rng: np.random.Generator, reach: float) -> Callable[[Array], Array]:
    """A Gaussian process of covariance exp(-r^2 / (2 reach^2)), less its best plane.

    Random Fourier features (Rahimi and Recht, NIPS 2007): a sum of cosines whose wave vectors are drawn from the
    spectrum of that covariance.
    """
    vectors, phases = rng.normal(size=(COSINES, 2)) / reach, rng.uniform(0, 2 * math.pi, COSINES)

    def rough(points: Array) -> Array:
        return np.asarray(np.cos(points @ vectors.T + phases).sum(axis=1))

    def lifted(points: Array) -> Array:
        return np.column_stack([np.ones(len(points)), points])

    grid = _grid(21)
    plane = np.linalg.lstsq(lifted(grid), rough(grid), rcond=None)[0]
    return lambda points: rough(points) - lifted(points) @ plane

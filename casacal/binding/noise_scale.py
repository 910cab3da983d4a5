"""Noise as it was found: what was stated, times a factor for each face."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.blocks import Block
from casacal.samples.repeats import repeats_of
from casacal.samples.samples import Samples

OTHERS = ""
"""Stands for every face that is not named."""

SHARED = "\0shared"
"""Stands for the part of the noise's variance that repeated touches share; no label holds a zero byte."""


def scaled_noise(
    blocks: Sequence[Block], groups: Sequence[str | None], scale: Sequence[Mapping[str, float]]
) -> tuple[Block, ...]:
    """Blocks whose noise is what was stated times the factor of each row's face; as they are without factors."""
    if not scale:
        return tuple(blocks)
    return tuple(
        replace(block, noise=block.noise * factors(block.samples, column, some)[:, None])
        for block, column, some in zip(blocks, groups, scale, strict=True)
    )


def factors(samples: Samples, groups: str | None, scale: Mapping[str, float]) -> Array:
    """The factor of each row (N,).

    Where repeats share the part c of their variance, m of them weigh together like one of variance (1 + (m - 1) c) / m,
    the design effect of samples in clusters (Kish, Survey Sampling, 1965).
    """
    faces = samples.faces(groups)
    known = np.array([scale.get(name, scale.get(OTHERS, 1.0)) for name in faces.names], dtype=np.float64)
    found = known[faces.codes]
    if (shared := scale.get(SHARED, 0.0)) > 0:
        again = repeats_of(samples, groups)
        found = found * np.sqrt(1 + (again.sizes[again.codes] - 1) * shared)
    return np.asarray(found)


def times(scale: Mapping[str, float], factor: float) -> dict[str, float]:
    """Factors of the noise, each times another; what repeats share is a part of the noise and stays."""
    found = {name: value if name == SHARED else value * factor for name, value in scale.items()}
    return found if found.keys() - {SHARED} else {**found, OTHERS: factor}

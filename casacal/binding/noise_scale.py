"""Noise as it was found: what was stated, times a factor for each face."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.slots import Block
from casacal.samples.samples import Samples

OTHERS = ""
"""Stands for every face that is not named."""


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
    """The factor of each row (N,)."""
    faces = samples.faces(groups)
    known = np.array([scale.get(name, scale.get(OTHERS, 1.0)) for name in faces.names], dtype=np.float64)
    return np.asarray(known[faces.codes])

"""Noise as it was found: what was stated, times a factor for each face, and what the joints do not repeat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.all_rows import AllRows
from casacal.binding.blocks import Block

OTHERS = ""  # stands for every face that is not named

SHARED = "\0shared"
"""Stands for the part of the noise's variance that repeated touches share; no label holds a zero byte."""

REPEATABILITY = "\0joints"
"""Stands for what joints do not repeat, rad (`PER_RAD` mm of a sliding one are one), on top of the rest."""


def scaled_noise(rows: AllRows, scale: Mapping[str, float]) -> tuple[Block, ...]:
    """Blocks whose noise is what was stated times the factor of each row, with what joints do not repeat."""
    whole, joints, found = factors(rows, scale), scale.get(REPEATABILITY, 0.0), []
    for i, block in enumerate(rows.blocks):
        noise = block.noise * whole[rows.sample_rows(i)].reshape(block.noise.shape)
        found.append(replace(block, noise=np.hypot(noise, joints * block.joint_noise) if joints > 0 else noise))
    return tuple(found)


def factors(rows: AllRows, scale: Mapping[str, float]) -> Array:
    """The factor of each residual's stated noise (rows,).

    Where repeats share the part c of their variance, m of them weigh together like one of variance (1 + (m - 1) c) / m,
    the design effect of samples in clusters (Kish, Survey Sampling, 1965).
    """
    faces = rows.noise_labels
    known = np.array([scale.get(name, scale.get(OTHERS, 1.0)) for name in faces.names], dtype=np.float64)
    found = known[faces.codes]
    if (shared := scale.get(SHARED, 0.0)) > 0:
        again = rows.repeats
        found = found * np.sqrt(1 + (again.sizes[again.codes] - 1) * shared)[rows.sample_of]
    return np.asarray(found)


def by_face(scale: Mapping[str, float]) -> dict[str, float]:
    """The factors of faces alone."""
    return {name: value for name, value in scale.items() if name not in (SHARED, REPEATABILITY)}


def of_repeats(scale: Mapping[str, float]) -> dict[str, float]:
    """What repeats share alone: the noise as it was stated, but for that."""
    return {name: value for name, value in scale.items() if name == SHARED}


def without_joints(scale: Mapping[str, float]) -> dict[str, float]:
    """The same without what joints do not repeat."""
    return {name: value for name, value in scale.items() if name != REPEATABILITY}


def times(scale: Mapping[str, float], factor: float) -> dict[str, float]:
    """All noise times another factor; what repeats share is a part of the noise and stays."""
    found = {name: value if name == SHARED else value * factor for name, value in scale.items()}
    return found if by_face(found) else {**found, OTHERS: factor}

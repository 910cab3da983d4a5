"""Faces that a cell could have beside its own: raised, on a gauge block, at right angles, inclined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casacal.array_types import Array
from casacal.problem.cell import Face

STEP = 100.0
"""Height of a gauge block, mm."""
BLOCK = (35.0, 35.0)
"""Its top, mm."""


def raised(face: Face, by: float, label: str) -> Face:
    """The same face, so many mm along its normal."""
    return replace(face, label=label, centre=triple(np.asarray(face.centre) + by * face.axes[0]))


def block_on(face: Face, label: str) -> Face:
    """The top of a gauge block that stands in the middle of a face."""
    return replace(raised(face, STEP, label), size=BLOCK)


def rising(face: Face, towards: Array, label: str) -> Face:
    """A face at right angles that rises from the edge of another one and looks towards (3,) across it."""
    centre = np.asarray(face.centre) + 0.5 * face.size[0] * (face.axes[0] - towards)
    return Face(label, triple(centre), triple(towards), face.size)


def inclined(face: Face, by: float, towards: Array, label: str) -> Face:
    """The same face, turned by an angle (rad) so that it looks more towards (3,)."""
    return replace(face, label=label, normal=triple(math.cos(by) * face.axes[0] + math.sin(by) * towards))


def fresh(label: str, faces: Sequence[Face]) -> str:
    """A label that no face has, like the one given."""
    while any(face.label == label for face in faces):
        label += "'"
    return label


def triple(values: Array) -> tuple[float, float, float]:
    """Three numbers of an array (3,)."""
    x, y, z = (float(value) for value in values)
    return x, y, z

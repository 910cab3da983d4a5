"""Maps: means over small squares, and the colours that they are painted with."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.pages.drawing import nice_ceiling, number, picture, tag


@dataclass(frozen=True)
class Squares:
    """Lower left corners (k,) of squares that hold a point, their side, and the mean of the values in each (k,)."""

    x: Array
    y: Array
    side: float
    values: Array


def in_squares(points: Array, values: Array, most: int) -> Squares:
    """Means of values (N,) over squares that points (N, 2) fall into, `most` of them along the longer side."""
    low = points.min(axis=0)
    side = max(float(np.ptp(points, axis=0).max()) / most, 1e-9) * (1 + 1e-9)
    place = np.floor((points - low) / side).astype(np.int64)
    distinct, which = np.unique(place, axis=0, return_inverse=True)
    which = which.ravel()
    mean = np.bincount(which, weights=values) / np.bincount(which)
    return Squares(low[0] + side * distinct[:, 0], low[1] + side * distinct[:, 1], side, mean)


SIZES = ("#dce8f2", "#b9d2e6", "#8cb6d6", "#5b95c2", "#3573a8", "#1d4f86", "#0d2d57")
"""From small to large: light to dark."""
SIGNS = ("#0b4a8f", "#4b88c4", "#a3c3e2", "#d4d4d4", "#f2bd8c", "#dc7f2e", "#9c4a05")
"""From below to above: blue, grey, orange."""
UNBOUNDED = "#5a0f3c"


@dataclass(frozen=True)
class Scale:
    """Colours of the steps between edges, of which there is one fewer; the outer steps are open."""

    edges: tuple[float, ...]
    colours: tuple[str, ...]

    @staticmethod
    def of_sizes(values: Array) -> Scale:
        """Steps of a round number from zero to what nearly all values (N,) stay below."""
        step = nice_ceiling(_top(values) / len(SIZES))
        return Scale(tuple(step * k for k in range(1, len(SIZES))), SIZES)

    @staticmethod
    def of_signs(values: Array) -> Scale:
        """Steps of a round number below and above zero, the outer ones for a few in a hundred values (N,)."""
        middle = len(SIGNS) // 2
        step = nice_ceiling(_top(np.abs(values)) / (middle + 0.5))
        return Scale(tuple(step * k for k in range(-middle, middle + 1) if k), SIGNS)

    def parts(self, values: Array) -> Iterator[tuple[str, NDArray[np.intp]]]:
        """Each colour with the positions of the values (N,) that take it; unbounded ones come last."""
        finite = np.isfinite(values)
        step = np.searchsorted(np.array(self.edges), np.where(finite, values, 0.0), side="right")
        for k, colour in enumerate(self.colours):
            yield colour, np.flatnonzero(finite & (step == k))
        yield UNBOUNDED, np.flatnonzero(~finite)

    def key(self, name: str, words: str, *, unbounded: bool = False) -> Markup:
        """Picture of the steps with the numbers between them."""
        wide = (320.0 if unbounded else 364.0) / len(self.colours)
        parts = []
        for k, colour in enumerate(self.colours):
            box = {"x": number(20 + k * wide), "y": "22", "width": number(wide), "height": "12", "fill": colour}
            parts.append(tag("rect", at=box))
        for k, words_here in enumerate(rounded(self.edges), 1):
            parts.append(tag("text", words_here, at={"x": number(20 + k * wide), "y": "50", "class": "middle minor"}))
        parts.append(tag("text", words, at={"x": "20", "y": "14", "class": "title"}))
        if unbounded:
            parts.append(tag("rect", at={"x": "352", "y": "22", "width": "30", "height": "12", "fill": UNBOUNDED}))
            parts.append(tag("text", "unbounded", at={"x": "367", "y": "50", "class": "middle minor"}))
        says = f"{len(self.colours)} steps of colour, divided at {', '.join(rounded(self.edges))} mm."
        return tag("div", picture(name, words, says, 56.0, *parts), at={"class": "key"})


def rounded(edges: Sequence[float]) -> list[str]:
    """Edges with as many digits as the round step between them needs."""
    step = min(abs(edge) for edge in edges)
    digits = next(d for d in range(20) if math.isclose(round(step, d), step, rel_tol=1e-6))
    return [f"{edge:.{digits}f}".replace("-", "−") for edge in edges]


def _top(sizes: Array) -> float:
    """Round number that the sizes stay below, but for the largest few in a hundred."""
    finite = sizes[np.isfinite(sizes)]
    return nice_ceiling(float(np.quantile(finite, 0.98))) if len(finite) else 1.0

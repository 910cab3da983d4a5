"""Colours of numbers: a scale in steps, which print and colour-blind eyes can tell apart, and its key."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.html_report.drawing import nice_ceiling, number, picture
from casacal.html_report.markup import Markup, tag

Array: TypeAlias = NDArray[np.float64]

SIZES = ("#dce8f2", "#b9d2e6", "#8cb6d6", "#5b95c2", "#3573a8", "#1d4f86", "#0d2d57")
"""From small to large: light to dark."""
SIGNS = ("#0b4a8f", "#4b88c4", "#a3c3e2", "#d4d4d4", "#f2bd8c", "#dc7f2e", "#9c4a05")
"""From below to above: blue, grey, orange."""
UNBOUNDED = "#5a0f3c"


@dataclass(frozen=True)
class Scale:
    """Colours of the steps between edges; what lies beyond the outer ones takes the last colour."""

    edges: tuple[float, ...]
    colours: tuple[str, ...]

    @staticmethod
    def of_sizes(values: Array) -> Scale:
        """From zero to what nearly all values (N,) stay below."""
        top = _top(values)
        return Scale(tuple(top * k / len(SIZES) for k in range(len(SIZES) + 1)), SIZES)

    @staticmethod
    def of_signs(values: Array) -> Scale:
        """About zero, to what the size of nearly all values (N,) stays below."""
        top = _top(np.abs(values))
        return Scale(tuple(top * (2 * k / len(SIGNS) - 1) for k in range(len(SIGNS) + 1)), SIGNS)

    def parts(self, values: Array) -> Iterator[tuple[str, NDArray[np.intp]]]:
        """Each colour with the positions of the values (N,) that take it; unbounded ones come last."""
        finite = np.isfinite(values)
        step = np.searchsorted(np.array(self.edges[1:-1]), np.where(finite, values, 0.0), side="right")
        for k, colour in enumerate(self.colours):
            yield colour, np.flatnonzero(finite & (step == k))
        yield UNBOUNDED, np.flatnonzero(~finite)

    def key(self, name: str, words: str, *, unbounded: bool = False) -> Markup:
        """Picture of the steps with the numbers between them."""
        wide = 300.0 / len(self.colours)
        parts = []
        for k, colour in enumerate(self.colours):
            box = {"x": number(20 + k * wide), "y": "22", "width": number(wide), "height": "12", "fill": colour}
            parts.append(tag("rect", at=box))
        for k, words_here in zip(range(len(self.edges)), rounded(self.edges), strict=True):
            parts.append(tag("text", words_here, at={"x": number(20 + k * wide), "y": "50", "class": "middle small"}))
        parts.append(tag("text", words, at={"x": "20", "y": "14", "class": "title"}))
        if unbounded:
            parts.append(tag("rect", at={"x": "338", "y": "22", "width": "30", "height": "12", "fill": UNBOUNDED}))
            parts.append(tag("text", "unbounded", at={"x": "353", "y": "50", "class": "middle small"}))
        says = (
            f"{len(self.colours)} steps from {self.edges[0]:.3g} to {self.edges[-1]:.3g} mm; beyond, the last colour."
        )
        return tag("div", picture(name, words, says, 56.0, *parts), at={"class": "key"})


def rounded(edges: Sequence[float]) -> list[str]:
    """Edges with two digits of the largest one's step."""
    step = abs(edges[-1] - edges[0]) / (len(edges) - 1)
    digits = max(0, 1 - int(np.floor(np.log10(max(step, 1e-12)))))
    return ["0" if abs(edge) < step / 1e6 else f"{edge:.{digits}f}".replace("-", "−") for edge in edges]


def _top(sizes: Array) -> float:
    """Round number that the sizes stay below, but for the largest few in a hundred."""
    finite = sizes[np.isfinite(sizes)]
    return nice_ceiling(float(np.quantile(finite, 0.98))) if len(finite) else 1.0

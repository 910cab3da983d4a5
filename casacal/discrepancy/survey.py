"""What the fitted rows say of themselves, for effects to be worked out from: where faces lie, and when it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.samples.samples import Samples
from casacal.unknowns.fits import fitted_plane
from casacal.values import FrozenMapping


@dataclass(frozen=True)
class FaceFrame:
    """Where a face lies, as its touches say: centre (3, mm), two directions in it, half widths (mm)."""

    centre: tuple[float, ...]
    along: tuple[float, ...]
    across: tuple[float, ...]
    half: tuple[float, float]

    @staticmethod
    def of(tips: Array) -> FaceFrame:
        """Of the nominal tips (N, 3; mm) on a face."""
        plane = fitted_plane(tips)
        places = (tips - plane.centre) @ plane.across.T
        low, high = places.min(axis=0), places.max(axis=0)
        centre = plane.centre + (low + high) / 2 @ plane.across
        half = np.maximum((high - low) / 2, 1.0)
        along, across = (tuple(axis.tolist()) for axis in plane.across)
        return FaceFrame(tuple(centre.tolist()), along, across, (float(half[0]), float(half[1])))

    def places(self, tips: Array) -> Array:
        """Where tips (N, 3; mm) lie on it (N, 2), -1 to 1 from edge to edge."""
        axes = np.column_stack([self.along, self.across]) / np.array(self.half)
        return np.asarray((tips - np.array(self.centre)) @ axes)


@dataclass(frozen=True)
class Survey:
    """Where the fitted rows lie, and when they were measured."""

    faces: Mapping[str, FaceFrame]
    """By label; of those that were touched three times or more."""
    lines: tuple[int, int]
    """First and last line of the file."""
    samples: Samples
    """The rows themselves, or, of very many, some of them."""

    @staticmethod
    def of(samples: Samples, tips: Array, label: str | None) -> Survey:
        """Of samples with nominal tips (N, 3; mm), on faces that a column names."""
        faces = {
            name: FaceFrame.of(tips[rows]) for name, rows in samples.faces(label).rows().items() if len(rows) >= FEWEST
        }
        some = np.unique(np.linspace(0, len(samples) - 1, MANY).astype(int))
        lines = (int(min(samples.lines)), int(max(samples.lines)))
        return Survey(FrozenMapping(faces), lines, samples.take(some) if len(samples) > MANY else samples)

    def places(self, samples: Samples, tips: Array, label: str | None) -> Array:
        """Where on their faces rows lie (N, 2), -1 to 1; the middle of a face that was not fitted."""
        found = np.zeros((len(samples), 2))
        for name, rows in samples.faces(label).rows().items():
            if name in self.faces:
                found[rows] = self.faces[name].places(tips[rows])
        return found

    def when(self, samples: Samples) -> Array:
        """Place (N,) of samples between the first (0) and the last (1) line that was fitted."""
        first, last = self.lines
        return (np.asarray(samples.lines, dtype=np.float64) - first) / max(last - first, 1)


MANY = 2_000
"""Rows that stand for all of them."""

FEWEST = 3
"""Touches that say where a face lies."""


@dataclass(frozen=True)
class Rows:
    """Rows of an instrument, as effects see them before anything is fitted."""

    samples: Samples
    tips: Array
    """Nominal tips (N, 3; mm)."""
    survey: Survey
    """Of the rows that are fitted, these or others."""

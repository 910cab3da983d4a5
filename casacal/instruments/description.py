"""Description of an instrument: blocks of its residual, words, probe, suspected mistakes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, TypeAlias

import numpy as np

from casacal.array_types import Array, Rows
from casacal.errors import ProblemError
from casacal.unknowns import Plane
from casacal.unknowns.geometry import fitted_plane


@dataclass(frozen=True)
class ResidualBlock:
    """Some components of a residual, in their order.

    name: as reports call them. size: how many. unit: theirs. std: standard deviation of each, in that unit; or the name
    of the column that says it row by row.
    """

    name: str
    size: int
    unit: str
    std: float | str


@dataclass(frozen=True)
class Suspect:
    """A mistake that people make with columns: what it is called, seems to be, and needs.

    Undone by the factor; where they stand in the wrong order, each takes what stands in the column of `order`.
    """

    about: str
    cause: str
    fix: str
    columns: tuple[str, ...]
    factor: float
    order: tuple[str, ...] = ()


Dimension = Literal["length", "angle", "number"]


@dataclass(frozen=True)
class Sight:
    """What the nominal robot says about the rows that share one instance of an unknown."""

    poses: Array
    """Nominal flange poses, (N, 4, 4), mm."""
    tips: Array
    """Nominal tips, (N, 3), mm."""
    columns: Mapping[str, Array]
    """The rows' own columns and those known from labels, each (N,), in mm, rad or the user's unit."""
    plungers: Array | None = None
    """Nominal directions of the plunger, (N, 3), out of the tool; None for an instrument without one."""

    def touched_plane(self) -> Array:
        """Numbers (12,) of the total-least-squares plane through the tips, their known heights above it taken off.

        Its normal is towards the tool. Raises ProblemError when the tips lie on a line, so that no plane is seen.
        """
        heights = self.columns.get("height", np.zeros(len(self.tips)))
        values, counts = np.unique(heights, return_counts=True)
        normal = self.touched_normal(heights == values[np.argmax(counts)])
        return Plane.encode(normal, (self.tips - heights[:, None] * normal).mean(axis=0))

    def touched_normal(self, rows: Rows) -> Array:
        """Total-least-squares normal (3,) of the tips of some rows, against the mean plunger where there is one."""
        plane = fitted_plane(self.tips[rows])
        if not plane.flat:
            what = f"A plane was touched at {int(rows.sum())} tips on one line"
            raise ProblemError(what, "Spread the touches over the face")
        if self.plungers is None:
            return np.asarray(plane.normal)
        towards = float((self.plungers[rows] @ plane.normal).mean()) > 0
        return np.asarray(-plane.normal if towards else plane.normal)


COORDINATE = "residual of each coordinate"


@dataclass(frozen=True)
class Words:
    """How people read what an instrument measures."""

    residual: str = "residual"
    """What its residual is, as in "distance from the planes"."""
    unit: str = "mm"
    """Unit of the residual."""
    things: str = "samples"
    """What was measured, as in "the arm misses the held-out planes"."""
    before: str = "before"
    """What the control M0 fits, as in "planes fitted alone"."""
    trusted: str = ""
    """What its readings take for right and cannot tell, as in "noise, priors and the dial's gain are right"."""
    group: str = "face"
    """What rows of one label have in common, as in "each face by the others"."""
    accuracy: bool = False
    """Whether its residual is the error of the tip itself, all three axes; a distance from a face is not."""
    approach: str = ""
    """What to see to at each posture, as in "if the dial is at the end of its travel, move along the plunger"."""


Travel: TypeAlias = float | tuple[float, float]
"""Largest reading of a dial that begins at zero, or its smallest and largest, mm."""

OVERTRAVEL = 0.01  # part of its travel by which a dial may show more


def readings_within(travel: Travel) -> tuple[float, float]:
    """Smallest and largest reading, mm."""
    low, high = travel if isinstance(travel, tuple) else (0.0, travel)
    return float(low), float(high)


@dataclass(frozen=True)
class Probe:
    """A tip that touches flat faces, as simulation, checks and pictures know it.

    noise_std: of one measurement, mm. contact_std: of touch and form beside it, mm. column: what the reading along the
    plunger is called, None for contact alone. sign: +1 where a larger reading lengthens the tool. travel: smallest and
    largest reading, mm, or the largest alone where the smallest is zero. label: the column that names the faces, None
    where there is one face for all. moves: keys of the instrument's unknowns that tip and plunger depend on.
    knows_angles: whether the faces' angles to one another are certified. steps: labels of faces at a known height on
    another one. turn: what one turn of a pointer shows, mm; zero where there is none. zero, zero_label: key of the
    unknown that says where its zero stands, and the column whose values have one each; None where it was set once.
    """

    noise_std: float
    contact_std: float = 0.0
    column: str | None = None
    sign: int = 1
    travel: Travel = 0.0
    label: str | None = "plane"
    moves: tuple[str, ...] = ()
    knows_angles: bool = False
    steps: tuple[str, ...] = ()
    turn: float = 0.0
    zero: str | None = None
    zero_label: str | None = None


UNIT_MISTAKES = {
    25.4: "inches, written as mm",
    1 / 25.4: "mm, written as inches",
    10.0: "centimetres, written as mm",
    1000.0: "metres, written as mm, or mm, written as micrometres",
    0.001: "micrometres, written as mm",
}
"""Units in which readings may be by mistake, by the factor that corrects them."""

ANGLE_UNITS = {180 / math.pi: "radians, written as degrees", math.pi / 180: "degrees, written as radians"}
"""The same of angles."""

RENAME_UNIT = "Correct the unit in the column's name"


def units_mistaken(columns: Mapping[str, Dimension]) -> tuple[Suspect, ...]:
    """All lengths in another unit than their columns say."""
    lengths = tuple(name for name, dimension in columns.items() if dimension == "length")
    return tuple(
        Suspect("unit of the readings", f"the readings seem to be {words}", RENAME_UNIT, lengths, factor)
        for factor, words in UNIT_MISTAKES.items()
        if lengths
    )


def mistakes_in(columns: Mapping[str, Dimension]) -> tuple[Suspect, ...]:
    """Signs of lengths and angles, one by one, their units, and any two of one kind swapped."""
    kinds = {kind: [name for name, each in columns.items() if each == kind] for kind in ("length", "angle")}
    signs = []
    if len(kinds["length"]) == 1:
        cause, fix = "a longer way seems to be read as a shorter one", "Reverse the sign of the readings"
        signs.append(Suspect("sign of the lengths", cause, fix, tuple(kinds["length"]), -1.0))
    for name in (*(kinds["length"] if len(kinds["length"]) > 1 else ()), *kinds["angle"]):
        cause = f"column '{name}' seems to have the wrong sign"
        signs.append(Suspect(f"sign of '{name}'", cause, f"Reverse the sign of column '{name}'", (name,), -1.0))
    units = list(units_mistaken(columns))
    for factor, words in ANGLE_UNITS.items() if kinds["angle"] else ():
        cause = f"the angles that are read seem to be {words}"
        units.append(Suspect("unit of the angles", cause, RENAME_UNIT, tuple(kinds["angle"]), factor))
    swapped = (
        Suspect(f"'{one}' and '{two}' swapped", f"columns '{one}' and '{two}' seem to be swapped",
                "Swap the two column names", (one, two), 1.0, (two, one))
        for same in kinds.values()
        for one, two in combinations(same, 2)
    )  # fmt: skip
    return (*signs, *units, *swapped)

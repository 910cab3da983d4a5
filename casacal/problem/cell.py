"""A simulated cell: faces to touch, a dial with its faults, an arm with effects that its model does not describe."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.errors import SimulationError
from casacal.unknowns.unknown import tangent_basis, unit_vector

DIN_876 = {"0": (4.0, 250.0), "I": (10.0, 100.0), "II": (20.0, 50.0)}
"""Flatness of surface plates by grade: (a, b) of a + L / b in micrometres, L in mm."""

AMOUNTS = (
    "travel",
    "repeatability",
    "resolution",
    "joint_std",
    "backlash",
    "flatness",
    "compliance",
    "error_scale",
)
"""Numbers of a cell that are zero or positive."""


@dataclass(frozen=True)
class Face:
    """A rectangular face: its label, centre (3, mm), normal towards the tool, and side lengths (mm)."""

    label: str
    centre: tuple[float, float, float]
    normal: tuple[float, float, float]
    size: tuple[float, float] = (600.0, 600.0)

    @property
    def axes(self) -> Array:
        """Unit normal and the two directions of the sides, as rows (3, 3)."""
        unit = unit_vector(self.normal, f"The normal of face '{self.label}'")
        return np.vstack([unit, tangent_basis(unit).T])


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """What disturbs a simulated arm and its measurements, whatever measures it; lengths mm, angles rad.

    Args:
        repeatability: standard deviation of the reading (or of the touch, without a dial); None takes the instrument's.
        resolution: step in which readings are shown; 0 for none.
        joint_std: standard deviation of joint repeatability, rad (mm for a prismatic joint).
        backlash: play of each joint, rad (mm for a prismatic joint); a joint lags half of it behind its last move.
        outliers: fraction of rows that are gross.
        outlier_size: their size.
        error_scale: true parameters lie this many prior standard deviations (RMS) from nominal.

    """

    repeatability: float | None = None
    resolution: float = 0.001
    joint_std: float = 0.0
    backlash: float = 0.0
    outliers: float = 0.0
    outlier_size: float = 1.0
    error_scale: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.outliers < 1:
            raise SimulationError(f"The fraction of outliers is {self.outliers:g}", "Give 0 to less than 1")
        for name in AMOUNTS:
            value = getattr(self, name, None)
            if value is not None and not 0 <= value < math.inf:
                raise SimulationError(f"{name} of the cell is {value!r}", "Give zero or a positive number")


@dataclass(frozen=True, kw_only=True)
class Cell(Disturbances):
    """What surrounds and what disturbs a simulated arm that touches faces; lengths mm, angles rad.

    Args:
        faces: what is touched, in turn.
        tilt: largest angle between plunger and face normal; tilts are uniform over that cone.
        travel: range of the dial; None takes the instrument's.
        flatness: peak-to-valley height of a smooth form error of each face; see `flatness_din_876`.
        compliance: sag of the tip under gravity, RMS over the samples.

    The others are those of `Disturbances`.

    """

    faces: tuple[Face, ...]
    tilt: float = math.radians(30.0)
    travel: float | None = None
    flatness: float = 0.0
    compliance: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.faces:
            raise SimulationError("The cell has no face", "Give at least one")
        if len({face.label for face in self.faces}) < len(self.faces):
            raise SimulationError("Two faces of the cell share a label", "Name each face differently")
        for face in self.faces:
            _ = face.axes
            if min(face.size) <= 0:
                raise SimulationError(f"Face '{face.label}' has the size {face.size}", "Give two positive lengths")
        if not 0 <= self.tilt < math.pi / 2:
            raise SimulationError(f"The tilt is {math.degrees(self.tilt):g} degrees", "Give 0 to less than 90")


def plate(
    centre: Sequence[float], *, size: float = 600.0, normal: Sequence[float] = (0, 0, 1), label: str = "plate"
) -> tuple[Face, ...]:
    """One square face at `centre` (3, mm)."""
    return (Face(label, _triple(centre), _triple(normal), (size, size)),)


def corner(centre: Sequence[float], *, size: float = 600.0, towards: Sequence[float] = (-1, 0)) -> tuple[Face, ...]:
    """Three square faces at right angles around `centre` (3, mm): a floor, a wall and a side wall.

    Each face stands half its size from the centre and looks at it; `towards` (x, y) is where the wall looks, by
    default back at a base at the origin.
    """
    middle, half = np.asarray(centre, dtype=np.float64), size / 2
    ahead = unit_vector([*towards, 0.0], "The direction of the wall")
    aside = np.cross([0.0, 0.0, 1.0], ahead)
    normals = {"floor": np.array([0.0, 0.0, 1.0]), "wall": ahead, "side": aside}
    return tuple(
        Face(label, _triple(middle - half * normal), _triple(normal), (size, size)) for label, normal in normals.items()
    )


def gauge_block(
    centre: Sequence[float], *, step: float = 100.0, size: float = 100.0, normal: Sequence[float] = (0, 0, 1)
) -> tuple[Face, ...]:
    """Two parallel faces `step` mm apart: "base" at `centre` (3, mm) and "top" beside it, further along `normal`.

    Declare the length to the instrument with `steps={"top": Step(on="base", height=step)}`.
    """
    base = Face("base", _triple(centre), _triple(normal), (size, size))
    unit, aside, _ = base.axes
    return base, Face("top", _triple(np.asarray(centre) + step * unit + size * aside), _triple(normal), (size, size))


def flatness_din_876(grade: str, length: float) -> float:
    """Permitted flatness (mm) of a surface plate of `length` mm; grades 0, I, II."""
    if grade not in DIN_876:
        raise SimulationError(f"There is no grade '{grade}'", f"Grades of DIN 876 are {', '.join(DIN_876)}")
    base, divisor = DIN_876[grade]
    return (base + length / divisor) / 1000


def form_error(rng: np.random.Generator, height: float, uv: Array) -> Array:
    """Smooth height (N,) of a face at positions uv (N, 2) in -1 ... 1, of the given peak-to-valley height.

    Cosines up to the second order in each direction, without constant and tilt, which a plane would absorb.
    """
    orders = [(i, j) for i in range(3) for j in range(3) if i + j >= 2]
    weights, phases = rng.normal(size=len(orders)), rng.uniform(0, 2 * math.pi, size=(len(orders), 2))

    def field(points: Array) -> Array:
        return np.asarray(
            sum(
                w * np.cos(math.pi * i * points[:, 0] / 2 + a) * np.cos(math.pi * j * points[:, 1] / 2 + b)
                for (i, j), w, (a, b) in zip(orders, weights, phases, strict=True)
            )
        )

    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21)), axis=-1).reshape(-1, 2)
    return height * field(uv) / float(np.ptp(field(grid)))


def _triple(values: Sequence[float] | Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z

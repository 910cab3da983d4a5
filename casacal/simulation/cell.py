"""A simulated cell: faces to touch, a dial with its faults, an arm with effects that its model does not describe."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from casacal.errors import SimulationError, came
from casacal.model.instrument import Travel, readings_within
from casacal.model.problem_file import Surroundings
from casacal.model.unknown import tangent_basis, unit_vector
from casacal.values import Array, Box, Index, is_finite, is_real, plain

UNBOUNDED = "repeatability resolution joint_std backlash flatness compliance hysteresis drift error_scale"
AMOUNTS = dict.fromkeys(UNBOUNDED.split(), math.inf) | {
    "encoder_step": 0.1, "flatness_reach": 10.0, "thermal": 0.01, "dial_gain": 0.1, "dial_cycle": 0.1,
}  # fmt: skip
"""Numbers of a cell that are zero or positive, and the most that they mean something for."""

STEEPEST = 0.5  # slope (order times amplitude) from which a gear wave is none: the joint would hardly follow its motor


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """Disturbances of a simulated arm and its measurements, for any instrument; lengths mm, angles rad.

    Args:
        repeatability: standard deviation of the reading (or of the touch, without a dial); None takes the instrument's.
        resolution: step in which readings are shown; 0 for none.
        joint_std: standard deviation of joint repeatability, rad (mm for a prismatic joint).
        backlash: play of each joint, rad (mm for a prismatic joint); a joint lags half of it behind its last move.
        gear_waves: (order, amplitude) pairs, or a mapping: every turning joint stands off by amplitude *
            sin(order q + phase), rad, its phase drawn, its amplitude the same for all. 1 and 2 are eccentric encoders
            and wheels, 100 is the wave of a harmonic drive of that ratio.
        encoder_step: step in which the controller says joint values, rad (mm for a prismatic joint).
        outliers: fraction of rows that are gross.
        outlier_size: their size.
        error_scale: true parameters lie this many prior standard deviations (RMS) from nominal.
        table: height (mm, base frame) of what the arm stands on. Nothing of arm, tool or face is planned below it; by
            default the base plane, -inf where there is no table.
        keep_out: boxes that nothing of arm and tool is planned in: ranges of x, y, z each (mm, base frame).

    """

    repeatability: float | None = None
    resolution: float = 0.001
    joint_std: float = 0.0
    backlash: float = 0.0
    gear_waves: Mapping[int, float] | Sequence[tuple[int, float]] = ()
    encoder_step: float = 0.0
    outliers: float = 0.0
    outlier_size: float = 1.0
    error_scale: float = 1.0
    table: float = 0.0
    keep_out: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "keep_out", tuple(plain(self.keep_out)))
        for box in self.keep_out:
            from casacal.model.capsules import Solid  # most cells have none

            Solid.box("box", box)
        object.__setattr__(self, "gear_waves", _waves(self.gear_waves))
        if not 0 <= self.outliers < 1:
            raise SimulationError(f"The fraction of outliers is {self.outliers:g}", "Give 0 to less than 1")
        if not self.table < math.inf:
            raise SimulationError(f"table of the cell is {self.table!r}", "Give its height in mm, or -inf for none")
        for name, most in AMOUNTS.items():
            value = getattr(self, name, 0.0)
            if value is None and name == "repeatability":
                continue
            if not is_finite(value) or value < 0:
                raise SimulationError(f"{name} of the cell is {value!r}", "Give zero or a positive number")
            if value > most:
                raise SimulationError(f"{name} of the cell is {value:g}", f"Give at most {most:g}")

    @property
    def waves(self) -> tuple[tuple[int, float], ...]:
        """Order and amplitude (rad) of each gear wave."""
        return tuple(self.gear_waves)  # type: ignore[arg-type]  # pairs, once made


def _waves(stated: Mapping[int, float] | Sequence[tuple[int, float]]) -> tuple[tuple[int, float], ...]:
    """Pairs of order and amplitude; raises SimulationError for what is none."""
    pairs = stated.items() if isinstance(stated, Mapping) else stated
    try:
        waves = [(order, float(amplitude)) for order, amplitude in pairs]
    except (TypeError, ValueError, OverflowError):
        raise SimulationError(
            f"Got {came(stated)} as gear_waves", "Give {order: amplitude in rad}, such as {1: 1e-4}"
        ) from None
    for order, amplitude in waves:
        if isinstance(order, bool) or not isinstance(order, (int, np.integer)) or order < 1:
            raise SimulationError(f"A gear wave has the order {order!r}", "Give a whole number from one on")
        if not 0 <= amplitude * order < STEEPEST:
            fix = f"Give zero or a positive number of rad below {STEEPEST / order:g}"
            raise SimulationError(f"The gear wave of order {order} has the amplitude {amplitude:g}", fix)
    return tuple((int(order), amplitude) for order, amplitude in waves)


DIN_876 = {"0": (4.0, 250.0), "I": (10.0, 100.0), "II": (20.0, 50.0)}
"""Flatness of surface plates by grade: (a, b) of a + L / b in micrometres, L in mm."""

APPROACHES = ("same", "alternating", "random")


@dataclass(frozen=True)
class Face:
    """A rectangular face: its label, centre (3, mm), normal towards the tool, and side lengths (mm)."""

    label: str
    centre: tuple[float, float, float]
    normal: tuple[float, float, float]
    size: tuple[float, float] = (600.0, 600.0)

    def __post_init__(self) -> None:
        for name, count in (("centre", 3), ("normal", 3), ("size", 2)):
            given = plain(getattr(self, name))
            if not isinstance(given, tuple) or len(given) != count or not all(map(is_finite, given)):
                what = f"Face '{self.label}' has the {name} {given!r}"
                raise SimulationError(what, f"Give {count} finite numbers of mm")
            object.__setattr__(self, name, given)

    @property
    def axes(self) -> Array:
        """Unit normal and the two directions of the sides, as rows (3, 3)."""
        unit = unit_vector(self.normal, f"The normal of face '{self.label}'")
        return np.vstack([unit, tangent_basis(unit).T])

    @property
    def lowest(self) -> float:
        """Height (mm, base frame) of its lowest corner."""
        sides = np.abs(self.axes[1:, 2]) @ np.asarray(self.size) / 2
        return float(self.centre[2] - sides)


@dataclass(frozen=True, kw_only=True)
class Cell(Disturbances, Surroundings):
    """Surroundings and disturbances of a simulated arm that touches faces; lengths mm, angles rad.

    Args:
        faces: what is touched, in turn.
        tilt: largest angle between plunger and face normal; tilts are uniform over that cone.
        travel: range of the dial, as the instrument declares it; None takes the instrument's.
        flatness: peak-to-valley height of a smooth form error of each face; see `flatness_din_876`.
        flatness_reach: distance, in half widths of a face, over which heights are alike: the length of a Gaussian
            process of squared exponential covariance, without its plane. 0 for waves of first and second order.
        compliance: sag of the tip under gravity, RMS over 120 touches of the cell.
        thermal: growth of the arm about its base from the first row to the last, parts of one: 3e-5 is 30 um for each
            metre. Soon at first, as 1 - exp(-3 t).
        dial_gain: standard deviation of the dial's gain error, parts of one, drawn once: every true way is 1 + gain
            times what is shown. This and `dial_cycle` come on top of what the problem declares as unknown.
        dial_cycle: amplitude of an error that comes back with every turn of the pointer, at a random phase.
        hysteresis: the reading lags by half of it behind the way by which the plunger came.
        drift: growth of the readings from the first row to the last, linear in the order of the rows.
        repeats: touches of each place in a row, each time approached anew: joints and dial scatter again,
            while sag, gear waves and the height of the face stay.
        approach: the side from which joints and plunger come. "same": joints from the row before, the plunger always
            pushed in. "alternating": all from below and from above in turn, face by face, the plunger pushed in first
            and let out next. "random": each joint, and the plunger, from either side.

    The others are those of `Disturbances`.

    """

    faces: tuple[Face, ...]
    tilt: float = math.radians(30.0)
    travel: Travel | None = None
    flatness: float = 0.0
    flatness_reach: float = 0.0
    compliance: float = 0.0
    thermal: float = 0.0
    dial_gain: float = 0.0
    dial_cycle: float = 0.0
    hysteresis: float = 0.0
    drift: float = 0.0
    repeats: int = 1
    approach: Literal["same", "alternating", "random"] = "same"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.faces, (tuple, list)) or not all(isinstance(face, Face) for face in self.faces):
            raise SimulationError(f"Got {came(self.faces)} as the faces of the cell", "Give a tuple of Face")
        object.__setattr__(self, "faces", tuple(self.faces))
        if not self.faces:
            raise SimulationError("The cell has no face", "Give at least one")
        if len({face.label for face in self.faces}) < len(self.faces):
            raise SimulationError("Two faces of the cell share a label", "Name each face differently")
        for face in self.faces:
            _ = face.axes
            if min(face.size) <= 0:
                raise SimulationError(f"Face '{face.label}' has the size {face.size}", "Give two positive lengths")
        object.__setattr__(self, "travel", plain(self.travel))
        low, high = readings_within(0.0 if self.travel is None else self.travel)
        if not -math.inf < low <= high < math.inf:
            fix = "Give zero or a positive number, or the smallest and the largest reading"
            raise SimulationError(f"travel of the cell is {self.travel!r}", fix)
        if not (is_finite(self.tilt) and 0 <= self.tilt < math.pi / 2):
            said = f"{math.degrees(self.tilt):g} degrees" if is_real(self.tilt) else repr(self.tilt)
            raise SimulationError(f"The tilt is {said}", "Give 0 to less than 90 degrees, in rad")
        if isinstance(self.repeats, bool) or not isinstance(self.repeats, (int, np.integer)) or self.repeats < 1:
            raise SimulationError(f"Each place is touched {self.repeats!r} times", "Give a whole number from one on")
        if self.approach not in APPROACHES:
            fix = f"Give {', '.join(map(repr, APPROACHES[:-1]))} or '{APPROACHES[-1]}'"
            raise SimulationError(f"The approach is {self.approach!r}", fix)

    def face(self, label: str) -> Face:
        """The face of a label, or the first where none is called so."""
        return next((face for face in self.faces if face.label == label), self.faces[0])


OF_FACES = tuple(field.name for field in fields(Cell)[len(fields(Disturbances)) :] if field.name != "faces")
"""Settings that only a cell with faces has."""

OF_TOUCHES = tuple(name for name in OF_FACES if name not in ("tilt", "travel"))
"""Settings that are refused where no face is touched."""

OF_DIALS = ("dial_gain", "dial_cycle", "hysteresis", "drift")  # settings that only a reading shows


def plate(
    centre: Sequence[float], *, size: float = 600.0, normal: Sequence[float] = (0, 0, 1), label: str = "plate"
) -> tuple[Face, ...]:
    """One square face at `centre` (3, mm)."""
    return (Face(label, triple(centre), triple(normal), (size, size)),)


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
        Face(label, triple(middle - half * normal), triple(normal), (size, size)) for label, normal in normals.items()
    )


def gauge_block(
    centre: Sequence[float], *, step: float = 100.0, size: float = 100.0, normal: Sequence[float] = (0, 0, 1)
) -> tuple[Face, ...]:
    """Two parallel faces `step` mm apart: "base" at `centre` (3, mm) and "top" beside it, further along `normal`.

    Declare the length to the instrument with `steps={"top": Step(on="base", height=step)}`.
    """
    base = Face("base", triple(centre), triple(normal), (size, size))
    unit, aside, _ = base.axes
    return base, Face("top", triple(np.asarray(centre) + step * unit + size * aside), triple(normal), (size, size))


def flatness_din_876(grade: str, length: float) -> float:
    """Permitted flatness (mm) of a surface plate of `length` mm; grades 0, I, II."""
    if grade not in DIN_876:
        raise SimulationError(f"There is no grade '{grade}'", f"Grades of DIN 876 are {', '.join(DIN_876)}")
    base, divisor = DIN_876[grade]
    return (base + length / divisor) / 1000


def rectangles(faces: Sequence[Face]) -> tuple[Array, Array, Array]:
    """Axes (N, 3, 3), centres (N, 3; mm) and half sides (N, 2; mm) of faces."""
    axes, centres, sizes = (np.array([getattr(face, name) for face in faces]) for name in ("axes", "centre", "size"))
    return axes, centres, sizes / 2


def triple(values: Sequence[float] | Array) -> tuple[float, float, float]:
    """Three numbers of an array or a sequence (3,)."""
    x, y, z = (float(value) for value in values)
    return x, y, z


PLATE = 20.0  # mm; how thick a plate is that lies on the table
COSINES = 100  # waves of random direction and length that make a Gaussian process


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


def levels(cell: Cell, which: Index, uv: Array, seeds: Sequence[int | None], lift: Array) -> Array:
    """Heights n . x (N,; mm) of touches at places uv (N, 2; -1 to 1) of their faces, with form and lift."""
    axes, centres, _ = (each[which] for each in rectangles(cell.faces))
    heights: Array = lift + (axes[:, 0] * centres).sum(axis=1)
    for i, seed in enumerate(seeds):
        if seed is not None:
            here = which == i
            form_rng = np.random.default_rng(seed)
            heights[here] += form_error(form_rng, cell.flatness, uv[here], reach=cell.flatness_reach)
    return heights

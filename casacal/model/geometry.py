"""Directions, planes and frames, free or held as a whole, and their fits to points, rotations and poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np

from casacal.errors import ProblemError, came
from casacal.model.kinematics import Expression, rigid, rotation_of_quaternion, turns_of
from casacal.model.unknown import Unknown, check_stds, spread, start_stds, tangent_basis, unit_vector
from casacal.values import Array, is_real, plain


class Whole(Unknown):
    """An unknown that is free or held as a whole; raw, it has one number more and one constraint of unit length."""

    free: bool
    prior_std: float | tuple[float, float]
    start_std: float | tuple[float, float] | None
    parts: ClassVar[tuple[tuple[str, str], ...]]  # suffix of the name of each local coordinate, and its unit
    unit_length: ClassVar[int] = 3  # number of leading raw coordinates that form a unit vector or quaternion
    held_as_proposed: bool
    encode: ClassVar[Callable[..., Array]]  # what it is declared by, as numbers (nominal_size,)
    unsaid: ClassVar[tuple[str, str]]  # words for a missing nominal value of a held unknown, and the fix to suggest

    def __post_init__(self) -> None:
        assert is_dataclass(self)
        for each in fields(self):
            object.__setattr__(self, each.name, plain(getattr(self, each.name)))
        kind, (lacks, fix) = type(self).__name__.lower(), self.unsaid
        if self.nominal is None and not self.free and not self.held_as_proposed:  # or a sentence
            raise ProblemError(f"A {kind} is held but has {lacks}", f"{fix}, or leave it free")
        check_stds(spread(self.prior_std, 2, f"prior_std of a {kind}"), f"prior_std of a {kind}")

    @property
    def size(self) -> int:
        """Number of local coordinates: one for each part, or none when held."""
        return len(self.parts) if self.free else 0

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the local coordinates."""
        return tuple(unit for _, unit in self.parts)[: self.size]

    @property
    def prior_stds(self) -> Array:
        """Prior standard deviations: those in rad share one, and those in mm another."""
        return self._each(self.prior_std)

    @property
    def start_stds(self) -> Array:
        """Prior or start standard deviations."""
        start = None if self.start_std is None else self._each(self.start_std)
        return start_stds(self.prior_stds, start, self.units, f"a {type(self).__name__.lower()}")

    def _each(self, pair: float | tuple[float, float]) -> Array:
        """Array (size,) of one number for local coordinates in rad and another for those in mm."""
        turn, shift = spread(pair, 2, f"prior_std of a {type(self).__name__.lower()}")
        return np.array([turn if unit == "rad" else shift for unit in self.units])

    @property
    def raw_size(self) -> int:
        """Number of raw coordinates: one more than local ones, or none when held."""
        return self.size + 1 if self.free else 0

    def recentred(self, nominal: Array, local: Array) -> Array:
        """Numbers of what stands there, as it is shown."""
        there = self.shown(nominal, local)[1]
        return self.encode(*(there.values() if isinstance(there, dict) else [there]))

    def raw_constraints(self, raw: Expression) -> list[Expression]:
        """n'n - 1 of a normal or a direction, q'q - 1 of a quaternion."""
        return [ca.sumsqr(raw[: self.unit_length]) - 1] if self.free else []

    def names(self, key: str) -> tuple[str, ...]:
        """Names of the local coordinates, such as key.tilt1, key.tilt2."""
        return tuple(f"{key}.{part}" for part, _ in self.parts)[: self.size]

    def with_free(self, free: Sequence[bool]) -> Self:
        """Copy, free or held as a whole; raises ProblemError for a part of it."""
        if len(set(free)) > 1:
            what = f"a {type(self).__name__.lower()}"
            raise ProblemError(f"Only a part of {what} would be held", f"Hold or free {what} as a whole")
        assert is_dataclass(self)
        return replace(self, free=any(free), held_as_proposed=True)

    def with_prior(self, stds: Sequence[float]) -> Self:
        """Copy with another prior; coordinates of one unit share a standard deviation, so naming any sets them all."""
        found = [float(std) for std in spread(self.prior_std, 2, "prior_std")]
        for k, unit in enumerate(("rad", "mm")):
            rows = zip(stds, self.prior_stds, self.units, strict=True)
            found[k] = max((float(new) for new, old, each in rows if each == unit and new != old), default=found[k])
        assert is_dataclass(self)
        return replace(self, prior_std=tuple(found) if any(unit == "mm" for _, unit in self.parts) else found[0])


def stereographic(local: Expression) -> tuple[Expression, Expression]:
    """Point of the unit sphere at local coordinates u: (along the pole, across it).

    Inverse stereographic projection, smooth without square roots: ((1 - s), u) / (1 + s) with s = |u|^2 / 4.
    To second order |u| is the angle in rad (|u| = 2 tan(angle / 2)).
    """
    s = ca.dot(local, local) / 4
    return (1 - s) / (1 + s), local / (1 + s)


def stereographic_local(along: Expression, across: Expression) -> Expression:
    """Local coordinates of a point of the unit sphere: 2 across / (1 + along), the inverse of `stereographic`."""
    return 2 * across / (1 + along)


def tilted(nominal: Expression, tilts: Expression) -> Expression:
    """Unit vector (3) at two tilts, rad, about a nominal one, with which two vectors across it stand (9)."""
    along, across = stereographic(tilts)
    return along * nominal[:3] + across[0] * nominal[3:6] + across[1] * nominal[6:9]


def tilts_of(nominal: Expression, vector: Expression) -> Expression:
    """The two tilts of a unit vector (3), the inverse of `tilted`."""
    across = ca.vertcat(ca.dot(nominal[3:6], vector), ca.dot(nominal[6:9], vector))
    return stereographic_local(ca.dot(nominal[:3], vector), across)


@dataclass(frozen=True)
class Direction(Whole):
    """A unit vector (3,) with two local coordinates, both angles in rad.

    Args:
        vector: nominal direction, normalised here; None when the data are to propose it.
        prior_std: standard deviation of each of the two tilts, rad; `math.inf` is flat.
        start_std: where filters start them when the prior is flat, rad.
        free: False holds the direction.
        per: name of a label column; one instance for each of its values.
        held_as_proposed: True holds it where the data propose it, as `Problem.fix` does.

    """

    vector: Sequence[float] | None
    prior_std: float = math.inf
    start_std: float | None = None
    free: bool = True
    per: str | None = None
    held_as_proposed: bool = False

    nominal_size = 9
    parts = (("tilt1", "rad"), ("tilt2", "rad"))
    unsaid = ("no vector", "Say where it points")

    def __post_init__(self) -> None:
        if not is_real(self.prior_std):
            raise ProblemError(f"Got {came(self.prior_std)} as the prior_std of a direction", "Give one number of rad")
        super().__post_init__()

    @property
    def nominal(self) -> Array | None:
        """Unit vector (3) and two vectors across it (6); None when the data must propose it."""
        return None if self.vector is None else self.encode(self.vector)

    @staticmethod
    def encode(vector: Sequence[float] | Array) -> Array:
        """Numbers (9,) that fix a nominal direction; raises ProblemError for no vector (3,) that points anywhere."""
        unit = unit_vector(vector, "A direction")
        return np.concatenate([unit, tangent_basis(unit).T.ravel()])

    def at(self, nominal: Expression, local: Expression) -> Expression:
        """Unit vector (3,) at two tilts."""
        return tilted(nominal, local) if self.free else nominal[:3]

    def shown(self, nominal: Array, local: Array) -> tuple[str, Any]:
        """Unit vector (3,)."""
        return "directions", np.asarray(ca.DM(self.at(nominal, local))).ravel()

    def placed(self, near: Array, normal: Array) -> Array:
        """Unit vector (3,), as the normal of a face."""
        del near
        return self.encode(normal)

    def raw_start(self, nominal: Array) -> Array:
        """Return the three components themselves."""
        return np.asarray(nominal)[:3]

    def raw_value(self, nominal: Expression, raw: Expression) -> Expression:
        """Return the raw vector, unit only where the constraint holds."""
        del nominal
        return raw

    def raw_local(self, nominal: Expression, raw: Expression) -> Expression:
        """Two tilts of a raw unit vector."""
        return tilts_of(nominal, raw)


@dataclass(frozen=True)
class PlaneValue:
    """A plane at given coordinates: the points at `offset` mm from `base` along `normal`."""

    normal: Expression
    base: Expression
    offset: Expression

    @property
    def point(self) -> Expression:
        """A point on the plane (3, mm): gamma of eq (6), arXiv:2208.02652."""
        return self.base + self.offset * self.normal

    def distance(self, point: Expression) -> Expression:
        """Signed distance (mm) of a point (3, mm): eq (6) with a unit normal, n . (p - gamma)."""
        return ca.dot(self.normal, point - self.base) - self.offset


@dataclass(frozen=True)
class Plane(Whole):
    """A plane with three local coordinates: two tilts of its normal (rad) and an offset along it (mm).

    Three, not six: of a normal and a point only the unit normal and n . gamma can be seen (erratum E7).

    Args:
        normal, point: nominal plane, mm; both None when the data are to propose it (total least squares).
        prior_std: (tilt in rad, offset in mm) standard deviations; `math.inf` is flat.
        start_std: the same, where filters and populations start when the prior is flat.
        free: False holds the plane where it is declared.
        per: name of a label column; one plane for each of its values.
        held_as_proposed: True holds it where the data propose it, as `Problem.fix` does.

    """

    normal: Sequence[float] | None = None
    point: Sequence[float] | None = None
    prior_std: float | tuple[float, float] = math.inf
    start_std: tuple[float, float] = (0.01, 10.0)
    free: bool = True
    per: str | None = None
    held_as_proposed: bool = False

    nominal_size = 12
    parts = (("tilt1", "rad"), ("tilt2", "rad"), ("offset", "mm"))
    unsaid = ("no normal and no point", "Say where it is")

    def __post_init__(self) -> None:
        if (self.normal is None) != (self.point is None):
            raise ProblemError("A plane has a normal or a point but not both", "Give both, or neither")
        super().__post_init__()

    @property
    def nominal(self) -> Array | None:
        """Normal (3), two vectors across it (6), base point (3, mm); None when the data must propose them."""
        return None if self.normal is None or self.point is None else self.encode(self.normal, self.point)

    @staticmethod
    def encode(normal: Sequence[float] | Array, point: Sequence[float] | Array) -> Array:
        """Numbers (12,) that fix a nominal plane through `point` (3, mm)."""
        unit = unit_vector(list(normal), "The normal of a plane")
        base = np.asarray(point, dtype=np.float64)
        if base.shape != (3,) or not np.isfinite(base).all():
            raise ProblemError(f"The point of a plane is {point!r}", "Give three finite numbers in mm")
        return np.concatenate([unit, tangent_basis(unit).T.ravel(), base])

    def at(self, nominal: Expression, local: Expression) -> PlaneValue:
        """Plane at (tilt1, tilt2, offset)."""
        if not self.free:
            return PlaneValue(nominal[:3], nominal[9:12], 0.0)
        return PlaneValue(tilted(nominal, local[:2]), nominal[9:12], local[2])

    def nominal_plane(self, nominal: Array) -> tuple[Array, Array]:
        """Its normal and base point."""
        return nominal[:3], nominal[9:12]

    def growth(self, nominal: Array) -> Array:
        """The offset grows with the distance from the origin; tilts stay."""
        return np.array([0.0, 0.0, nominal[:3] @ nominal[9:12]][: self.size])

    def packed(self, value: PlaneValue) -> Expression:
        """Normal, base and offset of a plane, one below the other (7)."""
        return ca.vertcat(value.normal, value.base, value.offset)

    def unpacked(self, matrix: Expression) -> PlaneValue:
        """The plane of such a column."""
        return PlaneValue(matrix[:3], matrix[3:6], matrix[6])

    def shown(self, nominal: Array, local: Array) -> tuple[str, Any]:
        """Unit normal (3,), and the foot of the samples' centroid on the plane (3, mm)."""
        value = self.at(nominal, local)
        normal = np.asarray(ca.DM(value.normal)).ravel()
        return "planes", {"normal": normal, "point_mm": nominal[9:12] - normal * float(value.distance(nominal[9:12]))}

    def placed(self, near: Array, normal: Array) -> Array:
        """The plane through the point with that normal."""
        return self.encode(normal, near)

    def raw_start(self, nominal: Array) -> Array:
        """Return the normal's three components, and offset 0."""
        return np.append(np.asarray(nominal)[:3], 0.0)

    def raw_value(self, nominal: Expression, raw: Expression) -> PlaneValue:
        """Plane of a raw normal, unit only where the constraint holds."""
        return PlaneValue(raw[:3], nominal[9:12], raw[3])

    def raw_local(self, nominal: Expression, raw: Expression) -> Expression:
        """Tilts and offset of a raw plane with unit normal."""
        return ca.vertcat(tilts_of(nominal, raw[:3]), raw[3])


@dataclass(frozen=True)
class Frame(Whole):
    """A 4x4 rigid transform with six local coordinates: three rotations (rad), three translations (mm).

    The local rotation acts on the right of the nominal one, the translation is added in the outer frame.

    Args:
        matrix: nominal 4x4 transform, mm; None when the data are to propose it.
        prior_std: (rotation in rad, translation in mm) standard deviations; `math.inf` is flat.
        start_std: the same, where filters and populations start when the prior is flat.
        turns_only: True when only the three rotations are unknown.
        free: False holds the frame where it is declared.
        per: name of a label column; one frame for each of its values.
        held_as_proposed: True holds it where the data propose it, as `Problem.fix` does.

    """

    matrix: Sequence[Sequence[float]] | None = None
    prior_std: float | tuple[float, float] = math.inf
    start_std: tuple[float, float] = (0.01, 10.0)
    turns_only: bool = False
    free: bool = True
    per: str | None = None
    held_as_proposed: bool = False

    nominal_size = 12
    unit_length = 4
    parts = (("rx", "rad"), ("ry", "rad"), ("rz", "rad"), ("x", "mm"), ("y", "mm"), ("z", "mm"))
    unsaid = ("no matrix", "Say where it is")

    @staticmethod
    def of(
        translation: Sequence[float],
        rotation: Sequence[float] | Sequence[Sequence[float]] | None = None,
        *,
        prior_std: float | tuple[float, float] = math.inf,
        free: bool = True,
    ) -> Frame:
        """A frame from its translation (3, mm) and rotation: a matrix (3, 3) or a rotation vector (3, rad).

        Raises ProblemError for what is neither.
        """
        turn, matrix = np.asarray(np.zeros(3) if rotation is None else rotation, dtype=np.float64), np.eye(4)
        if np.shape(translation) != (3,) or turn.shape not in ((3,), (3, 3)):
            what = f"A translation of shape {np.shape(translation)} and a rotation of shape {turn.shape} came"
            raise ProblemError(what, "Give three numbers of mm, and a 3x3 matrix or three numbers of rad")
        if turn.shape == (3,):
            half = float(np.linalg.norm(turn)) / 2
            quaternion = np.append(math.cos(half), np.sinc(half / math.pi) * turn / 2)
            turn = np.asarray(ca.DM(rotation_of_quaternion(ca.DM(quaternion))))
        matrix[:3, :3], matrix[:3, 3] = turn, translation
        return Frame(tuple(map(tuple, matrix.tolist())), prior_std=prior_std, free=free)

    @property
    def size(self) -> int:
        """Number of local coordinates: six, three when only its rotation is free, or none when held."""
        return (3 if self.turns_only else 6) if self.free else 0

    @property
    def nominal(self) -> Array | None:
        """Rotation (9, column by column) and translation (3, mm); None when the data must propose them."""
        return None if self.matrix is None else self.encode(np.asarray(self.matrix, dtype=np.float64))

    @staticmethod
    def encode(matrix: Array) -> Array:
        """Numbers (12,) that fix a nominal frame; raises ProblemError when the matrix is not a rigid transform."""
        good = matrix.shape == (4, 4) and np.isfinite(matrix).all()
        if not good or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6):
            raise ProblemError("A frame is not a rigid 4x4 transform", "Give a rotation matrix and a translation in mm")
        if np.linalg.det(matrix[:3, :3]) < 0:
            raise ProblemError("A frame mirrors (its determinant is -1)", "Give a right-handed rotation matrix")
        return np.concatenate([matrix[:3, :3].T.ravel(), matrix[:3, 3]])

    def at(self, nominal: Expression, local: Expression) -> Expression:
        """4x4 transform at six local coordinates."""
        local = local if self.free else ca.DM.zeros(6)
        # a rotation by angle phi is the unit quaternion at phi / 2 from the pole
        w, xyz = stereographic(local[:3] / 2)
        return self._moved(nominal, ca.vertcat(w, xyz), local[3:])

    def shown(self, nominal: Array, local: Array) -> tuple[str, Any]:
        """4x4, mm."""
        return "frames", np.asarray(ca.DM(self.at(nominal, local)))

    def placed(self, near: Array, normal: Array) -> Array:
        """The base frame, its zero moved to the place; itself where nothing is said of places."""
        del normal
        matrix = np.eye(4)
        matrix[:3, 3] = 0.0 if self.turns_only else -np.asarray(near)  # from the base to what stands there
        return self.encode(matrix)

    def raw_start(self, nominal: Array) -> Array:
        """Return the unit quaternion of no rotation, and no translation."""
        del nominal
        return np.asarray(np.eye(self.raw_size)[0])

    def raw_value(self, nominal: Expression, raw: Expression) -> Expression:
        """4x4 transform of a raw quaternion, rigid only where the constraint holds."""
        return self._moved(nominal, raw[:4], raw[4:])

    def raw_local(self, nominal: Expression, raw: Expression) -> Expression:
        """Six local coordinates of a raw frame with unit quaternion."""
        del nominal
        return ca.vertcat(2 * stereographic_local(raw[0], raw[1:4]), raw[4:])

    def _moved(self, nominal: Expression, quaternion: Expression, shift: Expression) -> Expression:
        turn = ca.mtimes(ca.reshape(nominal[:9], 3, 3), rotation_of_quaternion(quaternion))
        return rigid(turn, nominal[9:12] + (ca.DM.zeros(3) if self.turns_only else shift))


ON_A_LINE = 1e-9  # fraction of the largest extent below which points count as lying on a line


@dataclass(frozen=True)
class FittedPlane:
    """The plane of total least squares through points.

    centre: (3,), mm. normal: unit (3,), of either sign. across: unit vectors (2, 3) on the plane, along the largest
    extent of the points first. flat: whether the points fix a plane at all, rather than lie on a line.
    """

    centre: Array
    normal: Array
    across: Array
    flat: bool


def fitted_plane(points: Array) -> FittedPlane:
    """Plane with the smallest sum of squared distances from points (N, 3): eq (6) with a unit normal."""
    centre = points.mean(axis=0)
    # all three directions, also of fewer points than that
    _, extents, axes = np.linalg.svd(points - centre, full_matrices=len(points) < 3)
    flat = bool(len(points) >= 3 and extents[1] > ON_A_LINE * max(float(extents[0]), 1.0))
    return FittedPlane(centre, axes[2], axes[:2], flat)


def rigid_fit(there: Array, here: Array) -> Array | None:
    """Transform (4, 4) that carries points `there` (N, 3; mm) to `here` as well as one can, if they fix one."""
    turn, fixed = rotation_between(there - there.mean(axis=0), here - here.mean(axis=0))
    if len(here) < 3 or not fixed:
        return None
    return transform(turn, here.mean(axis=0) - turn @ there.mean(axis=0))


def rotation_between(there: Array, here: Array) -> tuple[Array, bool]:
    """Rotation (3, 3) that carries vectors `there` (N, 3) to `here` as well as one can, and whether they fix it.

    Arun, Huang and Blostein, Least-squares fitting of two 3-D point sets, 1987.
    """
    left, sizes, right = np.linalg.svd(there.T @ here)
    mirror = np.diag([1.0, 1.0, np.linalg.det(right.T @ left.T)])
    fixed = bool(len(there) >= 2 and sizes[1] > ON_A_LINE * max(float(sizes[0]), 1.0))
    return np.asarray(right.T @ mirror @ left.T), fixed


APART = 1e-3  # part of the largest singular value by which it stands apart where both frames are fixed: turns by 2 deg


def hand_eye(turns: Array, places: Array, quaternions: Array, read: Array) -> tuple[Array, Array] | None:
    """Body and station (4, 4; mm) that fit best, or None where the rows do not fix them.

    turns, places: rotations (N, 3, 3) and origins (N, 3; mm) of the flange in the base frame. quaternions, read: of the
    body in the device's frame: w, x, y, z (N, 4), and origins (N, 3; mm).
    """
    apart = np.linalg.svd(np.einsum("kia,kjb->ijab", turns, turns).reshape(9, 9), compute_uv=False)
    if len(turns) < 3 or apart[0] - apart[1] < APART * apart[0]:  # for turns about one axis the largest two are alike
        return None
    observed = turns_of(quaternions)
    # S' M = T B for every row: vec(T B) = (1 x T) vec(B), vec(S' M) = (M' x 1) vec(S')
    cross = np.einsum("kia,kjb->ijab", observed, turns).reshape(9, 9)
    left, _, right = np.linalg.svd(cross)
    station, body = left[:, 0].reshape(3, 3), right[0].reshape(3, 3)  # up to scale and a common sign
    sign = np.sign(np.linalg.det(station)) or 1.0
    station, body = _nearest(sign * station), _nearest(sign * body).T
    # p = S_R (T_R b + t) + s, linear in b and s
    rows = np.concatenate([np.einsum("ij,kjl->kil", station, turns), np.tile(np.eye(3), (len(turns), 1, 1))], axis=2)
    wanted = read - places @ station.T
    shifts, *_ = np.linalg.lstsq(rows.reshape(-1, 6), wanted.ravel(), rcond=None)
    return transform(body, shifts[:3]), transform(station, shifts[3:])


def _nearest(matrix: Array) -> Array:
    """The rotation nearest to a matrix."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def transform(turn: Array, shift: Array) -> Array:
    """The transform (4, 4; mm) of a rotation (3, 3) and a translation (3; mm)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, shift
    return matrix


def packed_symbols(unknowns: Mapping[str, Unknown]) -> tuple[list[ca.SX], dict[str, Any]]:
    """A matrix of symbols for the value of each unknown, and these values, by key."""
    symbols, values = [], {}
    for key, unknown in unknowns.items():
        nominal = ca.SX.zeros(unknown.nominal_size) if unknown.nominal is None else ca.SX(ca.DM(unknown.nominal))
        rows, columns = ca.SX(unknown.packed(unknown.at(nominal, ca.SX.zeros(unknown.size)))).shape
        symbols.append(ca.SX.sym(key, rows, columns))
        values[key] = unknown.unpacked(symbols[-1])
    return symbols, values

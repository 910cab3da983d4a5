"""The pose of a body on the flange, read by a device that sees six coordinates, however it writes an orientation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from casacal.data.columns import Dimension
from casacal.errors import ProblemError, came
from casacal.model.geometry import Frame, hand_eye, transform
from casacal.model.instrument import COORDINATE, Instrument, ResidualBlock, Sight, Suspect, Trusted, Words
from casacal.model.kinematics import ROTATE, Expression, chain, position, rotation, rotation_of_quaternion
from casacal.values import Array, is_real

POSITION = ("x", "y", "z")
QUATERNION = ("quat_w", "quat_x", "quat_y", "quat_z")
VECTOR = ("turn_x", "turn_y", "turn_z")
TURNS = ("turn_1", "turn_2", "turn_3")

POSE_SCALE = 0.01  # percent: cameras and boards; a tracker is better
NO_TURN = 1e-6  # size of a quaternion's numbers below which it says nothing
SMALL = 1e-24  # keeps a rotation vector of zero from being divided by its length

HALF_TURN = 1e-16  # keeps the residual of the orientation smooth where it is half a turn off; nothing near zero


@dataclass(frozen=True, kw_only=True)
class TrackedPose(Instrument):
    """A body on the flange whose position (x, y, z) and orientation, however it is written, are read.

    The orientation turns the body's axes into the device's. Six residuals per row: three of the position, mm, and three
    of the orientation, rad: twice the vector of the quaternion between reading and model, whose length is the chord of
    the angle between them, 2 sin(angle / 2). That is zero where they agree and nowhere else, unlike the antisymmetric
    part of their rotation, which vanishes at half a turn, too.

    With a camera on the flange that looks at a board this is hand-eye calibration: body is the camera, the device the
    board, and the readings are the camera's poses in the board's frame.

    Args:
        position_std: standard deviation of each coordinate, mm; or the name of the column that says it.
        angle_std: standard deviation of the orientation about each axis, rad; or the name of such a column.
        orientation: "quaternion" (columns quat_w, quat_x, quat_y, quat_z), "rotation vector" (turn_x, turn_y, turn_z),
            or three letters, the axes of turn_1, turn_2 and turn_3: capitals where each turns about the axis as the
            turns before have left it (KUKA's A, B, C is "ZYX"), small ones where the axes stay (FANUC's W, P, R is
            "xyz").
        body: transform from the flange to the body; proposed from the data when not given.
        station: transform from the robot's base to the device; proposed from the data when not given.

    Raises ProblemError for a noise that is not positive, and an orientation of no such name.

    """

    position_std: float | str
    angle_std: float | str
    orientation: str = "quaternion"
    body: Frame = Frame()
    station: Frame = Frame()

    words = Words(COORDINATE, "mm", "poses", "body and station fitted alone", "the scale of the poses", accuracy=True)
    trusted = Trusted.scale("the scale of the poses", POSE_SCALE, *POSITION, cure="a known length")

    def __post_init__(self) -> None:
        for name in ("position_std", "angle_std"):
            std = getattr(self, name)
            if not isinstance(std, str) and (not is_real(std) or not 0 < std < math.inf):
                raise ProblemError(f"{name} of TrackedPose is {std!r}", "Give a positive number, or name a column")
        if self.orientation not in ("quaternion", "rotation vector"):
            order = self.orientation if isinstance(self.orientation, str) else ""
            axes = order.lower()
            turns = len(order) == 3 and not set(axes) - set("xyz") and order in (axes, axes.upper())
            if not turns or any(one == two for one, two in pairwise(axes)):
                what = f"Got {came(self.orientation)} as an orientation"
                what = f"An orientation is written as '{order}'" if order else what
                fix = "Give 'quaternion', 'rotation vector', or three axes such as 'ZYX' (A, B, C of KUKA) or 'xyz'"
                raise ProblemError(what, fix)
        named = [std for std in (self.position_std, self.angle_std) if isinstance(std, str)]
        for name in named:
            if not name.isidentifier() or name in {*POSITION, *self.turn_columns} or named.count(name) > 1:
                fix = "Name a column of its own for each, such as 'position_std' and 'angle_std'"
                raise ProblemError(f"The noise of TrackedPose is declared to be in the column '{name}'", fix)

    @property
    def turn_columns(self) -> Mapping[str, Dimension]:
        """Columns that hold the orientation, and what is in them."""
        if self.orientation == "quaternion":
            return dict.fromkeys(QUATERNION, "number")
        return dict.fromkeys(VECTOR if self.orientation == "rotation vector" else TURNS, "angle")

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """Position and orientation, and the columns that say how good they are."""
        found: dict[str, Dimension] = dict.fromkeys(POSITION, "length")
        found |= self.turn_columns
        for std, dimension in ((self.position_std, "length"), (self.angle_std, "angle")):
            if isinstance(std, str):
                found[std] = dimension  # type: ignore[assignment]
        return found

    @property
    def blocks(self) -> tuple[ResidualBlock, ...]:
        """Position and orientation."""
        place = ResidualBlock("position", 3, "mm", self.position_std)
        return (place, ResidualBlock("orientation", 3, "rad", self.angle_std))

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Units, a mirrored frame, and orientations in another order, or that turn the other way."""
        mirror = "the positions seem to come in a left-handed frame: one axis counted the other way"
        right = "Export them in a right-handed frame, or correct the column that is wrong"
        other = "the poses seem to be those of the device in the body's frame, as of a board in the camera's"
        invert = "Invert each pose: its rotation R becomes R', its position t becomes -R' t"
        return (
            *Suspect.units(dict.fromkeys(POSITION, "length")),
            *self._turns_mistaken(),
            Suspect("left-handed frame", mirror, right, ("z",), -1.0),
            Suspect("poses inverted", other, invert, (*POSITION, *self.turn_columns), 1.0, change=self.inverted),
        )

    def _turns_mistaken(self) -> tuple[Suspect, ...]:
        turn = "seem to turn from the device to the body, not from the body to the device"
        if self.orientation == "quaternion":
            order = "the quaternions seem to come as x, y, z, w, and the columns call them w, x, y, z"
            shifted = (*QUATERNION[3:], *QUATERNION[:3])  # where each of w, x, y, z then stands
            return (
                Suspect("order of the quaternions", order, "Rename the columns", QUATERNION, 1.0, shifted),
                Suspect("sense of the quaternions", f"the quaternions {turn}",
                        "Invert them: negate quat_x, quat_y and quat_z", QUATERNION[1:], -1.0),
            )  # fmt: skip
        unit = Suspect("unit of the turns", "the turns seem to be radians, written as degrees",
                       "End the columns' names in _rad", tuple(self.turn_columns), 180 / math.pi)  # fmt: skip
        if self.orientation == "rotation vector":
            fix = "Invert them: negate all three"
            return (unit, Suspect("sense of the rotation vectors", f"the rotation vectors {turn}", fix, VECTOR, -1.0))
        other = f"the turns seem to come in the other order, the one about {self.orientation[2]} first"
        fix = f'Rename the columns, or declare orientation="{self.orientation[::-1].swapcase()}"'
        return (unit, Suspect("order of the turns", other, fix, TURNS, 1.0, TURNS[::-1]))

    @property
    def begins_at(self) -> Mapping[str, float]:
        """No turn, which zeros may not be."""
        return {"quat_w": 1.0} if self.orientation == "quaternion" else {}

    def as_read(self, columns: Mapping[str, Array]) -> Mapping[str, Array]:
        """Quaternions of length one, turns of less than one."""
        return {**columns, **self._written(self._turns(columns))}

    def inverted(self, columns: Mapping[str, Array]) -> Mapping[str, Array]:
        """The device's poses in the body's frame, for those of the body in the device's."""
        turns = self._turns(columns).inv()
        places = -turns.apply(np.column_stack([columns[name] for name in POSITION]))
        return {**columns, **dict(zip(POSITION, places.T, strict=True)), **self._written(turns)}

    def _turns(self, columns: Mapping[str, Array]) -> Any:
        """SciPy's rotations of rows."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(np.roll(self.quaternions(columns), -1, axis=1))

    def _written(self, turns: Any) -> Mapping[str, Array]:
        """SciPy's rotations by the columns of an orientation."""
        if self.orientation == "quaternion":
            found = np.roll(turns.as_quat(canonical=True), 1, axis=1)
        else:
            found = turns.as_rotvec() if self.orientation == "rotation vector" else turns.as_euler(self.orientation)
        return dict(zip(self.turn_columns, found.T, strict=True))

    def turn(self, row: Any) -> Expression:
        """Rotation matrix (3x3) of a row."""
        entries = [getattr(row, name) for name in self.turn_columns]
        if self.orientation == "quaternion":
            quaternion = ca.vertcat(*entries)
            return rotation_of_quaternion(quaternion / ca.norm_2(quaternion))
        if self.orientation == "rotation vector":
            vector = ca.vertcat(*entries)
            angle = ca.sqrt(ca.sumsqr(vector) + SMALL)
            return rotation_of_quaternion(ca.vertcat(ca.cos(angle / 2), ca.sin(angle / 2) * vector / angle))
        turns = [ROTATE[axis](angle) for axis, angle in zip(self.orientation.lower(), entries, strict=True)]
        return rotation(chain(*(turns if self.orientation.isupper() else reversed(turns))))

    def quaternions(self, columns: Mapping[str, Array]) -> Array:
        """Quaternions (N, 4; w, x, y, z) of all rows; raises ProblemError where a device has lost the body."""
        from scipy.spatial.transform import Rotation

        read = np.column_stack([columns[name] for name in self.turn_columns])
        if self.orientation == "quaternion":
            if lost := int((np.abs(read).max(axis=1) < NO_TURN).sum()):
                what = f"{'1 row holds' if lost == 1 else f'{lost} rows hold'} a quaternion of zeros, as devices write"
                raise ProblemError(f"{what} that have lost the body", "Remove those rows")
            return read
        vector = self.orientation == "rotation vector"
        found = Rotation.from_rotvec(read) if vector else Rotation.from_euler(self.orientation, read)
        return np.asarray(np.roll(found.as_quat(), 1, axis=1))

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Position of the body (3, mm)."""
        del row
        return position(chain(pose, p.body))

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Position predicted minus read (3, mm), and orientation (3, rad)."""
        predicted = chain(p.station, pose, p.body)
        place = position(predicted) - ca.vertcat(row.x, row.y, row.z)
        return ca.vertcat(place, chord(ca.mtimes(self.turn(row).T, rotation(predicted))))

    def propose(self, key: str, sight: Sight) -> Array:
        """Body and station of T X = Z B (Shah 2013), whichever is asked for."""
        turns = sight.poses[:, :3, :3]
        read = self.quaternions(sight.columns)
        places = np.column_stack([sight.columns[name] for name in POSITION])
        found = hand_eye(turns, sight.poses[:, :3, 3], read, places)
        if found is None:
            fix = "Take three poses or more that turn it about two axes, by some degrees at least"
            raise ProblemError("The postures of TrackedPose turn the flange about one axis only, or hardly", fix)
        return Frame.encode(found[0 if key == "body" else 1])

    def stands(self, key: str, near: Array, normal: Array) -> Array:
        """A simulated body sits 100 mm before the flange."""
        if key != "body":
            return super().stands(key, near, normal)
        return Frame.encode(transform(np.eye(3), np.array([20.0, -30.0, 100.0])))


def chord(turn: Expression) -> Expression:
    """Twice the vector (3) of the unit quaternion of a rotation (3x3) with positive scalar: axis * 2 sin(angle / 2).

    Its square is half of ||turn - 1||^2 (Frobenius), the chordal distance.
    """
    vee = ca.vertcat(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / 2  # axis sin(angle)
    cosine = ca.sqrt(ca.fmax(1 + turn[0, 0] + turn[1, 1] + turn[2, 2], 0) / 4 + HALF_TURN)  # of half the angle
    return vee / cosine

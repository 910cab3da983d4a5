"""The pose of a body on the flange, read by a tracker, a camera or another device that sees six coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.description import Dimension, ResidualBlock, Sight, Suspect, Words
from casacal.instruments.instrument import Instrument
from casacal.instruments.orientations import Orientation
from casacal.instruments.usual_mistakes import units_mistaken
from casacal.kinematics import Expression, chain, position, rotation
from casacal.unknowns import Frame
from casacal.unknowns.fits import hand_eye, transform
from casacal.values import is_real

POSITION = ("x", "y", "z")

HALF_TURN = 1e-16  # keeps the residual of the orientation smooth where it is half a turn off; nothing near zero


@dataclass(frozen=True, kw_only=True)
class TrackedPose(Instrument):
    """A body on the flange whose position (x, y, z) and orientation are read; `Orientation` says how it is written.

    It turns the body's axes into the device's. Six residuals per row: three of the position, mm, and three
    of the orientation, rad: twice the vector of the quaternion between reading and model, whose length is the chord of
    the angle between them, 2 sin(angle / 2). That is zero where they agree and nowhere else, unlike the antisymmetric
    part of their rotation, which vanishes at half a turn, too.

    With a camera on the flange that looks at a board this is hand-eye calibration: body is the camera, the device the
    board, and the readings are the camera's poses in the board's frame.

    Args:
        position_std: standard deviation of each coordinate, mm; or the name of the column that says it.
        angle_std: standard deviation of the orientation about each axis, rad; or the name of such a column.
        orientation: "quaternion" (columns quat_w, quat_x, quat_y, quat_z), "rotation vector" (turn_x, turn_y, turn_z),
            or the axes of turn_1, turn_2, turn_3, such as "ZYX" for KUKA's A, B, C.
        body: transform from the flange to the body; proposed from the data when not given.
        station: transform from the robot's base to the device; proposed from the data when not given.

    Raises ProblemError for a noise that is not positive, and an orientation of no such name.

    """

    position_std: float | str
    angle_std: float | str
    orientation: str = "quaternion"
    body: Frame = Frame()
    station: Frame = Frame()

    words = Words(
        "residual of each coordinate",
        "mm",
        "poses",
        "body and station fitted alone",
        "the scale of the poses",
        accuracy=True,
    )

    def __post_init__(self) -> None:
        for name in ("position_std", "angle_std"):
            std = getattr(self, name)
            if not isinstance(std, str) and (not is_real(std) or not 0 < std < math.inf):
                raise ProblemError(f"{name} of TrackedPose is {std!r}", "Give a positive number, or name a column")
        named = [std for std in (self.position_std, self.angle_std) if isinstance(std, str)]
        taken = {*POSITION, *self.written.columns}
        for name in named:
            if not name.isidentifier() or name in taken or named.count(name) > 1:
                raise ProblemError(
                    f"The noise of TrackedPose is declared to be in the column '{name}'",
                    "Name a column of its own for each, such as 'position_std' and 'angle_std'",
                )

    @property
    def written(self) -> Orientation:
        """How the orientation is written."""
        return Orientation(self.orientation)

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """Position and orientation, and the columns that say how good they are."""
        found: dict[str, Dimension] = dict.fromkeys(POSITION, "length")
        found |= dict.fromkeys(self.written.columns, self.written.dimension)
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
        lengths = units_mistaken(dict.fromkeys(POSITION, "length"))
        mirror = "the positions seem to come in a left-handed frame: one axis counted the other way"
        right = "Export them in a right-handed frame, or correct the column that is wrong"
        return (*lengths, *self.written.suspects, Suspect("left-handed frame", mirror, right, ("z",), -1.0))

    @property
    def begins_at(self) -> Mapping[str, float]:
        """No turn, which zeros may not be."""
        return self.written.begins_at

    def as_read(self, columns: Mapping[str, Array]) -> Mapping[str, Array]:
        """Quaternions of length one, turns of less than one."""
        return {**columns, **self.written.told(self.written.quaternions(columns))}

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Where the body is (3, mm)."""
        del row
        return position(chain(pose, p.body))

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Position predicted minus read (3, mm), and orientation (3, rad)."""
        seen = chain(p.station, pose, p.body)
        place = position(seen) - ca.vertcat(row.x, row.y, row.z)
        return ca.vertcat(place, chord(ca.mtimes(self.written.turn(row).T, rotation(seen))))

    def propose(self, key: str, sight: Sight) -> Array:
        """Body and station of T X = Z B (Shah 2013), whichever is asked for."""
        turns = sight.poses[:, :3, :3]
        read = self.written.quaternions(sight.columns)
        places = np.column_stack([sight.columns[name] for name in POSITION])
        found = hand_eye(turns, sight.poses[:, :3, 3], read, places)
        if found is None:
            raise ProblemError(
                "The postures of TrackedPose turn the flange about one axis only, or hardly",
                "Take three poses or more that turn it about two axes, by some degrees at least",
            )
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

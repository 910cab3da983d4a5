"""How devices write an orientation: quaternions, rotation vectors, three turns about axes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError, came
from casacal.instruments.description import Dimension, Suspect
from casacal.kinematics import Expression, chain, rotate_x, rotate_y, rotate_z, rotation, rotation_of_quaternion

QUATERNION = ("quat_w", "quat_x", "quat_y", "quat_z")
VECTOR = ("turn_x", "turn_y", "turn_z")
TURNS = ("turn_1", "turn_2", "turn_3")

NO_TURN = 1e-6  # size of a quaternion's numbers below which it says nothing
SMALL = 1e-24  # keeps a rotation vector of zero from being divided by its length

ABOUT = {"x": rotate_x, "y": rotate_y, "z": rotate_z}


@dataclass(frozen=True)
class Orientation:
    """One way to write an orientation, which turns the body's axes into the device's.

    name: "quaternion" (columns quat_w, quat_x, quat_y, quat_z), "rotation vector" (turn_x, turn_y, turn_z), or three
    letters, the axes of turn_1, turn_2 and turn_3: capitals where each turns about the axis as the turns before have
    left it (KUKA's A, B, C is "ZYX"), small ones where the axes stay (FANUC's W, P, R is "xyz").

    Raises ProblemError for any other name.
    """

    name: str

    def __post_init__(self) -> None:
        if self.name in ("quaternion", "rotation vector"):
            return
        told = self.name if isinstance(self.name, str) else ""
        axes = told.lower()
        turns = len(told) == 3 and not set(axes) - set("xyz") and told in (axes, axes.upper())
        if not turns or any(one == two for one, two in pairwise(axes)):
            raise ProblemError(
                f"Got {came(self.name)} as an orientation" if not told else f"An orientation is written as '{told}'",
                "Give 'quaternion', 'rotation vector', or three axes such as 'ZYX' (A, B, C of KUKA) or 'xyz'",
            )

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that hold it."""
        return {"quaternion": QUATERNION, "rotation vector": VECTOR}.get(self.name, TURNS)

    @property
    def dimension(self) -> Dimension:
        """What these columns hold."""
        return "number" if self.name == "quaternion" else "angle"

    @property
    def begins_at(self) -> Mapping[str, float]:
        """No turn; for quaternions that is not zeros."""
        return {"quat_w": 1.0} if self.name == "quaternion" else {}

    def turn(self, row: Any) -> Expression:
        """Rotation matrix (3x3) of a row."""
        told = [getattr(row, name) for name in self.columns]
        if self.name == "quaternion":
            quaternion = ca.vertcat(*told)
            return rotation_of_quaternion(quaternion / ca.norm_2(quaternion))
        if self.name == "rotation vector":
            vector = ca.vertcat(*told)
            angle = ca.sqrt(ca.sumsqr(vector) + SMALL)
            return rotation_of_quaternion(ca.vertcat(ca.cos(angle / 2), ca.sin(angle / 2) * vector / angle))
        turns = [ABOUT[axis](angle) for axis, angle in zip(self.name.lower(), told, strict=True)]
        return rotation(chain(*(turns if self.name.isupper() else reversed(turns))))

    def quaternions(self, columns: Mapping[str, Array]) -> Array:
        """Of all rows (N, 4): w, x, y, z; raises ProblemError where a device has lost the body."""
        from scipy.spatial.transform import Rotation

        told = np.column_stack([columns[name] for name in self.columns])
        if self.name == "quaternion":
            if (lost := int((np.abs(told).max(axis=1) < NO_TURN).sum())) > 0:
                rows = "1 row holds" if lost == 1 else f"{lost} rows hold"
                raise ProblemError(
                    f"{rows} a quaternion of zeros, as devices write that have lost the body", "Remove those rows"
                )
            return told
        vector = self.name == "rotation vector"
        found = Rotation.from_rotvec(told) if vector else Rotation.from_euler(self.name, told)
        return np.asarray(np.roll(found.as_quat(), 1, axis=1))

    def told(self, quaternions: Array) -> Mapping[str, Array]:
        """The columns (N,) of quaternions (N, 4): w, x, y, z, of any length; turns are less than one."""
        from scipy.spatial.transform import Rotation

        turns = Rotation.from_quat(np.roll(quaternions, -1, axis=1))
        if self.name == "quaternion":
            found = np.roll(turns.as_quat(canonical=True), 1, axis=1)
        else:
            found = turns.as_rotvec() if self.name == "rotation vector" else turns.as_euler(self.name)
        return dict(zip(self.columns, found.T, strict=True))

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Numbers in another order, or turns the other way, where these can be told."""
        turn = "seem to turn from the device to the body, not from the body to the device"
        if self.name == "quaternion":
            order = "the quaternions seem to come as x, y, z, w, and the columns call them w, x, y, z"
            shifted = (*QUATERNION[3:], *QUATERNION[:3])  # where each of w, x, y, z then stands
            return (
                Suspect("order of the quaternions", order, "Rename the columns", QUATERNION, 1.0, shifted),
                Suspect("sense of the quaternions", f"the quaternions {turn}",
                        "Invert them: negate quat_x, quat_y and quat_z", QUATERNION[1:], -1.0),
            )  # fmt: skip
        unit = Suspect("unit of the turns", "the turns seem to be radians, written as degrees",
                       "End the columns' names in _rad", self.columns, 180 / math.pi)  # fmt: skip
        if self.name == "rotation vector":
            fix = "Invert them: negate all three"
            return (unit, Suspect("sense of the rotation vectors", f"the rotation vectors {turn}", fix, VECTOR, -1.0))
        other = f"the turns seem to come in the other order, the one about {self.name[2]} first"
        fix = f'Rename the columns, or declare orientation="{self.name[::-1].swapcase()}"'
        return (unit, Suspect("order of the turns", other, fix, TURNS, 1.0, TURNS[::-1]))

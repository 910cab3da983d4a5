"""Rows copied from a controller's pendant: joint values and the Cartesian pose it shows for them, as shown."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np

from casacal.data.text import Table, read_table
from casacal.errors import SamplesError
from casacal.values import Array

ANGLES = {"deg": np.pi / 180, "rad": 1.0}
LENGTHS = {"mm": 1.0, "m": 1000.0}  # units that are tried, with their factor to rad and mm

QUATERNION = ("qw", "qx", "qy", "qz")
TRIPLES = (("rx", "ry", "rz"), ("a", "b", "c"), ("w", "p", "r"), ("o", "a", "t"))
"""Names that three columns of an orientation may have, in the order of the pendant; what they mean is found."""
ENTRY = re.compile(r"(.*?)[_\[(]*(\d+)[\])]*")  # a column's name that ends in a number, such as T_0 or O_T_EE[0]
LARGEST = 1e9  # what no joint value, length or angle of a robot exceeds in any unit


@dataclass(frozen=True)
class PendantRows:
    """Numbers as shown: joints (N, n), positions (N, 3), orientations (N, 4; w, x, y, z) or (N, 3).

    joint_unit, length_unit, angle_unit: what the column names state, "" where they state nothing. columns: those names,
    of joints, positions and orientations; without them the usual ones.

    Raises SamplesError for a number that is not finite or beyond all robots.
    """

    joints: Array
    positions: Array
    orientations: Array
    joint_unit: str = ""
    length_unit: str = ""
    angle_unit: str = ""
    lines: tuple[int, ...] = ()
    file: str = "rows"
    columns: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for i, k in np.argwhere(~(np.abs(self.numbers) <= LARGEST))[:1]:
            what = f"{self.numbers[i, k]:g} is beyond any robot"
            raise SamplesError(self.file, what, "Copy the number again", line=self.line(i), column=self.names[k])

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def numbers(self) -> Array:
        """All numbers of the rows (N, columns), in the order of `names`."""
        return np.hstack([self.joints, self.positions, self.orientations])

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each number of a row."""
        turn = QUATERNION if self.orientations.shape[1] == 4 else TRIPLES[0]
        return self.columns or (*(f"q{i}" for i in range(1, self.joints.shape[1] + 1)), "x", "y", "z", *turn)

    def line(self, row: int) -> int:
        """Line of the file that holds a row; without a file, the row counted from 1."""
        return self.lines[row] if self.lines else row + 1

    def without(self, row: int) -> PendantRows:
        """All rows but one."""
        keep = [i for i in range(len(self)) if i != row]
        return replace(
            self,
            joints=self.joints[keep],
            positions=self.positions[keep],
            orientations=self.orientations[keep],
            lines=tuple(self.lines[i] for i in keep) if self.lines else (),
        )


def read_pendant_rows(source: str | Path | Table, turns: Sequence[bool]) -> PendantRows:
    """Read pendant rows of a robot whose joints turn or slide, from a file or its cells.

    Columns: q1, q2, ... with _deg or _rad (sliding: _mm, _m) or bare; x, y, z with _mm or _m or bare; an orientation as
    qw, qx, qy, qz, or as three columns rx, ry, rz or a, b, c or w, p, r or o, a, t with _deg or _rad or bare. In place
    of position and orientation the 16 numbers of a 4x4 matrix, row by row or column by column: O_T_EE_0 ... O_T_EE_15.

    Raises SamplesError.
    """
    table = _with_poses(source if isinstance(source, Table) else read_table(source))
    joints = [_column(table, f"q{i}", ANGLES if turning else LENGTHS) for i, turning in enumerate(turns, 1)]
    for name in table.header:
        stem = name.split("_")[0]
        if stem[:1] == "q" and stem[1:].isdigit() and not 1 <= int(stem[1:]) <= len(turns):
            fix = "Use the rows of this robot"
            raise SamplesError(table.file, f"the robot has {len(turns)} joints", fix, column=name)
    place = [_column(table, name, LENGTHS) for name in ("x", "y", "z")]
    stems = {name.split("_")[0] for name in table.header}
    if set(QUATERNION) <= set(table.header):
        turn = [(name, "") for name in QUATERNION]
    elif triple := next((names for names in TRIPLES if stems.issuperset(names)), None):
        turn = [_column(table, name, ANGLES) for name in triple]
    else:
        what = f"there is no orientation: the columns are {', '.join(table.header[:20])}"
        fix = "Add qw,qx,qy,qz or three of rx,ry,rz or a,b,c or w,p,r or o,a,t, with _deg or _rad"
        raise SamplesError(table.file, what, fix, line=table.header_line)
    orientations = _numbers(table, turn)
    lengths = np.linalg.norm(orientations, axis=1)
    for i in np.flatnonzero((len(turn) == 4) & (np.abs(lengths - 1) > 1e-2))[:1]:
        what = f"the quaternion has the length {lengths[i]:.4g}"
        raise SamplesError(table.file, what, "Give a unit quaternion qw,qx,qy,qz", line=table.lines[i])
    return PendantRows(
        _numbers(table, joints),
        _numbers(table, place),
        orientations,
        _one_unit(table, list(compress(joints, turns))),
        _one_unit(table, [*place, *compress(joints, (not turning for turning in turns))]),
        _one_unit(table, turn),
        table.lines,
        table.file,
        tuple(name for name, _ in (*joints, *place, *turn)),
    )


def _with_poses(table: Table) -> Table:
    """A table with position and quaternion beside the 16 numbers of a matrix, where it has these.

    They are numbered 0 to 15, 1 to 16 or 11 to 44. Where the zeros stand says whether they come row by row.
    """
    from scipy.spatial.transform import Rotation

    found = [(match[1], int(match[2]), name) for name in table.header if (match := ENTRY.fullmatch(name))]
    by_number = {(family, number): name for family, number, name in found}
    counts = (range(16), range(1, 17), [10 * i + j for i in range(1, 5) for j in range(1, 5)])
    for family, count in itertools.product(dict.fromkeys(each[0] for each in found), counts):
        names = [by_number.get((family, number), "") for number in count]
        if not all(names):
            continue
        poses, last = _numbers(table, [(name, "") for name in names]).reshape(-1, 4, 4), np.array([0, 0, 0, 1])
        if np.median(np.abs(poses[:, :, 3] - last)) < np.median(np.abs(poses[:, 3] - last)):
            poses = poses.transpose(0, 2, 1)  # column by column, as libfranka does
        turn = poses[:, :3, :3]
        skew = (turn @ turn.transpose(0, 2, 1) - np.eye(3)).reshape(-1, 9)
        off = np.abs(np.hstack([skew, poses[:, 3] - last])).max(axis=1)
        for i in np.flatnonzero((off > 1e-2) | (np.linalg.det(turn) < 0))[:1]:
            what = f"{names[0]} to {names[-1]} are no pose: three axes at right angles, a position, and 0, 0, 0, 1"
            raise SamplesError(table.file, what, "Give the 16 numbers as they were read", line=table.lines[i])
        added = np.hstack([poses[:, :3, 3], np.roll(Rotation.from_matrix(turn).as_quat(), 1, axis=1)]).tolist()
        rows = tuple((*row, *map(repr, more)) for row, more in zip(table.with_points().rows, added, strict=True))
        return replace(table, header=(*table.header, "x", "y", "z", *QUATERNION), rows=rows, decimal_comma=False)
    return table


def _column(table: Table, name: str, units: dict[str, float]) -> tuple[str, str]:
    """A quantity's column and the unit that its name states; raises SamplesError when there is not exactly one."""
    spellings = {name: "", **{f"{name}_{unit}": unit for unit in units}}
    present = [column for column in table.header if column in spellings]
    if len(present) != 1:
        what = f"'{present[0]}' and '{present[1]}' both give {name}" if present else f"there is no column for {name}"
        raise SamplesError(table.file, what, f"Give one of {', '.join(spellings)}", line=table.header_line)
    return present[0], spellings[present[0]]


def _numbers(table: Table, columns: Sequence[tuple[str, str]]) -> Array:
    return np.column_stack([table.numbers(name) for name, _ in columns])


def _one_unit(table: Table, columns: Sequence[tuple[str, str]]) -> str:
    units = sorted({unit for _, unit in columns})
    if len(units) > 1:
        shown = ", ".join(name for name, _ in columns)
        fix = "Use one unit for all"
        raise SamplesError(table.file, f"the columns {shown} state different units", fix, line=table.header_line)
    return units[0] if units else ""


SEQUENCES = {"fixed-xyz": "xyz", "zyx": "ZYX", "zyz": "ZYZ", "xyz": "XYZ"}
"""Three angles in the order of their columns: turns about fixed axes (small letters), or each about the axis that
those before it have moved (capitals)."""
MEANINGS = {
    "quaternion": "unit quaternion",
    "fixed-xyz": "turns about the fixed x, then y, then z (FANUC and Yaskawa W P R, Mitsubishi A B C)",
    "zyx": "turns about z, then the moved y, then the moved x (KUKA A B C)",
    "zyz": "turns about z, then the moved y, then the moved z (Kawasaki O A T, Comau)",
    "xyz": "turns about x, then the moved y, then the moved z (Staubli)",
    "rotation-vector": "axis times angle (Universal Robots)",
}


def rotations_of(numbers: Array) -> dict[tuple[str, str], Array]:
    """Rotation matrices (N, 3, 3) that orientations (N, 4) or (N, 3) may mean, by convention and unit ("" for none)."""
    if numbers.shape[1] == 4:
        return {("quaternion", ""): rotations_as(numbers, "quaternion")}
    names = (*SEQUENCES, "rotation-vector")
    return {(name, unit): rotations_as(numbers, name, unit) for unit in ANGLES for name in names}


def rotations_as(numbers: Array, name: str, unit: str = "") -> Array:
    """Rotation matrices (N, 3, 3) that orientations mean in one convention and unit."""
    from scipy.spatial.transform import Rotation

    if name == "quaternion":
        return np.asarray(Rotation.from_quat(np.roll(numbers, -1, axis=1)).as_matrix())
    angles = numbers * ANGLES[unit]
    if name == "rotation-vector":
        return np.asarray(Rotation.from_rotvec(angles).as_matrix())
    return np.asarray(Rotation.from_euler(SEQUENCES[name], angles).as_matrix())


def angle_between(one: Array, other: Array) -> Array:
    """Angles (...; rad) between rotations (..., 3, 3), exact for small ones too."""
    chord = np.linalg.norm(one - other, axis=(-2, -1)) / (2 * np.sqrt(2))
    return np.asarray(2 * np.arcsin(np.minimum(chord, 1.0)))

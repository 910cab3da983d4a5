"""Targets of a robot program as a file gives them: joint values, or poses with the branch to take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casacal.array_types import Array
from casacal.errors import SamplesError
from casacal.instruments.instrument import Dimension
from casacal.problem.problem_file import ProblemFile
from casacal.samples.layout import Layout, match_columns
from casacal.samples.samples import Samples
from casacal.tables.text import Table, read_table
from casacal.values import FrozenMapping

PLACE, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
POSE: Mapping[str, Dimension] = FrozenMapping({**dict.fromkeys(PLACE, "length"), **dict.fromkeys(QUATERNION, "number")})

UNIT_LENGTH = 1e-3
"""How far a quaternion may be from unit length: more than rounding leaves is a mistake."""


@dataclass(frozen=True)
class Targets:
    """Rows of targets: `joints` (N, n; rad, mm), `poses` as positions (N, 3; mm) and rotations (N, 3, 3), or both.

    With poses, joints only name the branch to take. lines, text: each row's line in its file, and the row itself.
    """

    joints: Array | None
    poses: tuple[Array, Array] | None
    lines: tuple[int, ...]
    text: tuple[str, ...]
    file: str
    sha256: str

    def __len__(self) -> int:
        return len(self.lines)

    @staticmethod
    def of(samples: Samples) -> Targets:
        """Joint targets from samples, or from any joint values that `Samples` can hold."""
        text = tuple(",".join(f"{value:.9g}" for value in row) for row in samples.joints)
        return Targets(samples.joints, None, tuple(samples.lines), text, samples.file, samples.sha256)


def read_targets(path: str | Path, source: ProblemFile) -> Targets:
    """Read joint targets (q1_deg, ... as in samples) or poses (x_mm,y_mm,z_mm,qw,qx,qy,qz as `predict` writes them).

    A file with a column qw holds poses; joint columns beside them then name the branch. Raises SamplesError.
    """
    table, axes = read_table(path), source.problem.layout().joints
    posed = "qw" in table.header
    jointed = not posed or any(name.startswith("q1_") for name in table.header)
    joints = Samples.from_table(table, Layout(axes, FrozenMapping({}))).joints if jointed else None
    text = tuple(",".join(row) for row in table.rows)
    poses = _poses(table, Layout(axes if jointed else (), POSE)) if posed else None
    return Targets(joints, poses, table.lines, text, table.file, table.sha256)


def _poses(table: Table, layout: Layout) -> tuple[Array, Array]:
    """Positions and rotations of a table's poses."""
    from scipy.spatial.transform import Rotation

    found = match_columns(table, layout)
    numbers = {name: np.array(table.numbers(column)) * factor for name, (column, factor) in found.items()}
    positions, wxyz = (np.column_stack([numbers[name] for name in part]) for part in (PLACE, QUATERNION))
    lengths = np.linalg.norm(wxyz, axis=1)
    for i in np.flatnonzero(np.abs(lengths - 1) > UNIT_LENGTH)[:1]:
        raise SamplesError(
            table.file,
            f"the quaternion has the length {lengths[i]:.6g}",
            "Give a unit quaternion qw,qx,qy,qz",
            line=table.lines[i],
        )
    return positions, Rotation.from_quat(np.roll(wxyz, -1, axis=1)).as_matrix()

"""What may have changed since a calibration: each cause a set of directions in which fresh rows would move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.calibration.fresh import Fresh
from casacal.calibration.shifts import BASE, BASE_TURN, JOINTS, TOOL, TURN, shift_columns

USUAL = {"rad": 3e-3, "mm": 3.0}
"""A change that would surprise nobody: what tells a cause of one number from one of six that explains as much."""


@dataclass(frozen=True, eq=False)
class Cause:
    """One thing that may have changed.

    name: as people are told of it. kind: "joint", "tool", "base" or "place". columns: its unknowns (k,) in x of the
    shifted rows. units, labels: of each. place: number of the joint (0, ...), or -1.
    """

    name: str
    kind: str
    columns: NDArray[np.intp]
    units: tuple[str, ...]
    labels: tuple[str, ...]
    place: int = -1

    @property
    def sizes(self) -> Array:
        """Changes (k,) that would surprise nobody."""
        return np.array([USUAL.get(unit, 1.0) for unit in self.units])


def causes_of(fresh: Fresh, shifted: BoundProblem) -> tuple[Cause, ...]:
    """Every joint, the tool, the base, and each thing that was said to stand where it was calibrated."""
    found = []
    joints = shift_columns(shifted, JOINTS)
    for i, (axis, column) in enumerate(zip(shifted.problem.robot.axes, joints, strict=True)):
        unit = "rad" if axis.turns else "mm"
        found.append(Cause(f"joint {i + 1}", "joint", np.array([column]), (unit,), ("zero",), i))
    labels = ("x", "y", "z", "about x", "about y", "about z")
    turns_show = any(block.unit == "rad" for block in shifted.problem.instrument.blocks)  # as of a body's pose
    for name, keys in (("tool", (TOOL, TURN) if turns_show else (TOOL,)), ("base", (BASE, BASE_TURN))):
        columns = np.concatenate([shift_columns(shifted, key) for key in keys])
        units = (("mm",) * 3 + ("rad",) * 3)[: columns.size]
        found.append(Cause(name, name, columns, units, labels[: columns.size]))
    for slot in fresh.bound.slots:
        columns = np.array(slot.columns, dtype=np.intp)
        if slot.beside or not slot.datum or not columns.size or not fresh.known[columns].all():
            continue
        names = tuple(name.removeprefix(slot.name).lstrip("._") for name in slot.unknown.names(slot.name))
        found.append(Cause(slot.name, "place", columns, tuple(slot.unknown.units), names))
    return tuple(found)

"""What may have changed since a calibration: each cause a set of directions in which fresh rows would move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.changes.shifts import BASE, BASE_TURN, JOINTS, TOOL, TURN, shift_columns
from casacal.verification.fresh import Fresh

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
    tool = [*shift_columns(shifted, TOOL)]
    labels, units = ["x", "y", "z"], ["mm"] * 3
    if _sees_turns(shifted):
        tool += [*shift_columns(shifted, TURN)]
        labels, units = [*labels, "about x", "about y", "about z"], [*units, *["rad"] * 3]
    found.append(Cause("tool", "tool", np.array(tool), tuple(units), tuple(labels)))
    base = np.concatenate([shift_columns(shifted, BASE), shift_columns(shifted, BASE_TURN)])
    labels = ["x", "y", "z", "about x", "about y", "about z"]
    found.append(Cause("base", "base", base, ("mm",) * 3 + ("rad",) * 3, tuple(labels)))
    for slot in fresh.bound.slots:
        columns = np.array(slot.columns, dtype=np.intp)
        if slot.beside or not slot.datum or not columns.size or not fresh.known[columns].all():
            continue
        labels = [name.removeprefix(slot.name).lstrip("._") for name in slot.unknown.names(slot.name)]
        found.append(Cause(slot.name, "place", columns, tuple(slot.unknown.units), tuple(labels)))
    return tuple(found)


def slopes_of(shifted: BoundProblem, x: Array, causes: Sequence[Cause], rows: int) -> list[Array]:
    """Whitened derivative (rows, k) by each cause's unknowns at x; rows after those of the samples are priors."""
    whole = shifted.jacobian(x)
    padded = np.vstack([whole, np.zeros((rows - len(whole), whole.shape[1]))])
    return [padded[:, cause.columns] for cause in causes]


def _sees_turns(shifted: BoundProblem) -> bool:
    """Whether each row says how the flange is turned, as a body's pose does."""
    return shifted.problem.instrument.blocks != () and any(
        block.unit == "rad" for block in shifted.problem.instrument.blocks
    )
